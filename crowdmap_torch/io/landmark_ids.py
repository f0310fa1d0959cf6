"""Names of landmarks, from the first detection of each: a landmark keeps its name when journeys are added."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from crowdmap_torch.tables import Association, Journey, Lanes, Signs


def sign_ids(
    journeys: Sequence[Journey], associations: Sequence[Association], signs: Signs
) -> tuple[str, ...]:
    """A name for every sign: of its first detection, or of its tracklet where no detection names it."""
    first = _first_detections(
        [a.sign for a in associations], [j.t_ns[j.signs.frame] for j in journeys], len(signs)
    )
    names = [_name(journeys, "sign", found) for found in first]
    for row, name in enumerate(names):
        if not name:
            journey, tracklet = int(signs.journey[row]), int(signs.tracklet[row])
            names[row] = _digest("sign", journeys[journey].journey_id, f"tracklet-{tracklet}")
    return tuple(names)


def lane_ids(
    journeys: Sequence[Journey], associations: Sequence[Association], lanes: Lanes
) -> tuple[str, ...]:
    """A name for every lane: of its first detection, or of its place in the map where no detection names it."""
    first = _first_detections(
        [a.lane for a in associations], [j.t_ns[j.lanes.frame] for j in journeys], len(lanes)
    )
    names = [_name(journeys, "lane", found) for found in first]
    return tuple(name or _digest("lane", "row", str(row)) for row, name in enumerate(names))


def _first_detections(
    label: Sequence[Int[Tensor, " _"]], t_ns: Sequence[Int[Tensor, " _"]], count: int
) -> list[tuple[int, int]]:
    """Journey and row of the earliest detection of every landmark; (-1, -1) where there is none."""
    if not label:
        return [(-1, -1)] * count
    every, time = torch.cat(list(label)), torch.cat(list(t_ns))
    journey = torch.repeat_interleave(
        torch.arange(len(label), device=every.device),
        torch.tensor([len(part) for part in label], device=every.device),
    )
    row = torch.cat([torch.arange(len(part), device=every.device) for part in label])
    order = torch.argsort(time, stable=True)
    order = order[every[order] >= 0]
    found = np.full((count, 2), -1)
    # What comes first in time is the earliest of its landmark.
    landmark, earliest = np.unique(every[order].cpu().numpy(), return_index=True)
    found[landmark] = torch.stack((journey, row), dim=1)[order].cpu().numpy()[earliest]
    return [(int(j), int(r)) for j, r in found]


def _name(journeys: Sequence[Journey], kind: str, found: tuple[int, int]) -> str:
    number, row = found
    if number < 0:
        return ""
    journey = journeys[number]
    detections = journey.signs if kind == "sign" else journey.lanes
    # Not its row in the file: the same rows in another order are the same journey.
    frame = int(detections.frame[row])
    place = int((detections.frame[:row] == frame).sum())
    return _digest(kind, journey.journey_id, f"{int(journey.frame_number[frame])}/{place}")


def _digest(kind: str, journey_id: str, what: str) -> str:
    text = f"{kind}/{journey_id}/{what}"
    return f"{kind}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"
