"""V-B, unlike the paper: drives placed by all that signs tell of them, before lane pieces of drives are joined (V-A.2).

Biases of whole drives leave them beside each other by as much as positions drift; where receivers wander by metres within a
kilometre, pieces come to a marker that is not theirs. An adjustment does not part them again: lanes hold the drives where
they were joined. A few of its steps with signs alone take them to their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from itertools import islice

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.adjust import build, read_poses, start, steps
from crowdmap_torch.adjustment.calibration import CalibrationConfig
from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.clustering.groups import group_sum
from crowdmap_torch.crowd_lanes.join import JoinedLanes, LaneJoinConfig, join_lanes, unbiased_pieces
from crowdmap_torch.crowd_signs.completion import AssociatedSigns
from crowdmap_torch.crowd_signs.register import Crowd
from crowdmap_torch.geometry import se3
from crowdmap_torch.tables import Journey, Lanes, RoadEstimate

_FEWER = 0.97
"""What a metre of marker may have of pieces, against what it has without: where signs place drives frame by frame, pieces of
one track lie beside each other sooner, and are left out."""
_STEPS = 4
"""Any more leave drives where they are, to centimetres."""


@torch.no_grad()
def joined_by_signs(
    journeys: Sequence[Journey],
    roads: Sequence[RoadEstimate],
    made: Sequence[Lanes],
    crowd: Crowd,
    found: AssociatedSigns,
    drifts: Sequence[Float[Tensor, "_ 6"]],
    group: Int[Tensor, " j"],
    join: LaneJoinConfig,
    adjust: AdjustConfig,
    calibration: CalibrationConfig,
) -> tuple[tuple[Float[Tensor, "_ 6"], ...], JoinedLanes]:
    """The markers that the journeys' pieces make up, and the tangents from the given poses to those they were joined by.

    These are the `drifts`, without biases, or where that is in doubt what `moved_by_signs` makes of them, unless markers
    fall apart there: where detections of a sign err together for long, signs alone take drives from where they are.
    """
    trusted, positioning = crowd.trusted_frames(journeys), crowd.positioning
    joined = join_lanes(unbiased_pieces(made, drifts, trusted), positioning, join)
    if joined.report.rms_before_m <= join.doubt_m:
        return tuple(drifts), joined
    given = journeys, roads, made, crowd, found, drifts, group
    moved = moved_by_signs(*given, adjust, calibration)
    other = join_lanes(unbiased_pieces(made, moved, trusted), positioning, join)
    if other.report.samples_per_m < _FEWER * joined.report.samples_per_m:
        return tuple(drifts), joined
    return moved, other


@torch.no_grad()
def moved_by_signs(
    journeys: Sequence[Journey],
    roads: Sequence[RoadEstimate],
    made: Sequence[Lanes],
    crowd: Crowd,
    found: AssociatedSigns,
    drifts: Sequence[Float[Tensor, "_ 6"]],
    group: Int[Tensor, " j"],
    config: AdjustConfig,
    calibration: CalibrationConfig,
) -> tuple[Float[Tensor, "_ 6"], ...]:
    """The tangents from the given poses to where an adjustment of the signs that were `found` takes them from `drifts`.

    It moves drives of one `group`, which signs tie together, against each other, and no group as a whole: how groups lie
    beside each other no sign tells. Drives that show no sign stay.
    """
    driven = [replace(j, lanes=j.lanes[:0], lane_points=j.lane_points[:0]) for j in journeys]
    bundle = build(
        *(driven, roads, found.heads, made[0].select(group[:0]), found.associations),
        *(drifts, crowd.positioning, config),
        trusted=crowd.trusted_frames(journeys),
        calibration=calibration,
    )
    is_placed = torch.zeros_like(group, dtype=torch.bool)
    is_placed[bundle.prior.nodes.journey] = True
    if not bool(is_placed.any()):
        return tuple(drifts)
    with closing(steps(bundle, start(bundle))) as taken:
        for _ in islice(taken, _STEPS):
            pass
    given = [journey.T_world_camera for journey in journeys]
    ended = [*map(se3.local, given, read_poses(bundle, driven))]
    way = torch.stack([(new - old)[:, :3].mean(0) for new, old in zip(ended, drifts, strict=True)])
    count, placed = int(group.max()) + 1, is_placed.to(way)[:, None]
    whole = group_sum(way * placed, group, count) / group_sum(placed, group, count).clamp_min(1)
    shift = torch.nn.functional.pad(whole[group], (0, 3))
    return tuple(
        torch.where(moves, new - of_group, old)
        for moves, new, of_group, old in zip(is_placed, ended, shift, drifts, strict=True)
    )
