"""A part of the world, and what a data set has seen from inside it: `crowdmap optimize --bbox`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from crowdmap_torch.io.detections import seen_in
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.truth import JourneyTruth, Truth
from crowdmap_torch.ranges import shown
from crowdmap_torch.tables import Dataset, Journey

MARGIN_M = 50.0
"""Frames up to this far outside are used too: a sign at the border is seen from there."""
OUTSIDE = "in a frame outside the area"
"""Of detections that are left out, in `Journey.dropped` after the kind."""


@dataclass(frozen=True)
class Area:
    """A rectangle of the map's plane: sides in metres east and north of the origin, the borders included."""

    west: float
    south: float
    east: float
    north: float

    def __post_init__(self) -> None:
        """Refuses what has no inside."""
        if not all(math.isfinite(side) for side in self.sides):
            raise ValueError(f"expected four finite numbers, found {self}")
        if not (self.west < self.east and self.south < self.north):
            raise ValueError(f"expected E0 below E1 and N0 below N1, found {self}")

    @property
    def sides(self) -> tuple[float, float, float, float]:
        """E0, N0, E1, N1 [m]."""
        return self.west, self.south, self.east, self.north

    def __str__(self) -> str:
        return ",".join(f"{side:g}" for side in self.sides)

    def holds(
        self, point_world: Float[Tensor, "*batch 3"], *, margin_m: float = 0.0
    ) -> Bool[Tensor, "*batch"]:
        """Whether points lie inside, or within `margin_m` of a side."""
        low = point_world.new_tensor([self.west, self.south]) - margin_m
        high = point_world.new_tensor([self.east, self.north]) + margin_m
        return ((point_world[..., :2] >= low) & (point_world[..., :2] <= high)).all(-1)


def read_area(text: str) -> Area:
    """The area that `E0,N0,E1,N1` says; ValueError where it says none."""
    try:
        sides = [float(part) for part in text.split(",")]
    except ValueError:
        sides = []
    if len(sides) != 4:
        raise ValueError(f"expected E0,N0,E1,N1 in metres, found {shown(text)}")
    return Area(*sides)


def area_of(provenance: Mapping[str, Any]) -> Area | None:
    """The part of the world that a map is of, by its provenance; None where it says nothing that is an area."""
    sides = provenance.get("bbox")
    if not isinstance(sides, list) or len(sides) != 4:
        return None
    if not all(isinstance(side, int | float) and not isinstance(side, bool) for side in sides):
        return None
    try:
        return Area(*map(float, sides))
    except (ValueError, OverflowError):
        return None


@dataclass(frozen=True)
class Cut:
    """How much of a data set an area left out."""

    bbox: tuple[float, float, float, float]
    margin_m: float
    journeys: int
    """That pass through."""
    journeys_outside: int
    frames: int
    frames_outside: int
    sign_detections: int
    sign_detections_outside: int
    lane_detections: int
    lane_detections_outside: int

    def __str__(self) -> str:
        def told(name: str) -> str:
            used = getattr(self, name)
            total = used + getattr(self, f"{name}_outside")
            return f"{used:,} of {total:,} {name.replace('_', ' ')}"

        parts = ", ".join(map(told, ("journeys", "frames", "sign_detections", "lane_detections")))
        sides = ",".join(f"{side:g}" for side in self.bbox)
        return f"area {sides} and {self.margin_m:g} m around it: {parts}"


