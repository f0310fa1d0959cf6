"""report.html: one file that opens without a network and tells a person what a run has made."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path

from matplotlib.figure import Figure

from crowdmap_torch.io.atomic import atomic_file
from crowdmap_torch.report import charts, plots
from crowdmap_torch.report.assets import SCRIPT, STYLE
from crowdmap_torch.report.calibration import calibration_table
from crowdmap_torch.report.chart import charts_html
from crowdmap_torch.report.map_section import map_section
from crowdmap_torch.report.record import RunRecord
from crowdmap_torch.report.tables_html import (
    bias_table,
    error_table,
    headline_cards,
    reasons_table,
    sign_table,
    simple_table,
    timing_table,
)
from crowdmap_torch.report.verdict import FAIR, GOOD, POOR, Judgement, judgements, overall

_VERDICTS = {
    GOOD: "The map is good.",
    FAIR: "The map can be used; look at what is marked.",
    POOR: "The map is poor.",
}
_FIRST_GOOD = 5
"""Things that are shown of what is well."""
_MARKS = {GOOD: "\u2713", FAIR: "!", POOR: "\u2717"}


def write_report(path: Path, record: RunRecord) -> None:
    """Write `record` as one self-contained HTML file, complete or not at all."""
    with atomic_file(path) as beside:
        beside.write_text(report_html(record), encoding="utf-8")


def report_html(record: RunRecord) -> str:
    """The report as text."""
    sections = [s for s in _sections(record) if s[2]]
    return page_html(record.title, "", sections, head=_head(record))


def page_html(
    title: str, subtitle: str, sections: Sequence[tuple[str, str, str]], *, head: str = ""
) -> str:
    """A page of sections (anchor, title and content), complete in itself; `head` stands under the title."""
    told = f"<p>{escape(subtitle)}</p>" if subtitle else ""
    links = "".join(f'<a href="#{name}">{escape(heading)}</a>' for name, heading, _ in sections)
    body = "".join(
        f'<section id="{name}"><h2>{escape(heading)}</h2>{content}</section>'
        for name, heading, content in sections
    )
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>"
        f'<header><div class="wrap"><h1>{escape(title)}</h1>'
        f"{told}{head}</div></header>"
        f'<nav><div class="wrap">{links}</div></nav><main class="wrap">{body}</main>'
        '<footer class="wrap">All lengths in metres, east north up from the map\'s origin. '
        f"</footer><script>{SCRIPT}</script></body></html>\n"
    )


def _sections(record: RunRecord) -> Iterator[tuple[str, str, str]]:
    """Anchor, title and content of each section; those without content are left out."""
    yield "headline", "At a glance", _verdict(record) + headline_cards(record)
    yield "warnings", "Looks wrong", _warnings(record)
    told = note(
        "A click shows what is known of a sign. A row of the table of signs leads here too."
    )
    yield "map", "Map", told + map_section(record)
    yield "errors", "Errors", _errors(record)
    yield "journeys", "Journeys", _journeys(record)
    yield "calibration", "Calibration", _calibration(record)
    yield "clusters", "Clusters", _clusters(record)
    yield "residuals", "Residuals", _residuals(record)
    yield "adjustment", "Bundle adjustment", _adjustment(record)
    yield "signs", "Signs", sign_table(record)
    yield "pruned", "Left out", _pruned(record)
    yield "timings", "Timings", timing_table(record.timings_s, record.memory_gb)
    yield "config", "Configuration", _config(record)


def _head(record: RunRecord) -> str:
    """What was mapped, when and with what."""
    facts = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>"
        for name, value in record.facts.items()
    )
    return f"<dl>{facts}</dl>" if facts else ""


def _verdict(record: RunRecord) -> str:
    """Whether the map is good, and what speaks for and against it, the worst first."""
    found = judgements(record)
    if not found:
        return ""
    grade = overall(found)
    # What is well is told at length where nothing else is to be said.
    first = max(sum(j.grade != GOOD for j in found), _FIRST_GOOD)
    rest = ""
    if found[first:]:
        told = f"and {len(found) - first} more that are well"
        rest = f"<details><summary>{told}</summary><ul>{_items(found[first:])}</ul></details>"
    return (
        f'<div class="verdict {grade}" role="status"><strong>{_VERDICTS[grade]}</strong>'
        f"<ul>{_items(found[:first])}</ul>{rest}</div>"
    )


def _items(found: Sequence[Judgement]) -> str:
    return "".join(
        f'<li class="{j.grade}"><b>{_MARKS[j.grade]}</b>{escape(j.text[:1].upper() + j.text[1:])}.'
        + (f" <em>{escape(j.reason)}.</em>" if j.reason else "")
        + "</li>"
        for j in found
    )


def _warnings(record: RunRecord) -> str:
    if not record.warnings:
        return ""
    rows = [(w.seen(len(record.journeys)), w.cause, w.cure) for w in record.warnings]
    head = ("what was seen", "likely cause", "cure")
    return '<div class="box warn">' + simple_table(head, rows) + "</div>"


def _errors(record: RunRecord) -> str:
    if record.figures is None:
        return ""
    drawn = ""
    if record.comparison is not None and bool(record.comparison.counted.any()):
        oracle = record.figures.oracle
        drawn = charts_html(
            charts.error_charts(
                record.comparison,
                record.comparison_before,
                oracle_m=oracle.total.mean if oracle is not None else float("nan"),
            )
        )
    return drawn + error_table(record.figures, record.figures_before)


_BIAS = (
    "Bias: what is to be added to the positions as given, in the mean over the journey. What all journeys have wrong "
    "alike is in none of them."
)
_WITHOUT_IT = (
    " Without it: how far signs that others saw too would be elsewhere, in their standard deviations; the sign that would "
    "move farthest; lanes, across; signs that nobody else saw. Of n journeys that say as much as each other any moves "
    "signs by 1 / sqrt(n - 1)."
)


def _journeys(record: RunRecord) -> str:
    named = [
        *(("set aside", r) for r in record.rejected),
        *(("outlier", r) for r in record.outlier_journeys),
        *(("outage", r) for r in record.outages),
    ]
    warning = ""
    if named:
        rows = [(kind, r.journey_id, r.reason) for kind, r in named]
        warning = (
            '<div class="box warn">' + simple_table(("", "journey", "reason"), rows) + "</div>"
        )
        warning = (
            "<h3>Journeys set aside, or without weight on all or some of their way</h3>" + warning
        )
    if not record.journeys:
        return warning
    asked = any(j.without_it for j in record.journeys)
    return (
        note(_BIAS + _WITHOUT_IT if asked else _BIAS)
        + charts_html(charts.bias_charts(record.journeys))
        + bias_table(record.journeys)
        + warning
        + _drift(record)
    )


def _drift(record: RunRecord) -> str:
    if not record.drifts:
        return ""
    told = note(
        "What is to be added to the given positions along the way of each drive, less its bias: a line that wanders "
        "slowly is a receiver's drift, one that jumps an outage. Point at a line for the drive's name."
    )
    return "<h3>Drift along the way</h3>" + told + charts_html(charts.drift_charts(record.drifts))


def _calibration(record: RunRecord) -> str:
    if not record.calibration:
        return ""
    told = note(
        "What every car has wrong against its rig.yaml, found with the map. Near 0 the sigma over that of the prior says "
        "that it was seen, near 1 that it is held where it was stated. calibration.json has all numbers, rigs/ has rig.yaml "
        "files with what was found put right."
    )
    return (
        told
        + charts_html(charts.calibration_charts(record.calibration))
        + calibration_table(record.calibration)
    )


def _clusters(record: RunRecord) -> str:
    if not record.spectra:
        return ""
    return note(
        "Eigenvalues of the graph Laplacian: as many are small as there are landmarks; "
        "the gap after them is where the number was read off."
    ) + charts_html(charts.eigengap_charts(record.spectra))


def _residuals(record: RunRecord) -> str:
    if not any(len(r) for r in record.residual_px.values()):
        return ""
    ids = [j.journey_id for j in record.journeys]
    return note(
        "Projected minus detected corners of signs. A journey that stands out has poses or a camera off; what grows "
        "towards the borders of the image is the lens, what grows with the range the poses' rotation."
    ) + charts_html(charts.residual_charts(record.residual_px, record.corners, ids))


def _adjustment(record: RunRecord) -> str:
    if not record.iterations:
        return ""
    steps = len(record.iterations)
    outcome = record.outcome[:1].upper() + record.outcome[1:]
    told = (
        f"{steps} iterations. {outcome}. Every step lowers the cost from where its stroke begins to the dot, in its own "
        "scales. After it residuals are measured in the scales that are left, lane points matched anew, and what is gross "
        "is judged (dashed): the next step begins at another cost, mostly a higher one, as the same errors are more in "
        "narrower scales. So strokes are not compared with one another; look at where each ends, and at the errors."
    )
    return note(told) + charts_html(charts.step_charts(record.iterations))


def _pruned(record: RunRecord) -> str:
    parts = []
    if record.pruned:
        parts.append(
            "<div><h3>What was left out, and why</h3>" + reasons_table(record.pruned) + "</div>"
        )
    if record.counts:
        rows = [(name, _count(value)) for name, value in record.counts.items()]
        parts.append("<div><h3>Counts</h3>" + simple_table(("", "count"), rows) + "</div>")
    return f'<div class="two">{"".join(parts)}</div>' if parts else ""


def _config(record: RunRecord) -> str:
    if not record.config_yaml:
        return ""
    return f'<div class="box"><pre>{escape(record.config_yaml)}</pre></div>'


def _count(value: float | str) -> str:
    if isinstance(value, str):
        return value
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:.3f}"


def drawing(figure: Figure) -> str:
    """A figure, as an element of a page."""
    return f'<div class="box">{plots.svg(figure)}</div>'


def note(text: str) -> str:
    """A paragraph beside a figure or table."""
    return f'<p class="note">{escape(text)}</p>'
