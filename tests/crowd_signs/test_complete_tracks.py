"""What clustering set aside comes back to the signs that it shows, and nothing else does."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from worlds.sign_drive import (
    F64,
    SignDrive,
    associated,
    drive_past,
    map_of,
    moved_corners,
    shift_of,
    signs_at,
    straight_poses,
    taken_for,
    tracklets_of,
    two_journeys,
    with_rows,
    with_signs,
)

from crowdmap_torch.crowd_signs.complete_tracks import (
    complete_tracks,
    with_evidence,
    with_vouched,
    without_signs,
)
from crowdmap_torch.crowd_signs.completion import (
    AssociatedSigns,
    CompletedTracks,
    CompleteTracksConfig,
)
from crowdmap_torch.crowd_signs.duplicates import duplicate_signs
from crowdmap_torch.crowd_signs.existence import still_alone
from crowdmap_torch.crowd_signs.register import CrowdConfig
from crowdmap_torch.geometry import polygon
from crowdmap_torch.tables import Association, Tracklets

CONFIG = CompleteTracksConfig()
PLACES = [(4.0, 60.0, 3.0), (4.0, 60.0, 2.3), (-5.0, 75.0, 2.8)]
"""Two signs on one post, 0.7 m apart, and one across the road."""


@pytest.fixture
def drive() -> SignDrive:
    return drive_past(straight_poses(80), signs_at(PLACES), noise_px=0.4)


def completed(
    drive: SignDrive, known: Tensor, label: Tensor, *, pose_error=(0.0, 0.0, 0.0), signs=None
) -> Association:
    poses = drive.journey.T_world_camera.clone()
    poses[:, :3, 3] += torch.tensor(pose_error, dtype=F64)
    found = complete_tracks(
        [drive.journey],
        [poses],
        [tracklets_of(label)],
        map_of(drive) if signs is None else signs,
        [associated(drive, known)],
        CONFIG,
    )
    fresh = int((found.associations[0].sign >= 0).sum()) - int(known.sum())
    assert found.fitting + found.displaced == fresh
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
    found = completed(drive, known, label, pose_error=(0.2, 0.0, -0.1))
    assert torch.equal(found.sign, drive.sign)
    same_shape = drive.journey.signs.shape == drive.shape[drive.sign]
    assert torch.equal(found.sign_shift[same_shape], shift[same_shape])


@pytest.mark.parametrize("lost", [0, 1, 2])
def test_a_sign_that_found_no_cluster_comes_back(drive: SignDrive, lost: int):
    known = drive.sign != lost
    found = completed(drive, known, drive.sign, pose_error=(0.1, 0.0, 0.05))
    share = (found.sign == drive.sign)[~known].double().mean()
    assert share > 0.98
    assert not ((found.sign >= 0) & (found.sign != drive.sign)).any()


@pytest.mark.parametrize("lost", [0, 1, 2])
def test_glimpses_of_a_sign_come_back(drive: SignDrive, lost: int):
    known = drive.sign != lost
    # Every one of them alone in its tracklet: how the projections err there is told by nothing.
    label = torch.where(known, drive.sign, 3 + (~known).cumsum(0))
    found = completed(drive, known, label, pose_error=(0.1, 0.0, 0.05))
    share = (found.sign == drive.sign)[~known].double().mean()
    assert share > 0.9
    assert not ((found.sign >= 0) & (found.sign != drive.sign)).any()


@pytest.mark.parametrize("noise_px", [0.4, 2.0, 4.0])
def test_detections_come_back_in_noisy_images_too(noise_px: float, generator: torch.Generator):
    drive = drive_past(straight_poses(80), signs_at(PLACES), noise_px=noise_px)
    known = torch.rand(len(drive.sign), generator=generator) < 0.7
    label = torch.where(known, drive.sign, 3 + (~known).cumsum(0))
    found = completed(drive, known, label)
    # As far as they can be told from those of the other sign on the post.
    share = (found.sign == drive.sign)[~known].double().mean()
    assert share > (0.99 if noise_px < 1 else 0.9)
    assert ((found.sign >= 0) & (found.sign != drive.sign)).double().mean() < 0.01


def test_a_sign_that_is_not_in_the_map_is_not_its_neighbour(drive: SignDrive):
    known = drive.sign != 1
    signs = map_of(drive)[torch.tensor([0, 2])]
    association = associated(drive, known)
    number = torch.tensor([0, -1, 1, -1])
    association = replace(association, sign=number[association.sign])
    found = complete_tracks(
        [drive.journey],
        [drive.journey.T_world_camera],
        [tracklets_of(drive.sign)],
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
    found = completed(drive, known, label)
    assert (found.sign[n:] == -1).all()


def test_an_outline_that_is_far_off_needs_a_sign_that_is_missing(drive: SignDrive):
    row = row_near(drive, 2, 25)
    rows = torch.cat((torch.arange(len(drive.sign)), torch.tensor([row])))
    drive = moved_corners(with_rows(drive, rows), len(drive.sign), (20.0, 25.0))
    known = torch.arange(len(rows)) < len(rows) - 1
    label = torch.where(known, drive.sign, 3)
    assert completed(drive, known, label).sign[-1] == -1
    known[row] = False
    label[row] = 4
    alone = with_rows(drive, torch.arange(len(rows))[torch.arange(len(rows)) != row])
    keep = torch.arange(len(rows)) != row
    assert completed(alone, known[keep], label[keep]).sign[-1] == 2


def test_what_has_a_landmark_keeps_it(drive: SignDrive):
    known = torch.ones(len(drive.sign), dtype=torch.bool)
    association = associated(drive, known)
    wrong = replace(association, sign=(association.sign + 1) % 3)
    found = complete_tracks(
        [drive.journey],
        [drive.journey.T_world_camera],
        [tracklets_of(drive.sign)],
        map_of(drive),
        [wrong],
        CONFIG,
    ).associations[0]
    assert torch.equal(found.sign, wrong.sign) and torch.equal(found.sign_shift, wrong.sign_shift)


def test_a_journey_without_detections_is_left_alone(drive: SignDrive):
    none = with_rows(drive, torch.zeros(0, dtype=torch.int64))
    found = complete_tracks(
        [none.journey],
        [none.journey.T_world_camera],
        [Tracklets(none.sign, 0)],
        map_of(drive),
        [associated(none, none.sign >= 0)],
        CONFIG,
    )
    assert len(found.associations[0].sign) == 0 and found.fitting == found.displaced == 0


def test_a_map_of_nothing_takes_nothing(drive: SignDrive):
    known = torch.zeros(len(drive.sign), dtype=torch.bool)
    found = completed(drive, known, drive.sign, signs=map_of(drive)[torch.nonzero(known)[:, 0]])
    assert bool((found.sign == -1).all())


def test_a_badly_placed_duplicate_is_found_by_what_its_detections_show(drive: SignDrive):
    signs = map_of(drive)
    # The sign across the road, seen by the second journey as if turned away and 0.4 m further.
    duplicate = signs_at([(-5.1, 75.4, 2.7)], yaw_deg=70.0)
    signs = replace(
        signs[torch.tensor([0, 1, 2, 2])],
        T_world_sign=torch.cat((signs.T_world_sign, duplicate)),
        n_journeys=torch.tensor([2, 2, 2, 1]),
    )
    second = torch.where(drive.sign == 2, 3, drive.sign)
    journeys, poses, associations = two_journeys(drive, second)
    found = duplicate_signs(journeys, poses, signs, associations, CONFIG)
    assert found.tolist() == [False, False, False, True]
    kept = without_signs(associations, found)
    assert torch.equal(kept[0].sign, drive.sign)
    assert torch.equal(kept[1].sign, torch.where(drive.sign == 2, -1, drive.sign))


@pytest.mark.parametrize("seed", range(4))
def test_a_duplicate_is_found_where_images_are_noisy(seed: int):
    """Outlines of 10 to 20 px that are off by 6: every third one of a sign was taken for another one, 3 m behind it."""
    drive = drive_past(straight_poses(80), signs_at([(4.0, 90.0, 3.0)]), noise_px=6.0, seed=seed)
    rays = drive.journey.T_world_camera[drive.journey.signs.frame, :3, 3]
    drive = with_rows(
        drive, torch.nonzero((rays - drive.T_world_sign[0, :3, 3]).norm(dim=1) > 50)[:, 0]
    )
    taken, config = (
        (torch.arange(len(drive.sign)) % 3 == 0).long(),
        replace(CONFIG, duplicate_m=5.0),
    )
    signs = replace(
        map_of(drive)[torch.tensor([0, 0])],
        T_world_sign=torch.cat((drive.T_world_sign, signs_at([(4.0, 93.0, 3.0)]))),
        n_journeys=torch.tensor([2, 1]),
    )
    journeys, poses, associations = two_journeys(replace(drive, sign=0 * taken), taken)
    found = duplicate_signs(journeys, poses, signs, associations, config)
    assert found.tolist() == [False, True]
    # Two of which every frame shows each are two.
    twice = with_rows(drive, torch.arange(len(drive.sign)).repeat_interleave(2))
    both = torch.arange(len(twice.sign)) % 2
    journeys, poses, associations = two_journeys(replace(twice, sign=0 * both), both)
    assert not duplicate_signs(journeys, poses, signs, associations, config).any()


def test_signs_on_one_post_are_no_duplicates(drive: SignDrive):
    journeys, poses, associations = two_journeys(drive, drive.sign)
    for views in ([2, 1, 2], [1, 2, 2], [1, 1, 1]):
        signs = replace(map_of(drive), n_journeys=torch.tensor(views))
        assert not duplicate_signs(journeys, poses, signs, associations, CONFIG).any()


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
        found = still_alone(singles, [tracklets_of(drive.sign)], [associated(drive, known)])
        assert found.tolist() == alone


def one_of_two(
    drive: SignDrive,
    second: Tensor,
    *,
    off_m: float = 0.0,
    trusted: tuple[bool, bool] = (True, True),
    passing: int = 2,
    shape: Tensor | None = None,
) -> tuple[AssociatedSigns, AssociatedSigns]:
    """Two drives, and signs of which the last is one that the first drive alone made: with it vouched for, if it is.

    `second`: which sign each detection of the second drive shows, -2: it has none such; `shape`: what it is drawn as.
    """
    signs = map_of(drive)
    T = signs.T_world_sign.clone()
    T[2, 0, 3] += off_m
    signs = replace(signs, T_world_sign=T, journey=torch.full((3,), -1))
    single = replace(
        signs[torch.tensor([2])], journey=torch.tensor([0]), tracklet=torch.tensor([2])
    )
    other = drive if shape is None else with_signs(drive, shape=shape)
    other = with_rows(other, torch.nonzero(second >= -1)[:, 0])
    journeys = [drive.journey, other.journey]
    poses = [journey.T_world_camera for journey in journeys]
    known = [associated(one, one.sign < 2) for one in (drive, other)]
    made = [replace(tracklets_of(one.sign), shift=shift_of(one)) for one in (drive, other)]
    none = CompletedTracks(tuple(known), 0, 0)
    found = AssociatedSigns(signs[torch.tensor([0, 1])], single, tuple(known), none)
    return found, with_vouched(
        *(journeys, poses, made, found, torch.tensor([passing]), CrowdConfig(), CONFIG),
        trusted=torch.tensor(trusted),
    )


def test_a_sign_of_one_drive_is_one_of_the_map_if_another_drive_sees_it_there(drive: SignDrive):
    found, vouched = one_of_two(drive, drive.sign)
    assert len(vouched.heads) == 3 and len(vouched.tentative) == 0
    assert int(vouched.heads.n_journeys[2]) == 2 and float(vouched.heads.confidence[2]) > 0.99
    for association in vouched.associations:
        shown = association.sign[drive.sign == 2]
        assert bool((shown == 2).double().mean() > 0.9)
        rows = association.sign >= 0
        assert torch.equal(association.sign[rows], drive.sign[rows])
    assert found.completed is not None and vouched.completed is not None
    assert vouched.completed.fitting > found.completed.fitting
    # The second drive's corners are counted as the sign's are.
    shift = vouched.associations[1].sign_shift[drive.sign == 2]
    assert torch.equal(shift, shift_of(drive)[drive.sign == 2])


def test_a_sign_that_few_of_those_who_passed_saw_is_less_sure(drive: SignDrive):
    _, by_two = one_of_two(drive, drive.sign)
    _, by_many = one_of_two(drive, drive.sign, passing=40)
    assert float(by_many.heads.confidence[2]) < float(by_two.heads.confidence[2]) - 0.2


@pytest.mark.parametrize("fault", ["a glance", "elsewhere", "a bad drive", "other shapes"])
def test_a_sign_that_nobody_else_sees_stays_one_drives_own(drive: SignDrive, fault: str):
    second, seen = drive.sign.clone(), torch.nonzero(drive.sign == 2)[:, 0]
    shape = drive.journey.signs.shape.clone()
    if fault == "a glance":
        second[seen[CONFIG.evidence - 1 :]] = -2
    if fault == "other shapes":
        # What runs along there for a while looks like the sign in size, and like it in shape now and then.
        shape[seen[CONFIG.evidence - 1 :]] = polygon.OCTAGON
    off_m = 3.0 if fault == "elsewhere" else 0.0
    trusted = (True, fault != "a bad drive")
    found, vouched = one_of_two(drive, second, off_m=off_m, trusted=trusted, shape=shape)
    assert vouched is found