def cut_dataset(dataset: Dataset, area: Area) -> tuple[Dataset, Cut]:
    """What the drives saw from inside the area, and how much that is of the whole.

    A drive's frames before it first comes in and after it last leaves are gone; between two visits their poses stay, without
    what was detected, so that the drift along the way is what it was. InputError if no drive comes there.
    """
    inside = {journey.journey_id: _near(journey, area) for journey in dataset.journeys}
    journeys = tuple(
        cut_journey(journey, area)
        for journey in dataset.journeys
        if bool(inside[journey.journey_id].any())
    )
    if not journeys:
        raise InputError(f"the area {area}: no drive comes there; they are in {_extent(dataset)}")
    before, after = (
        (sum(len(j.signs) for j in some), sum(len(j.lanes) for j in some))
        for some in (dataset.journeys, journeys)
    )
    frames = sum(int(near.sum()) for near in inside.values())
    return replace(dataset, journeys=journeys, bbox=area.sides), Cut(
        bbox=area.sides,
        margin_m=MARGIN_M,
        journeys=len(journeys),
        journeys_outside=len(dataset.journeys) - len(journeys),
        frames=frames,
        frames_outside=sum(j.frame_count for j in dataset.journeys) - frames,
        sign_detections=after[0],
        sign_detections_outside=before[0] - after[0],
        lane_detections=after[1],
        lane_detections_outside=before[1] - after[1],
    )


def cut_journey(journey: Journey, area: Area) -> Journey:
    """What one drive saw from inside the area; rows keep their numbers, and those left out are counted as dropped.

    ValueError if it never comes there.
    """
    near = _near(journey, area)
    first, end = _visit(near)
    journey = seen_in(journey, near, OUTSIDE)

    def of_frames(column: Tensor | None) -> Tensor | None:
        return None if column is None else column[first:end]

    return replace(
        journey,
        frame_number=journey.frame_number[first:end],
        t_ns=journey.t_ns[first:end],
        T_world_camera=journey.T_world_camera[first:end],
        sigma_position=of_frames(journey.sigma_position),
        sigma_rotation=of_frames(journey.sigma_rotation),
        signs=replace(journey.signs, frame=journey.signs.frame - first),
        lanes=replace(journey.lanes, frame=journey.lanes.frame - first),
    )


def cut_truth(truth: Truth, area: Area) -> Truth:
    """The truth of the drives that come into the area, of what they saw from inside it."""
    return Truth(
        tuple(
            _cut_truth(one, area) for one in truth.journeys if bool(_near(one.journey, area).any())
        )
    )


def _cut_truth(truth: JourneyTruth, area: Area) -> JourneyTruth:
    near = _near(truth.journey, area)
    first, end = _visit(near)
    journey, signs, lanes = truth.journey, truth.journey.signs, truth.journey.lanes
    sign, lane, frame = truth.sign.clone(), truth.lane.clone(), truth.sign_frame.clone()
    # Neither seen nor lost: rows of frames outside are as if they had never been.
    out = signs.row[~near[signs.frame]]
    sign[out], frame[out] = -1, -1
    lane[lanes.row[~near[lanes.frame]]] = -1
    return replace(
        truth,
        journey=cut_journey(journey, area),
        T_world_camera=truth.T_world_camera[first:end],
        sign=sign,
        sign_frame=torch.where(frame >= 0, frame - first, frame),
        lane=lane,
        road_normal_camera=truth.road_normal_camera[first:end],
        camera_height=truth.camera_height[first:end],
    )


def _near(journey: Journey, area: Area) -> Bool[Tensor, " f"]:
    return area.holds(journey.T_world_camera[:, :3, 3], margin_m=MARGIN_M)


def _visit(near: Bool[Tensor, " f"]) -> tuple[int, int]:
    """The first frame inside, and the one after the last."""
    inside = torch.nonzero(near)[:, 0]
    if not len(inside):
        raise ValueError("the drive does not come into the area")
    return int(inside[0]), int(inside[-1]) + 1


def _extent(dataset: Dataset) -> str:
    """Where the drives are, as `--bbox` takes it."""
    position = torch.cat([j.T_world_camera[:, :2, 3] for j in dataset.journeys])
    low, high = position.amin(0), position.amax(0)
    return ",".join(f"{side:.0f}" for side in (*low.floor().tolist(), *high.ceil().tolist()))
