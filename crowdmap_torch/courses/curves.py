"""Curves through the samples of many lines: which samples belong to which curve, and the splines that fit them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from crowdmap_torch.clustering.groups import group_sum
from crowdmap_torch.clustering.lines import LineSamples
from crowdmap_torch.courses.samples import even_parameters, places
from crowdmap_torch.geometry import spline
from crowdmap_torch.optim.banded import solve_banded

_STEP = 1.0
"""Distance between the points that curves are looked up by [m]."""
_STIFFNESS = 2e-3
"""Price of a change of curvature, in units of the mean weight of a knot: it decides only where there are no samples."""


@dataclass(frozen=True)
class Curves:
    """Natural cubic splines, and points along them, those of one curve adjacent and in order."""

    control: Float[Tensor, "c 3"]
    count: Int[Tensor, " n"]
    """Control points of each curve."""
    point: Float[Tensor, "k 3"]
    direction: Float[Tensor, "k 2"]
    slope: Float[Tensor, " k"]
    station: Float[Tensor, " k"]
    """Horizontal distance from the curve's start [m]."""
    curve: Int[Tensor, " k"]
    kind: Int[Tensor, " n"]
    """-1 unknown."""

    def __len__(self) -> int:
        return len(self.count)

    @property
    def length(self) -> Float[Tensor, " n"]:
        """Horizontal length of each curve [m]."""
        last = torch.bincount(self.curve, minlength=len(self)).cumsum(0) - 1
        return self.station[last]


@dataclass(frozen=True)
class Match:
    """Which curve each sample lies on, and where."""

    curve: Int[Tensor, " s"]
    """-1 for none."""
    station: Float[Tensor, " s"]
    """Place on the curve [m]."""
    lateral: Float[Tensor, " s"]
    """How far left of the curve the sample lies [m]; left as seen along the curve."""
    height: Float[Tensor, " s"]
    """How far above it."""
    normal: Float[Tensor, "s 2"]
    """Unit vector to the left of the curve."""
    along: Float[Tensor, " s"]
    """Cosine between the sample's direction and the curve's."""


def curves_through(
    point: Float[Tensor, "k 3"],
    curve: Int[Tensor, " k"],
    kind: Int[Tensor, " n"],
    spacing: Float[Tensor, " n"],
) -> Curves:
    """Smooth curves through points in order, knots about `spacing` [m] apart."""
    station, length = stations(point, curve, len(kind))
    count = _counts(length, spacing)
    return _fitted(point, curve, station / length[curve], torch.ones_like(station), count, kind)


def stations(
    point: Float[Tensor, "k 3"], curve: Int[Tensor, " k"], count: int
) -> tuple[Float[Tensor, " k"], Float[Tensor, " n"]]:
    """Horizontal distance of each point from the start of its polyline, and the polylines' lengths [m]."""
    if not len(curve):
        return point.new_zeros(0), point.new_zeros(count)
    step = (point[1:, :2] - point[:-1, :2]).norm(dim=1)
    step = torch.where(curve[1:] == curve[:-1], step, torch.zeros_like(step))
    s = torch.cat((step.new_zeros(1), step.cumsum(0)))
    size = torch.bincount(curve, minlength=count)
    first = size.cumsum(0) - size
    return s - s[first][curve], s[first + size - 1] - s[first]


