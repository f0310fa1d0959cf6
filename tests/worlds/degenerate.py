"""Drives with too little in them, or all of it wrong, made of sound ones: none may end in an error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor
from worlds.drives import turn_about_up, with_frames

from crowdmap_torch.io.truth import JourneyTruth, Truth
from crowdmap_torch.tables import Journey, Rows

FRAMES = 40
"""Frames of each drive that are kept, those before the sign that is seen most often goes by."""

Kind = Callable[[list[Journey], list[Tensor]], list[Journey]]


def degenerate(truth: Truth, kind: str) -> tuple[Journey, ...]:
    """The journeys of one of `KINDS`."""
    cut = [_cut(drive) for drive in truth.journeys]
    return tuple(KINDS[kind]([journey for journey, _ in cut], [sign for _, sign in cut]))


def _cut(drive: JourneyTruth) -> tuple[Journey, Tensor]:
    """The end of a drive, and for each detection whether it shows the sign that is seen most often."""
    shown = drive.sign[drive.journey.signs.row]
    most = int(shown[shown >= 0].mode().values)
    last = int(drive.journey.signs.frame[shown == most].max()) + 1
    frames = torch.arange(max(last - FRAMES, 0), last)
    rows = torch.nonzero(drive.journey.signs.frame == frames[:, None])[:, 1]
    return with_frames(drive.journey, frames), shown[rows] == most


def _rows(journey: Journey, *, signs: Tensor | None = None, lanes: bool = True) -> Journey:
    """The journey with these of its sign detections, with or without lanes."""
    if signs is not None:
        journey = replace(journey, signs=journey.signs[signs])
    if lanes:
        return journey
    none = torch.zeros(0, dtype=torch.int64)
    return replace(journey, lanes=journey.lanes[none], lane_points=journey.lane_points[none])


def _none(journey: Journey) -> Tensor:
    return torch.zeros(len(journey.signs), dtype=torch.bool)


def _one_frame(journey: Journey) -> Journey:
    return with_frames(journey, torch.tensor([journey.frame_count - 1]))


def _scattered(journey: Journey) -> Journey:
    """Every detection somewhere else in the image."""
    generator = torch.Generator().manual_seed(0)

    def moved(table: Rows, of: Tensor, count: int, *columns: str) -> Rows:
        offset = torch.randn(count, 2, generator=generator, dtype=torch.float64)[of]
        changed = {}
        for name in columns:
            points = getattr(table, name)
            # Pixels and what they are without the lens, 1000 of them in a unit.
            by = 200 * offset if name.endswith("px") else 0.2 * offset
            changed[name] = points + by.reshape(-1, *(1,) * (points.ndim - 2), 2)
        return replace(table, **changed)

    n, every = len(journey.signs), torch.arange(len(journey.signs))
    detection = journey.lane_points.detection
    return replace(
        journey,
        signs=moved(journey.signs, every, n, "corners_px", "corners_ideal"),
        lane_points=moved(journey.lane_points, detection, len(journey.lanes), "px", "ideal"),
    )


def _standing(journey: Journey) -> Journey:
    """A car that stays where it is at the end and goes on detecting what it sees."""
    generator = torch.Generator().manual_seed(0)
    still = with_frames(journey, torch.full((FRAMES,), journey.frame_count - 1))
    T, corners = still.T_world_camera.clone(), still.signs.corners_px
    T[:, :3, 3] += 0.01 * torch.randn(FRAMES, 3, generator=generator, dtype=torch.float64)
    noise = 0.3 * torch.randn(corners.shape, generator=generator, dtype=torch.float64)
    signs = replace(
        still.signs,
        corners_px=corners + noise,
        corners_ideal=still.signs.corners_ideal + 1e-3 * noise,
    )
    return replace(still, T_world_camera=T, signs=signs)


def _reversed(journey: Journey) -> Journey:
    """The drive back: the road turned end for end, and the same seen again."""
    half = turn_about_up(torch.pi, (0.0, 0.0, 0.0))
    there = journey.T_world_camera[:, :3, 3].mean(0)
    T = journey.T_world_camera.clone()
    T[:, :3, 3] -= there
    T = half @ T
    T[:, :3, 3] += there
    return replace(journey, T_world_camera=T)


def _far(journey: Journey) -> Journey:
    return replace(
        journey, T_world_camera=turn_about_up(0.0, (8000.0, 0.0, 0.0)) @ journey.T_world_camera
    )


KINDS: dict[str, Kind] = {
    "one journey": lambda journeys, shown: journeys[:1],
    "one frame": lambda journeys, shown: [_one_frame(j) for j in journeys],
    "one frame of one journey": lambda journeys, shown: [_one_frame(journeys[0])],
    "no signs": lambda journeys, shown: [_rows(j, signs=_none(j)) for j in journeys[:2]],
    "no lanes": lambda journeys, shown: [_rows(j, lanes=False) for j in journeys[:2]],
    "no detections": lambda journeys, shown: [
        _rows(j, signs=_none(j), lanes=False) for j in journeys
    ],
    "outliers only": lambda journeys, shown: [_scattered(j) for j in journeys[:2]],
    "all standing": lambda journeys, shown: [_standing(j) for j in journeys[:2]],
    "the same twice": lambda journeys, shown: [journeys[0], journeys[0]],
    "there and back": lambda journeys, shown: [journeys[0], _reversed(journeys[1])],
    "never meeting": lambda journeys, shown: [journeys[0], _far(journeys[1])],
    "one sign": lambda journeys, shown: [
        _rows(j, signs=s, lanes=False) for j, s in zip(journeys, shown, strict=True)
    ],
    "three detections": lambda journeys, shown: [
        _rows(journeys[0], signs=shown[0].nonzero()[-3:, 0], lanes=False)
    ],
}
"""What is left of sound drives; the second argument says which detections show one sign that all saw."""
