"""Leaps of a journey's positions, and signs seen beside each other."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from worlds.drives import without_detections
from worlds.sign_drive import (
    SignDrive,
    drive_past,
    shift_of,
    signs_at,
    straight_poses,
    tracklets_of,
    with_rows,
)

from crowdmap_torch import mapper
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.crowd_signs.gather import largest_leap, pairs_seen_together, signs_of_crowd
from crowdmap_torch.mapper import FirstMap
from crowdmap_torch.tables import Dataset, Journey

PLACES = [(3.5 * (-1) ** i, 60.0 + 25.0 * i, 2.5) for i in range(6)]
MOMENT = 3
"""The sign that is seen for a moment."""


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


def past(seed: int, *, moment: bool) -> SignDrive:
    """A drive that sees one sign four times from afar, or not at all, and all others at length."""
    drive = drive_past(
        straight_poses(260),
        signs_at(PLACES, yaw_deg=8.0),
        noise_px=1.0,
        depth_m=(20.0, 50.0),
        seed=seed,
    )
    seen = (drive.sign != MOMENT) | (moment & (drive.journey.signs.frame % 8 == 0))
    return with_rows(drive, torch.nonzero(seen)[:, 0])


def mapped(drives: list[SignDrive], config: MapperConfig) -> tuple[FirstMap, list[Tensor]]:
    """The first map, and which signs each drive shows by itself."""
    journeys = [replace(d.journey, journey_id=str(n)) for n, d in enumerate(drives)]
    tracklets = {n: replace(tracklets_of(d.sign), shift=shift_of(d)) for n, d in enumerate(drives)}
    maps = mapper.map_journeys(journeys, config, tracklets=tracklets)
    return mapper.first_map(journeys, maps, config), [m.signs.tracklet for m in maps]


@pytest.mark.parametrize(("moments", "found"), [(1, False), (2, True), (4, True)])
@pytest.mark.parametrize("seed", [0, 100])
def test_a_sign_that_drives_see_for_a_moment_is_one_if_two_do(moments: int, found: bool, seed: int):
    """Each by itself takes it for a run of false detections."""
    drives = [past(seed + n, moment=n < moments) for n in range(4)]
    first, own = mapped(drives, MapperConfig())
    assert all(MOMENT not in labels.tolist() and len(labels) == 5 for labels in own)
    off = torch.cdist(drives[0].T_world_sign[:, :3, 3], first.signs.center_world).amin(1)
    assert (off < 1.0).tolist() == [found or sign != MOMENT for sign in range(6)]
    assert len(first.signs) == 5 + found and len(first.tentative) == 0
    if found:
        assert int(first.signs.n_journeys.min()) == moments
    # What one drive alone takes for none says nothing against the drive.
    assert first.crowd.report.statistics.checked.tolist()[0] == 5 + found


def test_where_one_drive_is_enough_doubtful_signs_are_none():
    config = MapperConfig()
    config = replace(config, crowd=replace(config.crowd, min_journeys=1))
    first, _ = mapped([past(n, moment=True) for n in range(2)], config)
    assert len(first.signs) == 5 and len(first.tentative) == 0
    alone, _ = mapped([past(0, moment=True)], MapperConfig())
    assert len(alone.signs) == 5


def test_doubtful_signs_are_behind_all_others_and_know_their_journey(tiny: Dataset):
    made = [mapper.map_journey(j, n, MapperConfig()) for n, j in enumerate(tiny.journeys[:2])]
    unsure = torch.zeros_like(made[0].signs.confidence)
    # All scores may be zero.
    sure = [replace(made[0].signs, confidence=unsure), made[1].signs]
    doubtful = [
        replace(signs[:n], journey=torch.full((n,), -1))
        for signs, n in zip(sure, (1, 2), strict=True)
    ]
    every = signs_of_crowd(sure, doubtful, 2)
    assert len(every) == sum(map(len, sure)) + 3
    assert every.journey[-3:].tolist() == [0, 1, 1]
    assert torch.equal(every.confidence == 0, torch.arange(len(every)) >= len(every) - 3)
    assert len(signs_of_crowd(sure, doubtful, 1)) == len(every) - 3
