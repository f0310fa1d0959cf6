"""What a run says of its drives in detail: what is left of every corner in the image, and how positions drifted."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.geometry import polygon
from crowdmap_torch.geometry.trajectory import station
from crowdmap_torch.io.sign_outcomes import NamedOutcomes
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.tables import Dataset, Rows

_MOST_PLACES = 200
"""Of a drive's drift."""


@dataclass(frozen=True)
class CornerResiduals(Rows):
    """Projected minus detected corners of signs, of the adjusted map."""

    journey: Int[Tensor, " c"]
    residual_px: Float[Tensor, "c 2"]
    place: Float[Tensor, "c 2"]
    """Where in the image it was detected: shares of its width and height."""
    range_m: Float[Tensor, " c"]
    """From the camera to the sign; NaN of a detection that is in no sign of the map by now."""


@dataclass(frozen=True)
class Drift:
    """How the correction of one drive's positions changes along its way."""

    journey_id: str
    way_m: tuple[float, ...]
    east_m: tuple[float, ...]
    """What is to be added to the given positions, less its mean along the way."""
    north_m: tuple[float, ...]
    up_m: tuple[float, ...]


def corners_of(dataset: Dataset, result: MapResult, found: NamedOutcomes) -> CornerResiduals:
    """Every corner that had a say in the adjustment."""
    rows, signs = found.rows, result.hd_map.signs
    range_m = torch.full((len(rows),), torch.nan, dtype=torch.float64)
    size = torch.ones(len(rows), 2, dtype=torch.float64)
    for number, (journey, pose) in enumerate(zip(dataset.journeys, result.poses, strict=True)):
        mine = torch.nonzero(rows.journey == number)[:, 0]
        size[mine] = size.new_tensor([journey.rig.camera.width, journey.rig.camera.height])
        known = mine[rows.sign[mine] >= 0]
        frame = torch.searchsorted(journey.frame_number, rows.frame[known])
        center = signs.center_world[rows.sign[known]]
        range_m[known] = (center - pose[frame, :3, 3]).norm(dim=-1).double()
    seen = polygon.corner_mask(rows.shape) & rows.residual_px.isfinite().all(-1)
    detection = torch.nonzero(seen)[:, 0]
    return CornerResiduals(
        journey=rows.journey[detection],
        residual_px=rows.residual_px[seen],
        place=rows.corners_px[seen] / size[detection],
        range_m=range_m[detection],
    )


def drifts_of(dataset: Dataset, result: MapResult) -> tuple[Drift, ...]:
    """The drift of each drive that has detections in the map, at some hundred places of its way."""
    found = []
    for journey, pose, association in zip(
        dataset.journeys, result.poses, result.associations, strict=True
    ):
        if not (bool((association.sign >= 0).any()) or bool((association.lane >= 0).any())):
            continue
        given = journey.T_world_camera
        moved = (pose - given)[:, :3, 3]
        step = math.ceil(len(moved) / _MOST_PLACES)
        east, north, up = (moved - moved.mean(0))[::step].T.tolist()
        way = station(given)[::step].tolist()
        found.append(Drift(journey.journey_id, *map(tuple, (way, east, north, up))))
    return tuple(found)
