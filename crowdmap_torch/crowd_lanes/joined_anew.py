"""V-A.2, unlike the paper: lane pieces joined anew where an adjusted map has markers twice.

Drives that were placed half a metre beside where they are make up markers of their own. The adjustment brings these to one
place; where it found the drives to be, their pieces are of one marker.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from crowdmap_torch.clustering.neighbours import pairs_in_radius
from crowdmap_torch.crowd_lanes.join import JoinedLanes, LaneJoinConfig, join_lanes, unbiased_pieces
from crowdmap_torch.crowd_lanes.line_samples import points_along, runs_along
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.tables import Lanes

_STEP = 1.0
"""Lanes are compared at points this far apart [m]."""


def joined_anew(
    lanes: Lanes,
    made: Sequence[Lanes],
    drifts: Sequence[Float[Tensor, "_ 6"]],
    trusted: Sequence[Bool[Tensor, " _"]],
    positioning: PositioningNoise,
    config: LaneJoinConfig,
) -> JoinedLanes | None:
    """The markers that the journeys' pieces make up by adjusted poses; None if the adjusted `lanes` are as good.

    `made` are the pieces of each journey, `drifts` the tangents from its given poses to the adjusted ones, per frame, of
    which only those that are `trusted` count. Lanes are as good where little of them is there twice, or no less of what
    would come in their place: two markers side by side are two.
    """
    twice = share_twice(lanes, config.twice_within_m)
    if twice < config.anew_from:
        return None
    joined = join_lanes(unbiased_pieces(made, drifts, trusted), positioning, config)
    return joined if share_twice(joined.lanes, config.twice_within_m) < twice / 2 else None


def share_twice(lanes: Lanes, within: float, *, height_gate: float = 2.0) -> float:
    """The share of all lanes' length that another one runs along, `within` [m] sideways; of two that do, both count."""
    packed = lanes.select(torch.arange(len(lanes), device=lanes.journey.device))
    at = points_along(packed.control.point_world, packed.control_count, _STEP)
    pair = pairs_in_radius(at.point[:, :2], (within**2 + _STEP**2) ** 0.5)
    pair = pair[at.spline[pair[:, 0]] != at.spline[pair[:, 1]]]
    i, j = torch.cat((pair, pair.flip(1))).T
    delta, axis, other = at.point[j] - at.point[i], at.direction[i], at.direction[j]
    beside = runs_along(delta, axis, other, within=within, along=_STEP, height=height_gate)
    return len(torch.unique(i[beside])) / max(len(at), 1)
