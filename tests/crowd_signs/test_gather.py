"""Leaps of a journey's positions, and signs seen beside each other."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.drives import without_detections

from crowdmap_torch.crowd_signs.gather import largest_leap, pairs_seen_together
from crowdmap_torch.tables import Dataset, Journey


def moved(journey: Journey, frame: int, by: list[float]) -> Journey:
    """The journey whose positions are off from a frame on."""
    T = journey.T_world_camera.clone()
    T[frame:, :3, 3] += torch.tensor(by, dtype=T.dtype)
    return replace(journey, T_world_camera=T)


def test_ordinary_drives_do_not_leap(tiny: Dataset):
    for journey in tiny.journeys:
        assert float(largest_leap(journey)) < 0.3


@pytest.mark.parametrize("by", [[8.0, 0.0, 0.0], [0.0, -8.0, 0.0], [-6.0, 6.0, 0.0]])
def test_a_jump_in_any_direction_is_a_leap_of_its_length(tiny: Dataset, by: list[float]):
    journey = tiny.journeys[0]
    leap = float(largest_leap(moved(journey, journey.frame_count // 2, by)))
    # Less what brakes and tyres might explain, and the noise of the positions: some centimetres a frame.
    assert leap == pytest.approx(torch.tensor(by).norm().item(), abs=0.5)


def test_a_gap_in_the_frames_is_no_leap(tiny: Dataset):
    journey = tiny.journeys[0]
    kept = torch.ones(journey.frame_count, dtype=torch.bool)
    kept[journey.frame_count // 2 : journey.frame_count // 2 + 30] = False
    gapped = without_detections(journey, kept.nonzero()[:, 0])
    assert float(largest_leap(gapped)) < 0.5


def test_times_that_jitter_are_no_leap(tiny: Dataset, generator: torch.Generator):
    journey = tiny.journeys[0]
    late = 1e8 * torch.rand(journey.frame_count, generator=generator, dtype=torch.float64)
    # Still one after the other, some of them a millisecond apart.
    t_ns = (journey.t_ns + late.long()).cummax(0)[0] + 10**6 * torch.arange(journey.frame_count)
    jittered = replace(journey, t_ns=t_ns)
    assert float(largest_leap(jittered)) < 0.5
    jump = moved(jittered, journey.frame_count // 2, [8.0, 0.0, 0.0])
    # Of a step that seems to have taken a tenth of a second more, brakes explain more.
    assert float(largest_leap(jump)) == pytest.approx(8.0, abs=1.5)


def test_one_or_two_frames_do_not_leap(tiny: Dataset):
    journey = tiny.journeys[0]
    for count in (0, 1, 2):
        short = without_detections(journey, torch.arange(count))
        assert float(largest_leap(short)) == 0.0


def test_pairs_seen_together_are_beside_each_other_in_a_frame():
    sign = torch.tensor([0, 1, 2, 2, 3, 1, 0, 4])
    frame = torch.tensor([0, 0, 0, 1, 1, 2, 3, 3])
    u = torch.tensor([0.0, 0.1, 0.3, 0.3, 0.4, 0.1, 0.0, 0.02])
    extent = torch.full((8,), 0.06)
    pairs = pairs_seen_together(sign, frame, torch.stack((u, 0 * u), dim=1), extent, 5)
    # Signs 0 and 4 lie on top of each other in frame 3: one sign detected twice.
    assert pairs.tolist() == [[0, 1], [0, 2], [1, 2], [2, 3]]