def match(
    samples: LineSamples,
    curves: Curves,
    *,
    gate: float,
    height_gate: float = 2.0,
    other_kind: float = 0.15,
) -> Match:
    """The curve that each sample lies on, within `gate` [m] sideways.

    Among several, the nearest counting the other samples of the track too; a curve of another kind is `other_kind` [m]
    farther.
    """
    s = len(samples)
    nothing = samples.point.new_zeros(s)
    if not len(curves) or not s:
        return Match(
            torch.full((s,), -1, dtype=torch.int64, device=nothing.device),
            nothing, nothing, nothing, samples.direction, nothing,
        )  # fmt: skip
    tree = KDTree(curves.point[:, :2].detach().cpu().numpy())
    k = min(8, len(curves.point))
    _, found = tree.query(
        samples.point[:, :2].detach().cpu().numpy(),
        k=k,
        distance_upper_bound=gate + _STEP,
        workers=-1,
    )
    found = torch.from_numpy(found.reshape(s, k)).to(nothing.device)
    i, slot = (found < len(curves.point)).nonzero(as_tuple=True)
    row = found[i, slot]
    axis = curves.direction[row]
    delta = samples.point[i] - curves.point[row]
    a = delta[:, 0] * axis[:, 0] + delta[:, 1] * axis[:, 1]
    lateral = axis[:, 0] * delta[:, 1] - axis[:, 1] * delta[:, 0]
    height = delta[:, 2] - a * curves.slope[row]
    way = samples.direction[i]
    along = way[:, 0] * axis[:, 0] + way[:, 1] * axis[:, 1]
    fits = (
        (lateral.abs() < gate)
        & (height.abs() < height_gate)
        & (along.abs() > 0.94)
        & (a.abs() < 0.75 * _STEP)
    )
    i, row, a, lateral, height, along = (v[fits] for v in (i, row, a, lateral, height, along))
    curve = curves.curve[row]
    # Of each sample and curve the nearest point, then of each sample the best curve.
    pair, pair_of = torch.unique(i * len(curves) + curve, return_inverse=True)
    nearest = _argmin_by(a.abs(), pair_of, len(pair))
    i, row, a, lateral, height, along = (v[nearest] for v in (i, row, a, lateral, height, along))
    curve = curves.curve[row]
    mean = _mean_by(lateral.abs(), samples.track[i] * len(curves) + curve)
    kind, own = samples.kind[i], curves.kind[curve]
    differs = (kind >= 0) & (own >= 0) & (kind != own)
    score = 0.5 * lateral.abs() + mean + other_kind * differs.to(mean)
    matched, sample_of = torch.unique(i, return_inverse=True)
    best = _argmin_by(score, sample_of, len(matched))
    result = torch.full((s,), -1, dtype=torch.int64, device=nothing.device)
    result[matched] = curve[best]

    def spread(value: Float[Tensor, " m"]) -> Float[Tensor, " s"]:
        return nothing.index_put((matched,), value[best])

    axis = samples.direction.index_put((matched,), curves.direction[row[best]])
    return Match(
        curve=result,
        station=spread(curves.station[row] + a),
        lateral=spread(lateral),
        height=spread(height),
        normal=torch.stack((-axis[:, 1], axis[:, 0]), dim=1),
        along=spread(along),
    )


def fit_curves(
    samples: LineSamples,
    matched: Match,
    curves: Curves,
    spacing: Float[Tensor, " n"],
    *,
    scale: float = 0.25,
) -> Curves:
    """The curves fitted again to the samples that lie on them; far-off samples count little beyond `scale` [m].

    A journey has the same weight at every place that it saw, however many of its pieces overlap there.
    """
    used = (matched.curve >= 0).nonzero()[:, 0]
    curve, station = matched.curve[used], matched.station[used]
    length = curves.length
    weight = samples.weight[used] / overlap(samples.owner[used], curve, station, len(curves))
    weight = weight / (1 + (matched.lateral[used] / scale).square())
    count = _counts(length, spacing)
    # Where no sample lies the old course is kept, more or less.
    hold = torch.cat((weight, torch.full_like(curves.station, 1e-3)))
    return _fitted(
        torch.cat((samples.point[used], curves.point)),
        torch.cat((curve, curves.curve)),
        torch.cat((station, curves.station)) / length[torch.cat((curve, curves.curve))],
        hold,
        count,
        curves.kind,
    )


def knot_spacing(curves: Curves, *, shortest: float, longest: float) -> Float[Tensor, " n"]:
    """Distance between control points [m]: a quarter of the sharpest radius, within bounds."""
    angle = torch.atan2(curves.direction[:, 1], curves.direction[:, 0])
    lag = 8  # over less, noise looks like a bend
    if len(angle) <= lag:
        return torch.full((len(curves),), longest).to(curves.control)
    turn = torch.remainder(angle[lag:] - angle[:-lag] + torch.pi, 2 * torch.pi) - torch.pi
    run = (curves.station[lag:] - curves.station[:-lag]).clamp_min(1e-3)
    same = curves.curve[lag:] == curves.curve[:-lag]
    bend = torch.where(same, turn.abs() / run, torch.zeros_like(turn))
    sharpest = bend.new_zeros(len(curves)).scatter_reduce(0, curves.curve[lag:], bend, "amax")
    return (0.25 / sharpest.clamp_min(1e-6)).clamp(shortest, longest)


