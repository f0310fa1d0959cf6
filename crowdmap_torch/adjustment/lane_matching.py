"""Which point of which spline a lane point shows: found once in the world, then followed in the image between steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from crowdmap_torch.adjustment.observations import LanePointObservations
from crowdmap_torch.clustering.neighbours import layered
from crowdmap_torch.crowd_lanes.table import LaneSupport
from crowdmap_torch.geometry import spline_basis
from crowdmap_torch.processes.amounts import at_once
from crowdmap_torch.processes.threads import in_order
from crowdmap_torch.residuals.reprojection import MIN_DEPTH
from crowdmap_torch.tables import Lanes, Rows, Tracklets, concatenate

_STEPS = 4
"""Gauss-Newton steps along the projected spline; it is nearly straight at a lane point's scale."""
_AT_ONCE = 1 << 14
"""Lane points that are followed at once on a CPU."""
_SLACK = 0.05
"""Knots beyond a spline's end at which a match is lost, and within it at which a lost one is taken up again."""


@dataclass(frozen=True)
class LaneMatches(Rows):
    """The spline point that each lane point is held against."""

    lane: Int[Tensor, " m"]
    t: Float[Tensor, " m"]
    """Parameter of the closest point, in knots."""
    normal_px: Float[Tensor, "m 2"]
    """Image normal of the projected spline there."""
    valid: Bool[Tensor, " m"]
    """False where the closest point is beyond the spline's end or behind the camera; `follow` looks at what was."""

    def windows(self, count: Int[Tensor, " n"]) -> tuple[Int[Tensor, "m 4"], Float[Tensor, "m 4"]]:
        """The four coefficients that make up each one's point, and their weights, of splines with `count` each."""
        start, own = spline_basis.starts(count)[self.lane], count[self.lane]
        coefficient, weight, _ = spline_basis.window_flat(self.t.clamp_min(0), start, own)
        return coefficient, weight

    def points(
        self, coefficient: Float[Tensor, "c k"], count: Int[Tensor, " n"]
    ) -> Float[Tensor, "m k"]:
        """The points themselves; or what else is said of coefficients, between them."""
        own, weight = self.windows(count)
        return (weight[..., None] * coefficient[own]).sum(1)


@dataclass(frozen=True)
class Shifts(Rows):
    """What lies between a spline point and where a true camera and its detector see it, beside what is stated of them."""

    world: Float[Tensor, "m 3"]
    """Of the point, along the world's axes [m]."""
    px: Float[Tensor, "m 2"]
    """Of the pixel, where that point is seen."""


def nearest_lanes(
    point_world: Float[Tensor, "m 3"],
    lanes: Lanes,
    *,
    gate: float,
    of: Int[Tensor, " m"] | None = None,
) -> tuple[Int[Tensor, " m"], Float[Tensor, " m"]]:
    """Nearest lane within `gate` metres horizontally (-1: none) and the parameter of its nearest sample.

    Where lanes are asked for, those or none.
    """
    count = lanes.control_count
    none = torch.full((len(point_world),), -1, device=point_world.device)
    if not len(lanes) or not len(point_world):
        return none, torch.zeros_like(point_world[:, 0])
    piece, t = sample_parameters(lanes, spacing=0.5)
    samples = spline_basis.evaluate_flat(lanes.control.point_world, count, t, piece)
    # Heights of a first guess are off by more than markers are apart; a bridge is not.
    squash = samples.new_tensor([1.0, 1.0, 0.3])
    samples, point_world = samples * squash, point_world * squash
    if of is not None:
        samples, point_world = (
            layered(x, k, gate) for x, k in ((samples, piece), (point_world, of))
        )
    index, found = _nearest(samples, point_world, gate)
    return torch.where(found, piece[index], none), t[index]


def supported_lanes(
    point_world: Float[Tensor, "m 3"],
    points: LanePointObservations,
    tracklets: Sequence[Tracklets],
    support: LaneSupport,
    *,
    reach: float,
) -> Int[Tensor, " m"]:
    """The lane that clustering found the nearest sample of each point's own tracklet to be of.

    -1 where that is none, where the point is of no tracklet, or where no sample of it is within `reach` metres.
    """
    none = torch.full_like(points.detection, -1)
    if not len(points) or not len(support):
        return none
    count = [len(one.label) for one in tracklets]
    first = torch.tensor([0, *accumulate(count)], device=none.device)[:-1]
    tracklet = torch.cat([one.label for one in tracklets])[first[points.journey] + points.detection]
    every = 1 + int(torch.maximum(tracklet.max(), support.tracklet.max()))
    sample = layered(support.point_world, support.journey * every + support.tracklet, reach)
    index, found = _nearest(
        sample, layered(point_world, points.journey * every + tracklet, reach), reach
    )
    return torch.where(found & (tracklet >= 0), support.lane[index], none)


def _nearest(
    samples: Float[Tensor, "s k"], point: Float[Tensor, "m k"], reach: float
) -> tuple[Int[Tensor, " m"], Bool[Tensor, " m"]]:
    """The nearest sample of each point, and whether it is within reach."""
    distance, index = KDTree(samples.cpu().numpy()).query(
        point.cpu().numpy(), distance_upper_bound=reach
    )
    found = torch.as_tensor(distance, device=point.device) < reach
    index = torch.as_tensor(index, device=point.device)
    return index.clamp_max(len(samples) - 1), found


