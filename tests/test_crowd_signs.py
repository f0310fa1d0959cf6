"""Leaps of a journey's positions."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from crowdmap_torch.crowd_signs import largest_leap
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
    gapped = replace(journey, T_world_camera=journey.T_world_camera[kept], t_ns=journey.t_ns[kept])
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
        short = replace(
            journey, T_world_camera=journey.T_world_camera[:count], t_ns=journey.t_ns[:count]
        )
        assert float(largest_leap(short)) == 0.0
