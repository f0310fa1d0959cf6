"""What clustering set aside comes back to the signs that it shows, and nothing else does."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from sign_drive import (
    F64,
    SignDrive,
    drive_past,
    moved_corners,
    signs_at,
    straight_poses,
    taken_for,
    with_rows,
    with_signs,
)
from small_world import Builder
from torch import Tensor

from crowdmap_torch.geometry import camera as cameras
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.stages.harvest import (
    HarvestConfig,
    copies,
    harvest_signs,
    still_alone,
    with_evidence,
    without_signs,
)
from crowdmap_torch.tables import Association, Signs, Tracklets

CONFIG = HarvestConfig()
PLACES = [(4.0, 60.0, 3.0), (4.0, 60.0, 2.3), (-5.0, 75.0, 2.8)]
"""Two signs on one post, 0.7 m apart, and one across the road."""


@pytest.fixture
def drive() -> SignDrive:
    return drive_past(straight_poses(80), signs_at(PLACES), noise_px=0.4)


def map_of(drive: SignDrive) -> Signs:
    signs = Builder().signs(drive.T_world_sign[:, :3, 3])
    return replace(signs, T_world_sign=drive.T_world_sign, size=drive.size, shape=drive.shape)


def shift_of(drive: SignDrive) -> Tensor:
    """How the corners of each detection are turned against those of its sign."""
    poses = drive.journey.T_world_camera[drive.journey.signs.frame]
    corners = se3.transform(se3.inverse(poses)[:, None], drive.corners_world[drive.sign])
    px, _ = cameras.project(drive.journey.rig.camera, corners)
    count = polygon.corner_count(drive.shape[drive.sign])
    return polygon.best_shift(px, drive.journey.signs.corners_px, count)[0]


def associated(drive: SignDrive, known: Tensor) -> Association:
    """The true association of the detections that are known, none of the others."""
    shift = torch.where(known, shift_of(drive), 0)
    return Association(torch.where(known, drive.sign, -1), shift, torch.zeros(0, dtype=torch.int64))


def tracklets(label: Tensor) -> Tracklets:
    return Tracklets(label, int(label.max()) + 1)


def harvested(
    drive: SignDrive, known: Tensor, label: Tensor, *, pose_error=(0.0, 0.0, 0.0), signs=None
) -> Association:
    poses = drive.journey.T_world_camera.clone()
    poses[:, :3, 3] += torch.tensor(pose_error, dtype=F64)
    found = harvest_signs(
        [drive.journey],
        [poses],
        [tracklets(label)],
        map_of(drive) if signs is None else signs,
        [associated(drive, known)],
        CONFIG,
    )
    fresh = int((found.associations[0].sign >= 0).sum()) - int(known.sum())
    assert found.fitting + found.strays == fresh
    return found.associations[0]


def row_near(drive: SignDrive, sign: int, frame: int) -> int:
    rows = torch.nonzero(drive.sign == sign)[:, 0]
    return int(rows[(drive.journey.signs.frame[rows] - frame).abs().argmin()])


def test_single_detections_come_back_whatever_is_wrong_with_them(drive: SignDrive):
    twice = torch.cat((torch.arange(len(drive.sign)), torch.tensor([row_near(drive, 0, 20)])))
    drive = with_rows(drive, twice)
    shift = shift_of(drive)
    row = [row_near(drive, 0, 30), row_near(drive, 1, 40), row_near(drive, 2, 25)]
    px = drive.journey.signs.corners_px.clone()
    px[row[0], 1] += torch.tensor([25.0, -10.0], dtype=F64)
    drive = taken_for(with_signs(drive, corners_px=px), row[1], polygon.OCTAGON)
    drive = moved_corners(drive, row[2], (30.0, 18.0))
    known = torch.ones(len(drive.sign), dtype=torch.bool)
    known[[*row, -1]] = False
    # Every one of them alone in its tracklet, and poses off by more than the gates alone allow.
    label = torch.where(known, drive.sign, 3 + (~known).cumsum(0))
    found = harvested(drive, known, label, pose_error=(0.2, 0.0, -0.1))
    assert torch.equal(found.sign, drive.sign)
    same_shape = drive.journey.signs.shape == drive.shape[drive.sign]
    assert torch.equal(found.sign_shift[same_shape], shift[same_shape])


@pytest.mark.parametrize("lost", [0, 1, 2])
def test_a_sign_that_found_no_cluster_comes_back(drive: SignDrive, lost: int):
    known = drive.sign != lost
    found = harvested(drive, known, drive.sign, pose_error=(0.1, 0.0, 0.05))
    share = (found.sign == drive.sign)[~known].double().mean()
    assert share > 0.98
    assert not ((found.sign >= 0) & (found.sign != drive.sign)).any()


def test_a_sign_that_is_not_in_the_map_is_not_its_neighbour(drive: SignDrive):
    known = drive.sign != 1
    signs = map_of(drive)[torch.tensor([0, 2])]
    association = associated(drive, known)
    number = torch.tensor([0, -1, 1, -1])
    association = replace(association, sign=number[association.sign])
    found = harvest_signs(
        [drive.journey],
        [drive.journey.T_world_camera],
        [tracklets(drive.sign)],
        signs,
        [association],
        CONFIG,
    ).associations[0]
    assert torch.equal(found.sign, association.sign)


def test_false_detections_stay_away(drive: SignDrive, generator: torch.Generator):
    n = len(drive.sign)
    rows = torch.cat((torch.arange(n), torch.randint(n, (60,), generator=generator)))
    drive = with_rows(drive, rows)
    px = drive.journey.signs.corners_px.clone()
    # Outlines of the right size and shape, beside the signs: nobody misses one there.
    push = torch.tensor([60.0, -20.0], dtype=F64) * torch.randn(60, 2, generator=generator).sign()
    px[n:] += push[:, None]
    drive = with_signs(drive, corners_px=px)
    known = torch.arange(len(rows)) < n
    label = torch.where(known, drive.sign, 3)  # one run of them all
    found = harvested(drive, known, label)
    assert (found.sign[n:] == -1).all()


def test_an_outline_that_is_far_off_needs_a_sign_that_is_missing(drive: SignDrive):
    row = row_near(drive, 2, 25)
    rows = torch.cat((torch.arange(len(drive.sign)), torch.tensor([row])))
    drive = moved_corners(with_rows(drive, rows), len(drive.sign), (20.0, 25.0))
    known = torch.arange(len(rows)) < len(rows) - 1
    label = torch.where(known, drive.sign, 3)
    assert harvested(drive, known, label).sign[-1] == -1
    known[row] = False
    label[row] = 4
    alone = with_rows(drive, torch.arange(len(rows))[torch.arange(len(rows)) != row])
    keep = torch.arange(len(rows)) != row
    assert harvested(alone, known[keep], label[keep]).sign[-1] == 2


def test_what_has_a_landmark_keeps_it(drive: SignDrive):
    known = torch.ones(len(drive.sign), dtype=torch.bool)
    association = associated(drive, known)
    wrong = replace(association, sign=(association.sign + 1) % 3)
    found = harvest_signs(
        [drive.journey],
        [drive.journey.T_world_camera],
        [tracklets(drive.sign)],
        map_of(drive),
        [wrong],
        CONFIG,
    ).associations[0]
    assert torch.equal(found.sign, wrong.sign) and torch.equal(found.sign_shift, wrong.sign_shift)


def test_a_journey_without_detections_is_left_alone(drive: SignDrive):
    none = with_rows(drive, torch.zeros(0, dtype=torch.int64))
    found = harvest_signs(
        [none.journey],
        [none.journey.T_world_camera],
        [Tracklets(none.sign, 0)],
        map_of(drive),
        [associated(none, none.sign >= 0)],
        CONFIG,
    )
    assert len(found.associations[0].sign) == 0 and found.fitting == found.strays == 0


def test_a_map_of_nothing_takes_nothing(drive: SignDrive):
    known = torch.zeros(len(drive.sign), dtype=torch.bool)
    found = harvested(drive, known, drive.sign, signs=map_of(drive)[torch.nonzero(known)[:, 0]])
    assert bool((found.sign == -1).all())


def two_journeys(drive: SignDrive, second: Tensor) -> tuple[list, list, list[Association]]:
    """The drive twice; `second` is the sign of each detection of the other journey."""
    known = torch.ones(len(drive.sign), dtype=torch.bool)
    first = associated(drive, known)
    journeys = [drive.journey, drive.journey]
    return journeys, [j.T_world_camera for j in journeys], [first, replace(first, sign=second)]


def test_a_badly_placed_copy_is_found_by_what_its_detections_show(drive: SignDrive):
    signs = map_of(drive)
    # The sign across the road, seen by the second journey as if turned away and 0.4 m further.
    copy = signs_at([(-5.1, 75.4, 2.7)], yaw_deg=70.0)
    signs = replace(
        signs[torch.tensor([0, 1, 2, 2])],
        T_world_sign=torch.cat((signs.T_world_sign, copy)),
        n_journeys=torch.tensor([2, 2, 2, 1]),
    )
    second = torch.where(drive.sign == 2, 3, drive.sign)
    journeys, poses, associations = two_journeys(drive, second)
    found = copies(journeys, poses, signs, associations, CONFIG)
    assert found.tolist() == [False, False, False, True]
    kept = without_signs(associations, found)
    assert torch.equal(kept[0].sign, drive.sign)
    assert torch.equal(kept[1].sign, torch.where(drive.sign == 2, -1, drive.sign))


def test_signs_on_one_post_are_no_copies(drive: SignDrive):
    journeys, poses, associations = two_journeys(drive, drive.sign)
    for views in ([2, 1, 2], [1, 2, 2], [1, 1, 1]):
        signs = replace(map_of(drive), n_journeys=torch.tensor(views))
        assert not copies(journeys, poses, signs, associations, CONFIG).any()


def test_evidence_counts_detections_and_the_journeys_that_saw_more_than_a_glimpse(drive: SignDrive):
    second = torch.full_like(drive.sign, -1)
    second[torch.nonzero(drive.sign == 0)[:2, 0]] = 0
    second[drive.sign == 1] = 1
    journeys, _, associations = two_journeys(drive, second)
    both = torch.tensor([True, True])
    signs = with_evidence(map_of(drive), journeys, associations, both, CONFIG)
    views = torch.bincount(drive.sign)
    assert signs.n_journeys.tolist() == [1, 2, 1]
    assert signs.n_observations.tolist() == [int(views[0]) + 2, 2 * int(views[1]), int(views[2])]
    first = torch.tensor([True, False])
    signs = with_evidence(map_of(drive), journeys, associations, first, CONFIG)
    assert signs.n_journeys.tolist() == [1, 1, 1]
    assert signs.n_observations.tolist() == views.tolist()


def test_singles_are_alone_until_most_of_their_detections_are_somewhere(drive: SignDrive):
    singles = map_of(drive)[torch.tensor([1, 2])]
    singles = replace(singles, journey=torch.tensor([0, 0]), tracklet=torch.tensor([1, 2]))
    views = torch.nonzero(drive.sign == 1)[:, 0]
    known = torch.zeros(len(drive.sign), dtype=torch.bool)
    for share, alone in ((0.4, [True, True]), (0.6, [False, True])):
        known[views[: round(share * len(views))]] = True
        found = still_alone(singles, [tracklets(drive.sign)], [associated(drive, known)])
        assert found.tolist() == alone