def _fitted(
    point: Float[Tensor, "m 3"],
    curve: Int[Tensor, " m"],
    share: Float[Tensor, " m"],
    weight: Float[Tensor, " m"],
    count: Int[Tensor, " n"],
    kind: Int[Tensor, " n"],
) -> Curves:
    """Splines through points at `share` (0 to 1) of their curves."""
    first = spline.starts(count)
    n = len(count)
    total = group_sum(weight, curve, n).clamp_min(1e-12)
    centre = group_sum(weight[:, None] * point, curve, n) / total[:, None]
    t = share.clamp(0, 1) * (count[curve] - 1)
    start, row, _ = spline.window(t, count[curve])
    # Third differences of the coefficients: a change of curvature.
    owner, rank = spline.rows(count)
    inner = (rank < count[owner] - 3).nonzero()[:, 0]
    bend = row.new_tensor((-1.0, 3.0, -3.0, 1.0)).expand(len(inner), 4)
    # A curve without any weight would be undetermined.
    price = _STIFFNESS * total / count
    coefficient = solve_banded(
        torch.cat((first[curve] + start, inner)),
        torch.cat((row, bend)),
        torch.cat((point - centre[curve], point.new_zeros(len(inner), 3))),
        torch.cat((weight, price[owner[inner]])),
        int(count.sum()),
    )
    control = spline.from_coefficients_flat(coefficient, count) + centre[owner]
    return curves_of(control, count, kind)


def select_curves(curves: Curves, keep: Bool[Tensor, " n"]) -> Curves:
    """Only the curves in `keep`."""
    owner, _ = spline.rows(curves.count)
    return curves_of(curves.control[keep[owner]], curves.count[keep], curves.kind[keep])


def curves_of(
    control: Float[Tensor, "c 3"], count: Int[Tensor, " n"], kind: Int[Tensor, " n"]
) -> Curves:
    """Curves with the points along them that they are looked up by."""
    curve, t = even_parameters(control, count, _STEP)
    point, direction, slope = places(control, count, t, curve)
    return Curves(
        control=control,
        count=count,
        point=point,
        direction=direction,
        slope=slope,
        station=stations(point, curve, len(count))[0],
        curve=curve,
        kind=kind,
    )


def _counts(length: Float[Tensor, " n"], spacing: Float[Tensor, " n"]) -> Int[Tensor, " n"]:
    return (length / spacing).round().long().clamp_min(3) + 1


def overlap(
    owner: Int[Tensor, " m"], curve: Int[Tensor, " m"], station: Float[Tensor, " m"], curves: int
) -> Float[Tensor, " m"]:
    """How many samples of the same owner share each sample's stretch of four metres."""
    bin_of = (station / 4.0).floor().long().clamp_min(0)
    bins = int(bin_of.max()) + 1 if len(bin_of) else 1
    _, key = torch.unique((owner * curves + curve) * bins + bin_of, return_inverse=True)
    return torch.bincount(key)[key].to(station)


def _argmin_by(
    value: Float[Tensor, " m"], group: Int[Tensor, " m"], groups: int
) -> Int[Tensor, " g"]:
    """Row of the smallest value of each group; the first of equals."""
    low = value.new_full((groups,), torch.inf).scatter_reduce(0, group, value, "amin")
    rows = torch.arange(len(value), device=value.device)
    is_low: Bool[Tensor, " m"] = value == low[group]
    first = torch.full((groups,), len(value), dtype=torch.int64, device=value.device)
    return first.scatter_reduce(0, group[is_low], rows[is_low], "amin")


def _mean_by(value: Float[Tensor, " m"], key: Int[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Mean over the rows with the same key, for each row."""
    _, group = torch.unique(key, return_inverse=True)
    number = torch.bincount(group)
    return (group_sum(value, group, len(number)) / number)[group]
