"""Which lane of the map each lane detection shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.lane_matching import nearest_lanes
from crowdmap_torch.geometry import plane
from crowdmap_torch.tables import Association, Journey, Lanes, RoadEstimate


def with_lanes(
    associations: Sequence[Association],
    journeys: Sequence[Journey],
    roads: Sequence[RoadEstimate],
    poses: Sequence[Float[Tensor, "_ 4 4"]],
    lanes: Lanes,
    *,
    gate: float,
) -> tuple[Association, ...]:
    """The associations with the lane that each lane detection of the journeys shows, by their `detection_lanes`."""
    drives = zip(associations, journeys, roads, poses, strict=True)
    return tuple(
        replace(association, lane=detection_lanes(journey, road, pose, lanes, gate=gate))
        for association, journey, road, pose in drives
    )


def detection_lanes(
    journey: Journey,
    road: RoadEstimate,
    T_world_camera: Float[Tensor, "f 4 4"],
    lanes: Lanes,
    *,
    gate: float,
    points: int = 4,
    reach: float = 30.0,
) -> Int[Tensor, " l"]:
    """The lane that most of each lane detection's nearest `points` on the road lie on; -1 for none.

    Points that meet the road further than `reach` metres ahead tell two markers apart no more.
    """
    seen, count = journey.lane_points, len(journey.lanes)
    frame = journey.lanes.frame[seen.detection]
    ray = torch.nn.functional.pad(seen.ideal, (0, 1), value=1.0)
    h = road.normal_camera[frame] * road.height[frame, None]
    distance = h.square().sum(-1) / (h * ray).sum(-1)
    distance = torch.where((distance > 0) & (distance < reach), distance, torch.inf)
    order = torch.argsort(distance, stable=True)
    order = order[torch.argsort(seen.detection[order], stable=True)]
    rank = torch.arange(len(order), device=order.device)
    first = torch.searchsorted(seen.detection[order], seen.detection[order])
    order = order[(rank - first < points) & distance[order].isfinite()]
    ground = plane.ground_points(ray[order], h[order], T_world_camera[frame[order]])
    lane, _ = nearest_lanes(ground, lanes, gate=gate)
    found = lane >= 0
    detection, lane = seen.detection[order][found], lane[found]
    label = torch.full((count,), -1, device=order.device)
    if not len(lane):
        return label
    key, votes = torch.unique(detection * len(lanes) + lane, return_counts=True)
    # Most votes first, then the highest lane: one number to take the largest of.
    ballot = votes * len(lanes) + key % len(lanes)
    best = label.scatter_reduce(0, key // len(lanes), ballot, "amax")
    return torch.where(best >= 0, best % len(lanes), label)
