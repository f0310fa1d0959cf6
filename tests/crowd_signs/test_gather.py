"""Signs seen beside each other, and what is doubtful among those of a crowd."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
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
from crowdmap_torch.crowd_signs.gather import pairs_seen_together, signs_of_crowd
from crowdmap_torch.mapper import FirstMap
from crowdmap_torch.tables import Dataset

PLACES = [(3.5 * (-1) ** i, 60.0 + 25.0 * i, 2.5) for i in range(6)]
MOMENT = 3
"""The sign that is seen for a moment."""


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
