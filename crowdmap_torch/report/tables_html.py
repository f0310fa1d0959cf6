"""The tables and the headline figures of report.html."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from html import escape

from crowdmap_torch.evaluation.map_figures import MapFigures
from crowdmap_torch.evaluation.statistics import ErrorFigures
from crowdmap_torch.evaluation.text import number_text, percent_text
from crowdmap_torch.geometry import polygon
from crowdmap_torch.report.record import RunRecord
from crowdmap_torch.report.summaries import JourneySummary, Pruned, WithoutIt
from crowdmap_torch.survey.matching import DUPLICATE

_MAX_SIGNS = 5000
"""Longer tables make browsers slow; the map's own file has all signs."""


def headline_cards(record: RunRecord) -> str:
    """The figures to look at first: against the survey where there is one, counts always."""
    cards = "".join(
        f'<div class="card"><span>{escape(name)}</span><b>{value}</b><i>{escape(detail)}</i></div>'
        for name, value, detail in _cards(record)
    )
    return f'<div class="cards">{cards}</div>'


def _cards(record: RunRecord) -> Iterator[tuple[str, str, str]]:
    figures = record.figures
    if figures is not None:
        yield from _figure_cards(figures)
    lanes = record.hd_map.lanes
    yield "signs in the map", f"{len(record.hd_map.signs):,}", f"{len(lanes):,} lane pieces"
    if record.journeys:
        seen = sum(j.detections for j in record.journeys)
        used = sum(j.used for j in record.journeys)
        frames = sum(j.frames for j in record.journeys)
        yield "journeys", f"{len(record.journeys):,}", f"{frames:,} frames"
        if seen:
            detail = f"{used:,} of {seen:,}"
            yield "sign detections used", percent_text(used / seen), detail
    bad = len(record.rejected) + len(record.outlier_journeys)
    if bad:
        detail = f"{len(record.rejected)} set aside, {len(record.outlier_journeys)} outliers"
        yield "journeys left out", str(bad), detail
    if record.timings_s:
        yield "time", f"{sum(record.timings_s.values()):.0f}<small>s</small>", "all stages"


def _figure_cards(figures: MapFigures) -> Iterator[tuple[str, str, str]]:
    signs = figures.signs
    corners = signs.absolute.total.count > 0
    absolute = signs.absolute if corners else signs.absolute_center
    relative = signs.relative if corners else signs.relative_center
    what = "corner" if corners else "centre"
    detail = f"median {_metres(absolute.total.median)}"
    if math.isfinite(figures.absolute_over_oracle):
        detail = f"{figures.absolute_over_oracle:.2f} times the oracle"
    yield f"absolute {what} error", _metres_html(absolute.total.mean), detail
    yield (
        f"relative {what} error",
        _metres_html(relative.total.mean),
        f"median {_metres(relative.total.median)}",
    )
    yield (
        "sign recall",
        percent_text(signs.recall),
        f"{signs.matched_observable} of {signs.observable} observable",
    )
    yield (
        "sign precision",
        percent_text(signs.precision),
        f"{signs.duplicates} duplicates, {signs.false} false",
    )
    if figures.lanes is not None:
        lanes = figures.lanes
        yield "lane recall", percent_text(lanes.recall), f"{lanes.seen_length_m:,.0f} m seen"
        lateral = _metres(lanes.lateral_without_shift.mean)
        yield (
            "lane lateral error",
            _metres_html(lanes.lateral.mean),
            f"{lateral} without the signs' shift",
        )
    if figures.association is not None:
        detail = f"pairs: precision {percent_text(figures.association.pair_precision)}"
        yield "data loss", percent_text(figures.association.data_loss), detail


def error_table(figures: MapFigures, before: MapFigures | None) -> str:
    """Mean, median and 95th percentile of every error; beside it the mean of the cluster heads."""
    # Adjustment leaves the oracle as it is.
    then = {} if before is None else dict(_errors(replace(before, oracle=None)))
    head = ["", "mean", "median", "95 %", "count"]
    head += ["mean of cluster heads"] if before is not None else []
    rows = []
    for title, errors in _errors(figures):
        if errors.count:
            numbers = [number_text(v) for v in (errors.mean, errors.median, errors.p95)]
            row = [title, *numbers, str(errors.count)]
            if before is not None:
                row.append(number_text(then[title].mean) if title in then else "")
            rows.append(row)
    return simple_table(head, rows)


