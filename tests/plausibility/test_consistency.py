from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.winding import winding_drive

from crowdmap_torch.plausibility.consistency import consistency_findings, drive_rays
from crowdmap_torch.tables import Journey, Tracklets


def found(drives: list[tuple[Journey, Tracklets]]):
    return consistency_findings([drive_rays(journey, tracks) for journey, tracks in drives])


def test_rays_of_exact_drives_meet() -> None:
    assert found([winding_drive(seed) for seed in range(5)]) == []


@pytest.mark.parametrize("late", [-2, 1, 3])
def test_frames_that_are_numbered_late_are_named_with_how_many(late: int) -> None:
    (finding,) = found([winding_drive(seed, late=late) for seed in range(5)])
    assert finding.kind == "frame-offset"
    assert f"{abs(late)} frames {'earlier' if late > 0 else 'later'}" in finding.evidence


def test_drives_without_tracked_signs_say_nothing() -> None:
    journey, tracks = winding_drive(0)
    nothing = replace(tracks, label=torch.full_like(tracks.label, -1))
    assert drive_rays(journey, nothing) is None
    assert consistency_findings([None]) == []
