"""Lane curves: natural cubic splines fitted to the samples of many lines, and which samples lie on which (V-A.2)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from crowdmap_torch.clustering.groups import group_argmin, group_sum
from crowdmap_torch.crowd_lanes.line_samples import (
    MAX_ANGLE_COS,
    LineSamples,
    along_axis,
    left_of_axis,
    points_along,
    stations,
)
from crowdmap_torch.geometry import spline_basis
from crowdmap_torch.optim.banded_least_squares import solve_banded
from crowdmap_torch.tables import Rows

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

    def shifted(self, offset: Float[Tensor, "s 3"]) -> Match:
        """The same samples on the same curves, each sample moved by its row of `offset`."""
        return replace(
            self,
            lateral=self.lateral + (self.normal * offset[:, :2]).sum(1),
            height=self.height + offset[:, 2],
        )


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
    found = _candidates(samples, curves, gate)
    found = found[found.height.abs() < height_gate]
    curve = curves.curve[found.row]
    # Of each sample and curve the nearest point, then of each sample the best curve.
    _, pair_of = torch.unique(found.sample * len(curves) + curve, return_inverse=True)
    found = found[group_argmin(found.ahead.abs(), pair_of)]
    curve, aside = curves.curve[found.row], found.lateral.abs()
    key = samples.track[found.sample] * len(curves) + curve
    _, run, size = torch.unique(key, return_inverse=True, return_counts=True)
    mean = (group_sum(aside, run, len(size)) / size)[run]
    kind, own = samples.kind[found.sample], curves.kind[curve]
    differs = (kind >= 0) & (own >= 0) & (kind != own)
    score = 0.5 * aside + mean + other_kind * differs.to(mean)
    _, sample_of = torch.unique(found.sample, return_inverse=True)
    best = found[group_argmin(score, sample_of)]

    def spread(value: Tensor, none: Tensor) -> Tensor:
        return none.index_put((best.sample,), value)

    axis = spread(curves.direction[best.row], samples.direction)
    return Match(
        curve=spread(curves.curve[best.row], torch.full_like(samples.kind, -1)),
        station=spread(curves.station[best.row] + best.ahead, nothing),
        lateral=spread(best.lateral, nothing),
        height=spread(best.height, nothing),
        normal=torch.stack((-axis[:, 1], axis[:, 0]), dim=1),
        along=spread(best.along, nothing),
    )


@dataclass(frozen=True)
class _Candidates(Rows):
    """Samples beside points of curves."""

    sample: Int[Tensor, " m"]
    row: Int[Tensor, " m"]
    """The point of a curve."""
    ahead: Float[Tensor, " m"]
    """How far ahead of that point the sample lies, along the curve [m]."""
    lateral: Float[Tensor, " m"]
    height: Float[Tensor, " m"]
    along: Float[Tensor, " m"]


def _candidates(samples: LineSamples, curves: Curves, gate: float) -> _Candidates:
    """Samples within `gate` [m] sideways of the nearest points of curves that run their way."""
    tree = KDTree(curves.point[:, :2].detach().cpu().numpy())
    k = min(8, len(curves.point))
    place = samples.point[:, :2].detach().cpu().numpy()
    _, near = tree.query(place, k=k, distance_upper_bound=gate + _STEP, workers=-1)
    near = torch.from_numpy(near.reshape(len(samples), k)).to(samples.kind.device)
    sample, slot = (near < len(curves.point)).nonzero(as_tuple=True)
    row = near[sample, slot]
    axis = curves.direction[row]
    delta = samples.point[sample] - curves.point[row]
    ahead = along_axis(delta, axis)
    found = _Candidates(
        sample,
        row,
        ahead,
        lateral=left_of_axis(delta, axis),
        height=delta[:, 2] - ahead * curves.slope[row],
        along=along_axis(samples.direction[sample], axis),
    )
    is_beside = (found.lateral.abs() < gate) & (ahead.abs() < 0.75 * _STEP)
    return found[is_beside & (found.along.abs() > MAX_ANGLE_COS)]


def nearest_row(curves: Curves, matched: Match) -> Int[Tensor, " s"]:
    """The point of its curve that each matched sample is nearest to; -1 for the others."""
    if not len(curves):
        return torch.full_like(matched.curve, -1)
    far = float(curves.station.max()) + 10.0
    x = curves.station + curves.curve * far
    y = matched.station.clamp_min(0) + matched.curve.clamp_min(0) * far
    above = torch.searchsorted(x, y).clamp(1, max(len(x) - 1, 1))
    row = torch.where(y - x[above - 1] < x[above.clamp_max(len(x) - 1)] - y, above - 1, above)
    return torch.where(matched.curve >= 0, row, -1)


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
    # Where no sample lies the curve is kept as it was, more or less.
    hold = torch.cat((weight, torch.full_like(curves.station, 1e-3)))
    return _fitted(
        torch.cat((samples.point[used], curves.point)),
        torch.cat((curve, curves.curve)),
        torch.cat((station, curves.station)) / length[torch.cat((curve, curves.curve))],
        hold,
        count,
        curves.kind,
    )


def knot_spacing(curves: Curves, bounds: tuple[float, float]) -> Float[Tensor, " n"]:
    """Distance between control points [m]: a quarter of the sharpest radius, within bounds."""
    angle = torch.atan2(curves.direction[:, 1], curves.direction[:, 0])
    lag = 8  # over less, noise looks like a bend
    if len(angle) <= lag:
        return torch.full((len(curves),), bounds[1]).to(curves.control)
    turn = torch.remainder(angle[lag:] - angle[:-lag] + torch.pi, 2 * torch.pi) - torch.pi
    run = (curves.station[lag:] - curves.station[:-lag]).clamp_min(1e-3)
    same = curves.curve[lag:] == curves.curve[:-lag]
    bend = torch.where(same, turn.abs() / run, torch.zeros_like(turn))
    sharpest = bend.new_zeros(len(curves)).scatter_reduce(0, curves.curve[lag:], bend, "amax")
    return (0.25 / sharpest.clamp_min(1e-6)).clamp(*bounds)


def _fitted(
    point: Float[Tensor, "m 3"],
    curve: Int[Tensor, " m"],
    share: Float[Tensor, " m"],
    weight: Float[Tensor, " m"],
    count: Int[Tensor, " n"],
    kind: Int[Tensor, " n"],
) -> Curves:
    """Splines through points at `share` (0 to 1) of their curves."""
    first = spline_basis.starts(count)
    n = len(count)
    total = group_sum(weight, curve, n).clamp_min(1e-12)
    centre = group_sum(weight[:, None] * point, curve, n) / total[:, None]
    t = share.clamp(0, 1) * (count[curve] - 1)
    start, row, _ = spline_basis.window(t, count[curve])
    # Third differences of the coefficients: a change of curvature.
    owner, rank = spline_basis.rows(count)
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
    control = spline_basis.from_coefficients_flat(coefficient, count) + centre[owner]
    return curves_of(control, count, kind)


def select_curves(curves: Curves, keep: Bool[Tensor, " n"]) -> Curves:
    """Only the curves in `keep`."""
    owner, _ = spline_basis.rows(curves.count)
    return curves_of(curves.control[keep[owner]], curves.count[keep], curves.kind[keep])


def curves_of(
    control: Float[Tensor, "c 3"], count: Int[Tensor, " n"], kind: Int[Tensor, " n"]
) -> Curves:
    """Curves with the points along them that they are looked up by."""
    along = points_along(control, count, _STEP)
    return Curves(
        control=control,
        count=count,
        point=along.point,
        direction=along.direction,
        slope=along.slope,
        station=stations(along.point, along.spline, len(count))[0],
        curve=along.spline,
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