def _errors(figures: MapFigures) -> Iterator[tuple[str, ErrorFigures]]:
    """Title and figures of every error that is known, in the order of the table."""
    signs, lanes = figures.signs, figures.lanes
    for title, positions in (
        ("absolute corner", signs.absolute),
        ("oracle corner", figures.oracle),
        ("relative corner", signs.relative),
        ("absolute centre", signs.absolute_center),
        ("relative centre", signs.relative_center),
    ):
        if positions is not None:
            yield title, positions.total
            if positions is not figures.oracle:
                yield f"{title}, horizontal", positions.horizontal
                yield f"{title}, vertical", positions.vertical
    yield from (
        ("width", signs.width),
        ("height", signs.height),
        ("normal [deg]", signs.normal_deg),
    )
    if lanes is not None:
        for name in ("lateral", "vertical", "lateral_without_shift", "width"):
            yield "lane " + name.replace("_", " "), getattr(lanes, name)


def bias_table(journeys: Sequence[JourneySummary]) -> str:
    """One row a journey: what of it was used, its bias with 1-sigma, what would be without it; sortable."""
    asked = any(j.without_it is not None for j in journeys)
    head = (
        "journey",
        "frames",
        "signs",
        "detections",
        "used",
        "east [m]",
        "north [m]",
        "up [m]",
        "heading [deg]",
        *(("without it [sigma]", "farthest [m]", "lanes [m]", "signs gone") if asked else ()),
    )
    rows = []
    for j in journeys:
        share = j.used / j.detections if j.detections else math.nan
        cells = [_cell(j.journey_id, j.journey_id), _cell(str(j.frames), j.frames)]
        cells += [_cell(f"{n:,}", n) for n in (j.signs, j.detections)]
        cells.append(_cell(percent_text(share), share))
        cells += [_uncertain_cell(b, s) for b, s in zip(j.bias, j.bias_sigma, strict=True)]
        cells.append(_uncertain_cell(j.heading_deg, j.heading_sigma_deg))
        if asked:
            cells += _without_cells(j.without_it)
        rows.append(f"<tr>{''.join(cells)}</tr>")
    return _sortable(head, rows)


def _without_cells(found: WithoutIt | None) -> list[str]:
    """What the map would be without a journey; nothing of one that had no say."""
    if found is None:
        return [_cell("-", math.nan)] * 4
    sign = "" if found.farthest_sign is None else f" {found.farthest_sign}"
    return [
        _cell(number_text(found.in_sigmas), found.in_sigmas),
        _cell(number_text(found.farthest_m) + sign, found.farthest_m),
        _cell(number_text(found.across_m), found.across_m),
        _cell(str(found.signs_gone), found.signs_gone),
    ]


def sign_table(record: RunRecord) -> str:
    """One row a sign of the map; sortable, a click shows it on the map."""
    hd_map, signs = record.hd_map, record.hd_map.signs
    if len(signs) == 0:
        return ""
    status, absolute, relative = _against_survey(record)
    head = ["sign", "shape", "type", "east", "north", "up", "width", "height"]
    head += ["journeys", "detections", "sigma", "confidence"]
    head += ["survey", "error", "relative"] if record.comparison is not None else []
    center, size = signs.center_world.tolist(), signs.size.tolist()
    sigma = (signs.covariance.diagonal(dim1=-2, dim2=-1).sum(-1) / 3).clamp_min(0).sqrt().tolist()
    shape, code = signs.shape.tolist(), signs.type.tolist()
    counts = list(zip(signs.n_journeys.tolist(), signs.n_observations.tolist(), strict=True))
    confidence = signs.confidence.tolist()
    rows = []
    for k in range(min(len(signs), _MAX_SIGNS)):
        name = hd_map.type_names[code[k]] if code[k] >= 0 else ""
        cells = [
            _cell(hd_map.sign_id[k], hd_map.sign_id[k]),
            _cell(polygon.SHAPES[shape[k]].replace("_", " "), shape[k], kind="text"),
            _cell(name, name, kind="text code"),
            *(_cell(f"{v:.2f}", v) for v in (*center[k], *size[k])),
            *(_cell(f"{n:,}", n) for n in counts[k]),
            *(_cell(f"{v:.3f}", v) for v in (sigma[k], confidence[k])),
        ]
        if record.comparison is not None:
            tag = f'<span class="tag {status[k]}">{status[k]}</span>'
            cells.append(f'<td class="text" data-v="{status[k]}">{tag}</td>')
            cells += [_cell(number_text(e), e) for e in (absolute[k], relative[k])]
        key = escape(hd_map.sign_id[k])
        rows.append(f'<tr class="pick" data-id="{key}">{"".join(cells)}</tr>')
    note = ""
    if len(signs) > _MAX_SIGNS:
        note = f'<p class="note">The first {_MAX_SIGNS:,} of {len(signs):,} signs.</p>'
    return note + _sortable(head, rows)