def sample_parameters(
    lanes: Lanes, *, spacing: float
) -> tuple[Int[Tensor, " s"], Float[Tensor, " s"]]:
    """Pieces and parameters of samples about `spacing` metres apart along every lane, both ends included."""
    count = lanes.control_count
    point = lanes.control.point_world
    piece = lanes.piece_of_control
    chord = (point[1:] - point[:-1]).norm(dim=-1) * (piece[1:] == piece[:-1])
    length = point.new_zeros(len(lanes)).index_add_(0, piece[:-1], chord)
    samples = (length / spacing).ceil().long().clamp_min(1) + 1
    of, rank = spline_basis.rows(samples)
    return of, rank.to(point) * (count[of] - 1) / (samples[of] - 1)


def follow(
    matches: LaneMatches,
    observations: LanePointObservations,
    T_world_camera: Float[Tensor, "m 4 4"],
    coefficient: Float[Tensor, "c 3"],
    count: Int[Tensor, " n"],
    *,
    shifts: Shifts | None = None,
    begun: Float[Tensor, " m"] | None = None,
) -> LaneMatches:
    """The matches moved to the closest points of the projected splines, from where they were (V-B).

    Closest is what is seen, by cameras and detectors with their `shifts`: there alone does the error not depend on where
    along the spline it is taken. Done between steps of the solver: inside the residual it would make the Jacobian jump.
    Those that had `begun` with these parameters slide no further than the stretches between control points next to theirs.
    """

    def some(at: slice) -> LaneMatches:
        where = T_world_camera[at], coefficient, count
        own = None if shifts is None else shifts[at]
        first = None if begun is None else begun[at]
        return _followed(matches[at], observations[at], *where, own, first)

    lot = at_once(_AT_ONCE, coefficient.device)
    every = [slice(a, a + lot) for a in range(0, len(matches), lot)]
    return concatenate(list(in_order(some, every, coefficient.device))) if every else matches


def _followed(
    matches: LaneMatches,
    observations: LanePointObservations,
    T_world_camera: Float[Tensor, "m 4 4"],
    coefficient: Float[Tensor, "c 3"],
    count: Int[Tensor, " n"],
    shifts: Shifts | None,
    begun: Float[Tensor, " m"] | None,
) -> LaneMatches:
    """The same of a few: at once they fit a processor's cache."""
    start = spline_basis.starts(count)[matches.lane]
    own = count[matches.lane]
    t = matches.t
    position, shift_px = T_world_camera[:, :3, 3], torch.zeros_like(matches.normal_px)
    if shifts is not None:
        position = position - shifts.world
        shift_px = shifts.px
    M = observations.matrix @ T_world_camera[:, :3, :3].mT
    last = (own - 1).to(t)
    # Half a knot beyond either end is far enough to see that the point is not on this spline.
    least, most = torch.full_like(t, -0.5), last + 0.5
    if begun is not None:
        begun = begun.floor()
        least = torch.maximum(least, begun - 1)
        most = torch.minimum(most, torch.nextafter(begun + 2, begun))
    y, error, tangent = _projected(t, start, own, coefficient, M, position)
    for _ in range(_STEPS):
        change = ((error + shift_px) * tangent).sum(-1) / tangent.square().sum(-1).clamp_min(1e-12)
        t = torch.minimum(torch.maximum(t - change.clamp(-2, 2), least), most)
        y, error, tangent = _projected(t, start, own, coefficient, M, position)
    tangent = torch.nn.functional.normalize(tangent, dim=-1)
    normal = torch.stack((-tangent[:, 1], tangent[:, 0]), dim=-1)
    # At one border for both ways a match may come and go with every step, each step undoing the last one.
    slack = torch.where(matches.valid, _SLACK, -_SLACK).to(t)
    valid = (y[:, 2] > 1.0) & (t >= -slack) & (t <= last + slack)
    return replace(matches, t=t, normal_px=normal, valid=valid)


def _projected(
    t: Float[Tensor, " m"],
    start: Int[Tensor, " m"],
    count: Int[Tensor, " m"],
    coefficient: Float[Tensor, "c 3"],
    matrix: Float[Tensor, "m 3 3"],
    position: Float[Tensor, "m 3"],
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 2"], Float[Tensor, "m 2"]]:
    """Spline points in the observations' frames, their pixel errors, and how these move with the parameter."""
    rows, weight, d_weight = spline_basis.window_flat(t, start, count)
    beside = coefficient[rows]
    at, along = ((w[:, None] @ beside)[:, 0] for w in (weight, d_weight))
    y = (matrix @ (at - position)[..., None])[..., 0]
    dy = (matrix @ along[..., None])[..., 0]
    depth = y[:, 2:].clamp_min(MIN_DEPTH)
    error = y[:, :2] / depth
    return y, error, (dy[:, :2] - error * dy[:, 2:]) / depth
