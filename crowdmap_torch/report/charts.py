"""The charts of report.html, of what a record holds."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.found_calibration import FleetCalibration
from crowdmap_torch.evaluation.signs import SignComparison
from crowdmap_torch.report.chart import HEIGHT, SERIES, Bars, Chart, Dots, Line, Segments, Tiles
from crowdmap_torch.report.drives import CornerResiduals, Drift
from crowdmap_torch.report.iteration import Iteration
from crowdmap_torch.report.plots import Eigengap, sign_errors
from crowdmap_torch.report.summaries import JourneySummary

_BINS = 24
_COLUMNS = 24
"""Of tiles over the image."""
_LEAST = 5
"""Numbers that a quantile is taken of."""
_MOST_CARS = 12
_MOST_JOURNEYS = 40
"""That a chart names."""
_MOST_CORNERS = 200_000
"""An even selection of more is drawn."""


def error_charts(
    now: SignComparison, before: SignComparison | None, *, oracle_m: float
) -> Iterator[Chart]:
    """Histograms of the absolute and the relative error of signs; of those alone that some sign has."""
    for name in ("absolute", "relative"):
        map_m = sign_errors(now, name)
        heads_m = sign_errors(before, name) if before is not None else map_m[:0]
        both = torch.cat((map_m, heads_m))
        if not len(both):
            continue
        top = max(float(both.max()) * 1.02, 1e-3)
        bars = []
        for values, color, label in ((heads_m, "before", "cluster heads"), (map_m, "map", "map")):
            count, edge = np.histogram(values.cpu().numpy(), _BINS, (0, top))
            middle = ((edge[1:] + edge[:-1]) / 2).tolist()
            bars.append(Bars(middle, count.tolist(), color, label, width=top / _BINS))
        rules = []
        if len(map_m):
            rules.append((float(map_m.mean()), "map", "mean of the map"))
        if name == "absolute" and math.isfinite(oracle_m):
            rules.append((oracle_m, "ink", "oracle"))
        yield Chart(
            f"{name} error", bars[0 if len(heads_m) else 1 :], "error [m]", "signs", rules_x=rules,
            from_zero=True,
        )  # fmt: skip


def bias_charts(journeys: Sequence[JourneySummary]) -> Iterator[Chart]:
    """The bias of each journey from above, and its height; the true one where it is known."""
    known = [j for j in journeys if j.true_bias is not None]
    true = [j.true_bias for j in journeys if j.true_bias is not None]
    ends = [p for j, t in zip(known, true, strict=True) for p in (j.bias, t)]
    names = [j.journey_id for j in journeys]
    yield Chart(
        "bias of each journey",
        [
            Segments([p[0] for p in ends], [p[1] for p in ends], "faint", width=1),
            Dots([t[0] for t in true], [t[1] for t in true], "survey", "true" if known else "", radius=3.5, hollow=True),
            Dots([j.bias[0] for j in journeys], [j.bias[1] for j in journeys], "map", "estimated", titles=names),
        ],
        "east [m]", "north [m]", equal=True, rules_x=((0, "faint", ""),), rules_y=((0, "faint", ""),),
    )  # fmt: skip
    number = list(range(len(journeys)))
    rows = [k for k, j in enumerate(journeys) if j.true_bias is not None]
    up = [j.bias[2] for j in journeys]
    yield Chart(
        "its vertical part",
        [
            Bars(number, up, "map", "estimated", width=0.6),
            Dots(rows, [t[2] for t in true], "survey", "true" if known else "", radius=3.5, hollow=True),
        ],
        "journey", "up [m]", from_zero=True, rules_y=((0, "faint", ""),), x_range=(-0.6, len(journeys) - 0.4),
    )  # fmt: skip


def drift_charts(drifts: Sequence[Drift]) -> Iterator[Chart]:
    """How corrections of positions change along the way, a line for each drive."""
    for axis in ("east", "north", "up"):
        lines = [
            Line(d.way_m, getattr(d, f"{axis}_m"), color, title=d.journey_id, width=1.2)
            for d, color in zip(drifts, SERIES * (1 + len(drifts) // len(SERIES)), strict=False)
        ]
        label = f"{axis} [m]"
        yield Chart(f"drift, {axis}", lines, "way driven [m]", label, rules_y=((0, "faint", ""),))


def eigengap_charts(spectra: Sequence[Eigengap]) -> Iterator[Chart]:
    """Eigenvalues of graph Laplacians, ascending, and the gap that was chosen."""
    for s in spectra:
        number = list(range(1, len(s.eigenvalue) + 1))
        below = [n <= s.clusters for n in number]
        marks = [
            Dots(
                [n for n, is_below in zip(number, below, strict=True) if is_below is side],
                [v for v, is_below in zip(s.eigenvalue, below, strict=True) if is_below is side],
                color,
            )
            for side, color in ((True, "map"), (False, "faint"))
        ]
        gap = ""
        if 0 < s.clusters < len(number):
            gap = f"gap {s.eigenvalue[s.clusters] - s.eigenvalue[s.clusters - 1]:.2f}"
        rules = ((s.clusters + 0.5, "before", gap),) if gap else ()
        title = f"{s.title}: {s.clusters} clusters"
        yield Chart(title, marks, "number", "eigenvalue", rules_x=rules)


def residual_charts(
    by_stage: Mapping[str, Float[Tensor, " _"]],
    corners: CornerResiduals | None,
    journey_ids: Sequence[str],
) -> Iterator[Chart]:
    """Reprojection residuals: stage by stage, by journey, over the range, and over the image."""
    lines, highest = [], 1.0
    for (stage, residual), color in zip(by_stage.items(), SERIES, strict=False):
        known = residual.detach().abs()[residual.isfinite()].clamp_min(1e-2).sort().values.cpu()
        if not len(known):
            continue
        rank = torch.linspace(0, len(known) - 1, min(len(known), 300)).long()
        median = float(known[(len(known) - 1) // 2])
        share = ((rank + 1) / len(known)).tolist()
        lines.append(Line(known[rank].tolist(), share, color, f"{stage} (median {median:.2f} px)"))
        highest = max(highest, float(known[-1]))
    if lines:
        yield Chart(
            "share below a size, stage by stage", lines, "residual [px]", "share", log_x=True,
            y_range=(0, 1.02), x_range=(1e-2, highest),
        )  # fmt: skip
    if corners is None or not len(corners):
        return
    # An even selection: a quantile of so many is exact enough.
    some = corners[torch.arange(0, len(corners), 1 + len(corners) // _MOST_CORNERS)]
    length = some.residual_px.norm(dim=-1)
    yield _by_journey(length, some.journey, journey_ids)
    far = some.range_m[some.range_m.isfinite()]
    if len(far):
        top = float(far.quantile(0.99)) if len(far) > 1 else float(far[0])
        cell = (some.range_m / max(top, 1.0) * 15).floor()
        middle = [(k + 0.5) * max(top, 1.0) / 15 for k in range(15)]
        low, half, high = _quartiles(length, cell.nan_to_num(-1).long(), 15)
        yield Chart(
            "over the range",
            [
                *_quartile_strokes(middle, low, high),
                Line(middle, half, "map", "median"),
            ],
            "from camera to sign [m]", "residual [px]", from_zero=True,
        )  # fmt: skip
    yield from _over_image(some)


def _by_journey(
    length: Float[Tensor, " n"], journey: Int[Tensor, " n"], names: Sequence[str]
) -> Chart:
    """Medians and quartiles; of many journeys those with the largest medians."""
    low, half, high = _quartiles(length, journey, len(names))
    order = sorted(range(len(names)), key=lambda k: -half[k] if math.isfinite(half[k]) else 0.0)
    shown = sorted(order[:_MOST_JOURNEYS])
    title = "by journey" if len(shown) == len(names) else f"by journey, the worst {len(shown)}"
    place = list(range(len(shown)))
    ends = [v for k in shown for v in (low[k], high[k])]
    return Chart(
        title,
        [
            Segments(ends, [p for p in place for _ in range(2)], "map", "quartiles", width=3),
            Dots([half[k] for k in shown], place, "ink", "median", titles=[names[k] for k in shown]),
        ],
        "residual [px]", y_range=(len(shown) - 0.4, -0.6), height=max(HEIGHT, 44 + 16 * len(shown)),
        y_names=[names[k] for k in shown], x_range=(0, _top(high)),
    )  # fmt: skip


def _over_image(corners: CornerResiduals) -> Iterator[Chart]:
    """The median length in tiles of the image, of all cameras."""
    x, y = (corners.place * _COLUMNS).long().clamp(0, _COLUMNS - 1).unbind(-1)
    _, length, _ = _quartiles(
        corners.residual_px.norm(dim=-1), y * _COLUMNS + x, _COLUMNS * _COLUMNS
    )
    at = [k for k, v in enumerate(length) if math.isfinite(v)]
    places = [((k % _COLUMNS + 0.5), (k // _COLUMNS + 0.5)) for k in at]
    if not at:
        return
    share = 100 / _COLUMNS
    yield Chart(
        f"over the image: median, at most {max(length[k] for k in at):.2f} px",
        [
            Tiles(
                [a * share for a, _ in places], [b * share for _, b in places], "map",
                value=[length[k] for k in at], side=share, unit=" px",
            )
        ],
        "% of the width", "% of the height", x_range=(0, 100), y_range=(100, 0),
    )  # fmt: skip


def _quartiles(
    value: Float[Tensor, " n"], group: Int[Tensor, " n"], groups: int
) -> tuple[list[float], list[float], list[float]]:
    """Lower quartile, median and upper quartile of each group; NaN of groups of few."""
    found = [[math.nan] * groups for _ in range(3)]
    for k in range(groups):
        own = value[group == k].double()
        if len(own) >= _LEAST:
            for row, q in zip(found, (0.25, 0.5, 0.75), strict=True):
                row[k] = float(own.quantile(q))
    return found[0], found[1], found[2]


def _quartile_strokes(
    place: Sequence[float], low: Sequence[float], high: Sequence[float]
) -> Iterator[Segments]:
    x = [p for p in place for _ in range(2)]
    yield Segments(
        x, [v for k in range(len(place)) for v in (low[k], high[k])], "map", "quartiles", width=3
    )


def _top(values: Sequence[float]) -> float:
    return 1.08 * max((v for v in values if math.isfinite(v)), default=1.0) or 1.0


def step_charts(iterations: Sequence[Iteration]) -> Iterator[Chart]:
    """What each step of the adjustment took off its own cost, the scales it was in, and the errors as they fall."""
    strokes = [(i.number, i.cost_before, i.total) for i in iterations]
    known = [(n, a, b) for n, a, b in strokes if math.isfinite(a) and a > 0 and b > 0]
    rest = [(n, b) for n, a, b in strokes if not math.isfinite(a)]
    judged = [i.number for before, i in pairwise(iterations) if i.judged != before.judged]
    narrowed = [
        i.number
        for i, after in pairwise(iterations)
        if any(abs(after.scale.get(k, v) - v) > 0.01 * abs(v) for k, v in i.scale.items())
    ]
    rules = [
        (n + 0.5, color, label if k == 0 else "")
        for steps, color, label in (
            (narrowed, "before", "scales changed"),
            (judged, "bad", "detections judged"),
        )
        for k, n in enumerate(steps)
    ]
    last = max((i.number for i in iterations), default=1)
    across = (0.4, last + 0.6)
    if known or any(b > 0 for _, b in rest):
        yield Chart(
            "cost: what each step took off",
            [
                Segments(
                    [n for n, _, _ in known for _ in range(2)],
                    [v for _, a, b in known for v in (a, b)],
                    "map", "before and after a step, in its own scales", width=2.5, arrow=True,
                ),
                Dots([n for n, _ in rest], [b for _, b in rest], "map"),
            ],
            "iteration", "cost", log_y=True, rules_x=rules, x_range=across,
        )  # fmt: skip
    names = list(dict.fromkeys(name for i in iterations for name in i.scale if name.endswith("px")))
    scales = [
        Line([i.number for i in iterations], [i.scale.get(n, math.nan) for i in iterations], color, n[:-3].replace("_", " "))
        for n, color in zip(names, SERIES, strict=False)
    ]  # fmt: skip
    if scales:
        yield Chart(
            "scales that residuals are measured in", scales, "iteration", "1-sigma [px]", rules_x=rules,
            from_zero=True, x_range=across,
        )  # fmt: skip
    tags = ("error/corner_m", "error/corner_relative_m", "error/lane_lateral_m")
    lines = []
    for tag, color in zip(tags, SERIES, strict=False):
        points = [(i.number, i.errors[tag]) for i in iterations if tag in i.errors]
        name = tag.removeprefix("error/").removesuffix("_m").replace("_", " ")
        if points:
            x, y = zip(*points, strict=True)
            lines += [Line(x, y, color, name), Dots(x, y, color)]
    if lines:
        yield Chart(
            "error against the survey", lines, "iteration", "error [m]", from_zero=True, x_range=across
        )  # fmt: skip


def calibration_charts(found: FleetCalibration) -> Iterator[Chart]:
    """Every number of the first cars in units of its prior sigma, with its own 95 % interval."""
    names = list(dict.fromkeys(name for car in found.values() for name in car.estimate))
    cars = list(found.items())[:_MOST_CARS]
    for name in names:
        x, y, ends, rows = [], [], [], []
        for row, (_, car) in enumerate(cars):
            if name not in car.estimate:
                continue
            prior = np.array(car.prior_sigma[name])
            value, sigma = np.array(car.estimate[name]) / prior, np.array(car.sigma[name]) / prior
            for k, (v, s) in enumerate(zip(value.tolist(), sigma.tolist(), strict=True)):
                place = row + 0.22 * (k - (len(value) - 1) / 2)
                x.append(v)
                y.append(place)
                ends += [v - 1.96 * s, v + 1.96 * s]
                rows += [place, place]
        top = max(2.2, *(abs(v) * 1.05 for v in ends)) if ends else 2.2
        yield Chart(
            name, [Segments(ends, rows, "map", width=1.2), Dots(x, y, "map")], "in sigmas of the prior",
            x_range=(-top, top), y_range=(len(cars) - 0.4, -0.6), height=max(110, 60 + 26 * len(cars)),
            rules_x=((-1.96, "faint", ""), (0, "faint", ""), (1.96, "faint", "")),
            y_names=[key for key, _ in cars],
        )  # fmt: skip