def _against_survey(record: RunRecord) -> tuple[list[str], list[float], list[float]]:
    """What each map sign is to the survey, its absolute and its relative error [m]."""
    n, c = len(record.hd_map.signs), record.comparison
    status, absolute, relative = ["false"] * n, [math.nan] * n, [math.nan] * n
    if c is None:
        return status, absolute, relative
    for row, kind in enumerate(c.match.true_of_map.tolist()):
        if kind == DUPLICATE:
            status[row] = "duplicate"
        elif kind >= 0:
            status[row] = "control" if bool(c.control[kind]) else "matched"
    relative_m = c.error_m("relative").where(c.has_relative, math.nan).tolist()
    for row, *errors in zip(
        c.map_row.tolist(), c.error_m("absolute").tolist(), relative_m, strict=True
    ):
        absolute[row], relative[row] = errors
    return status, absolute, relative


def reasons_table(pruned: Sequence[Pruned]) -> str:
    """What was left out, most first within each stage."""
    stages = list(dict.fromkeys(p.stage for p in pruned))
    ordered = sorted(pruned, key=lambda p: (stages.index(p.stage), -p.count))
    return simple_table(
        ("stage", "reason", "count"), [(p.stage, p.reason, f"{p.count:,}") for p in ordered]
    )


def timing_table(timings_s: Mapping[str, float], memory_gb: Mapping[str, float]) -> str:
    """Seconds of each stage, with a bar, and what memory it took where that is known."""
    if not timings_s:
        return ""
    longest = max(max(timings_s.values()), 1e-9)
    rows = "".join(
        f"<tr><td>{escape(name)}</td><td>{seconds:.2f} s</td>"
        f"<td>{f'{memory_gb[name]:.2f} GB' if name in memory_gb else ''}</td>"
        f'<td class="text" style="width:60%"><div class="bar" '
        f'style="width:{100 * seconds / longest:.1f}%"></div></td></tr>'
        for name, seconds in timings_s.items()
    )
    return f'<div class="scroll"><table><tbody>{rows}</tbody></table></div>'


def simple_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of text, all columns but the first to the right unless they hold words."""
    words = [any(_is_word(row[c]) for row in rows) for c in range(len(head))]
    kind = [' class="text"' if w else "" for w in words]
    top = "".join(f"<th{kind[c]}>{escape(name)}</th>" for c, name in enumerate(head))
    body = "".join(
        "<tr>" + "".join(f"<td{kind[c]}>{escape(v)}</td>" for c, v in enumerate(row)) + "</tr>"
        for row in rows
    )
    table = f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div class="scroll">{table}</div>'


def _sortable(head: Sequence[str], rows: Sequence[str]) -> str:
    words = ("shape", "type", "survey")
    kind = [' class="text"' if h in words else "" for h in head]
    top = "".join(f"<th{k}>{escape(h)}</th>" for k, h in zip(kind, head, strict=True))
    return (
        f'<div class="scroll long"><table class="sortable"><thead><tr>{top}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _cell(text: str, value: float | str, *, kind: str = "") -> str:
    """A cell that sorts by `value`; an unknown number sorts last."""
    key = "" if isinstance(value, float) and not math.isfinite(value) else str(value)
    name = f' class="{kind}"' if kind else ""
    return f'<td{name} data-v="{escape(key)}">{escape(text)}</td>'


def _uncertain_cell(value: float, sigma: float) -> str:
    """A signed number with its 1-sigma, where it is known."""
    if not math.isfinite(value):
        return _cell("-", value)
    return _cell(f"{value:+.3f}" + (f" ± {sigma:.3f}" if math.isfinite(sigma) else ""), value)


def _is_word(text: str) -> bool:
    return any(c.isalpha() for c in text)


def _metres(value: float) -> str:
    return f"{value:.3f} m" if math.isfinite(value) else "unknown"


def _metres_html(value: float) -> str:
    return f"{value:.3f}<small>m</small>" if math.isfinite(value) else "-"
