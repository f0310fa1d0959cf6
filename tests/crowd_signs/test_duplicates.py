"""Signs of an adjusted map that are one are joined, and those that are two are not."""

from __future__ import annotations

from collections.abc import Sequence
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
    shift_of,
    signs_at,
    straight_poses,
    tracklets_of,
    two_journeys,
    with_rows,
)

from crowdmap_torch.crowd_signs.complete_tracks import merged_signs, without_strayed
from crowdmap_torch.crowd_signs.completion import (
    AssociatedSigns,
    CompletedTracks,
    CompleteTracksConfig,
)
from crowdmap_torch.crowd_signs.duplicates import (
    DuplicateSignConfig,
    may_be_one,
    none_of_the_map,
    same_sign,
    seen_in_turn,
    seen_together,
)
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.tables import Association, Journey, Signs

CONFIG, COMPLETION = DuplicateSignConfig(), CompleteTracksConfig()
PLACES = [(4.0, 60.0, 3.0), (4.0, 60.0, 2.3), (-5.0, 75.0, 2.8)]
"""Two signs on one post, 0.7 m apart, and one across the road."""


@pytest.fixture
def drive() -> SignDrive:
    return drive_past(straight_poses(80), signs_at(PLACES))


def with_copy(signs: Signs, row: int, offset: tuple[float, float, float]) -> Signs:
    """The signs, all alike in type, with a copy of one beside it, and covariances of 0.2 m."""
    every = signs[torch.tensor([*range(len(signs)), row])]
    T = every.T_world_sign.clone()
    T[-1, :3, 3] += torch.tensor(offset, dtype=F64)
    covariance = 0.04 * torch.eye(3, dtype=F64).expand(len(every), 3, 3)
    return replace(every, T_world_sign=T, covariance=covariance, type=torch.zeros_like(every.type))


def split(
    drive: SignDrive, row: int
) -> tuple[Signs, list[Journey], list[Association], Association]:
    """A map in which the second of two drives has a copy of a sign; and what is right."""
    copy = len(drive.T_world_sign)
    second = torch.where(drive.sign == row, copy, drive.sign)
    journeys, _, associations = two_journeys(drive, second)
    signs = with_copy(map_of(drive), row, (0.05, 0.1, -0.03))
    return signs, journeys, associations, associations[0]


def join_duplicates(
    signs: Signs,
    journeys: Sequence[Journey],
    associations: Sequence[Association],
    config: DuplicateSignConfig,
) -> tuple[Signs, tuple[Association, ...]] | None:
    """The signs that are themselves, and which of them each detection shows; None if all are."""
    into = same_sign(signs, journeys, associations, config)
    if torch.equal(into, torch.arange(len(into))):
        return None
    return merged_signs(signs, associations, into)


@pytest.mark.parametrize("row", [0, 1, 2])
def test_what_two_drives_see_each_for_itself_is_one(drive: SignDrive, row: int) -> None:
    signs, journeys, associations, right = split(drive, row)
    assert may_be_one(signs, journeys, associations, CONFIG).tolist() == [[row, len(PLACES)]]
    found = join_duplicates(signs, journeys, associations, CONFIG)
    assert found is not None
    joined, shown = found
    assert len(joined) == len(PLACES)
    for association in shown:
        assert torch.equal(association.sign, right.sign)
        assert torch.equal(association.sign_shift, right.sign_shift)
    # It stays where it is, of two that as many detections show the first.
    assert torch.equal(joined.T_world_sign, signs.T_world_sign[: len(PLACES)])


@pytest.mark.parametrize("turn", [1, 2, 3])
def test_corners_are_turned_against_the_sign_that_stays(drive: SignDrive, turn: int) -> None:
    """A square's copy may begin at another corner."""
    square = drive_past(straight_poses(80), signs_at(PLACES), size=(0.7, 0.7))
    signs, journeys, associations, right = split(square, 2)
    angle = torch.tensor([0.0, 0, 0, 0, 0, turn * torch.pi / 2], dtype=F64)
    T = signs.T_world_sign.clone()
    T[-1] = T[-1] @ se3.exp(angle)
    signs = replace(signs, T_world_sign=T)
    of_copy = associations[1].sign == len(PLACES)
    # What is right of the copy, by its own corners in the images.
    own = replace(square, T_world_sign=T, size=signs.size, shape=signs.shape)
    shift = shift_of(replace(own, sign=associations[1].sign))
    assert not bool((shift == right.sign_shift)[of_copy].any())
    associations[1] = replace(associations[1], sign_shift=shift)
    found = join_duplicates(signs, journeys, associations, CONFIG)
    assert found is not None
    assert torch.equal(found[1][1].sign_shift, right.sign_shift)


def test_plates_on_one_post_are_two_however_uncertain(drive: SignDrive) -> None:
    known = torch.ones(len(drive.sign), dtype=torch.bool)
    signs = with_copy(map_of(drive), 0, (0.0, 0.0, 0.0))[torch.tensor([0, 1, 2])]
    signs = replace(signs, covariance=100 * signs.covariance)
    seen = [drive.journey], [associated(drive, known)]
    # Frames say so: nobody needs to ask for covariances.
    assert len(may_be_one(signs, *seen, CONFIG)) == 0
    assert join_duplicates(signs, *seen, CONFIG) is None


def test_a_copy_of_one_of_two_plates_goes_into_one_of_them(drive: SignDrive) -> None:
    """Somewhere between the two, it may be either; both are never one."""
    signs, journeys, associations, _ = split(drive, 0)
    T = signs.T_world_sign.clone()
    T[-1, 2, 3] -= 0.3
    signs = replace(signs, T_world_sign=T, covariance=4 * signs.covariance)
    found = join_duplicates(signs, journeys, associations, CONFIG)
    # The second drive saw the copy beside the lower plate.
    assert found is not None and len(found[0]) == len(PLACES)
    assert torch.equal(found[1][1].sign, found[1][0].sign)


def test_what_differs_or_is_surely_elsewhere_stays_two(drive: SignDrive) -> None:
    signs, journeys, associations, _ = split(drive, 2)

    def is_joined(**columns: Tensor) -> bool:
        return (
            join_duplicates(replace(signs, **columns), journeys, associations, CONFIG) is not None
        )

    assert is_joined()
    last = torch.arange(len(signs)) == len(PLACES)
    assert not is_joined(type=torch.where(last, 1, signs.type))
    assert is_joined(type=torch.where(last, -1, signs.type))
    assert not is_joined(shape=torch.where(last, polygon.OCTAGON, signs.shape))
    away = signs.T_world_sign.clone()
    away[-1, 0, 3] += 0.6
    assert is_joined(T_world_sign=away)
    assert not is_joined(T_world_sign=away, covariance=0.1 * signs.covariance)
    behind = signs.T_world_sign @ se3.exp(torch.tensor([0, 0, 0, 0, torch.pi, 0.0], dtype=F64))
    assert not is_joined(T_world_sign=torch.where(last[:, None, None], behind, signs.T_world_sign))


@pytest.mark.parametrize("seen", ["in turn", "one after the other", "once together"])
def test_signs_that_a_drive_sees_in_turn_and_never_together_are_one(
    drive: SignDrive, seen: str
) -> None:
    """A metre apart where 0.28 m, 1-sigma, are usual of two: too far for one sign, unless they are seen so."""
    twice = torch.cat((torch.arange(len(drive.sign)), torch.nonzero(drive.sign == 2)[40:41, 0]))
    drive = with_rows(drive, twice if seen == "once together" else twice[:-1])
    frame, copy = drive.journey.signs.frame, len(PLACES)
    of_copy = frame % 2 == 0
    if seen == "one after the other":
        of_copy = frame > frame[drive.sign == 2].median()
    second = torch.where((drive.sign == 2) & of_copy, copy, drive.sign)
    if seen == "once together":
        second[-1] = 2 if second[twice[-1]] == copy else copy
    journeys, _, associations = two_journeys(drive, second)
    signs = with_copy(map_of(drive), 2, (0.6, 0.8, 0.0))
    expected = seen_in_turn(journeys, associations, torch.tensor([[2, copy], [0, copy]]))
    views = int((drive.sign == 2).sum())
    if seen == "one after the other":
        assert float(expected[0]) == 0
    else:
        assert 0.2 * views < float(expected[0]) < 0.3 * views
    # Of those that were seen together it says nothing, and is not asked.
    assert float(expected[1]) > 10
    found = join_duplicates(signs, journeys, associations, CONFIG)
    assert (found is not None) == (seen == "in turn")
    assert found is None or len(found[0]) == len(PLACES)


def test_nobody_sees_in_turn_what_nobody_sees(drive: SignDrive) -> None:
    none = with_rows(drive, torch.zeros(0, dtype=torch.int64))
    pair = torch.tensor([[0, 1]])
    association = associated(none, none.sign >= 0)
    assert seen_in_turn([none.journey], [association], pair).tolist() == [0.0]
    known = associated(drive, torch.ones_like(drive.sign, dtype=torch.bool))
    assert len(seen_in_turn([drive.journey], [known], pair[:0])) == 0


def test_plates_that_overlap_are_one_whoever_saw_both(drive: SignDrive) -> None:
    signs = with_copy(map_of(drive), 2, (0.05, 0.1, -0.03))
    known = torch.ones(len(drive.sign), dtype=torch.bool)
    association = associated(drive, known)
    rows = torch.nonzero(drive.sign == 2)[:, 0]
    twice = drive.journey.signs[torch.cat((torch.arange(len(drive.sign)), rows))]
    journey = replace(drive.journey, signs=twice)
    sign = torch.cat((association.sign, torch.full_like(rows, len(PLACES))))
    shift = torch.cat((association.sign_shift, association.sign_shift[rows]))
    both = replace(association, sign=sign, sign_shift=shift)
    assert [2, 3] in seen_together([journey], [both], len(signs)).tolist()
    found = join_duplicates(signs, [journey], [both], CONFIG)
    assert found is not None and len(found[0]) == len(PLACES)
    # Whatever the codes of a plate that one drive has detected twice, ...
    other = replace(signs, type=torch.cat((signs.type[:-1], signs.type[-1:] + 1)))
    assert int(other.type[2]) >= 0
    found = join_duplicates(other, [journey], [both], CONFIG)
    assert found is not None and len(found[0]) == len(PLACES)
    # ... but another one may have been put there between two drives.
    after = replace(association, sign=association.sign.masked_fill(association.sign == 2, 3))
    drives = [drive.journey] * 2
    assert join_duplicates(other, drives, [association, after], CONFIG) is None
    assert join_duplicates(signs, drives, [association, after], CONFIG) is not None


def test_a_sign_of_three_copies_is_one_and_as_sure_as_the_surest(drive: SignDrive) -> None:
    n = len(PLACES)
    signs = with_copy(with_copy(map_of(drive), 2, (0.1, 0.0, 0.05)), 2, (-0.1, 0.1, 0.0))
    signs = replace(signs, confidence=torch.tensor([0.9, 0.9, 0.6, 0.7, 0.95], dtype=F64))
    known = torch.ones(len(drive.sign), dtype=torch.bool)
    first = associated(drive, known)
    others = [
        replace(first, sign=torch.where(first.sign == 2, copy, first.sign)) for copy in (n, n + 1)
    ]
    found = join_duplicates(signs, [drive.journey] * 3, [first, *others], CONFIG)
    assert found is not None and len(found[0]) == n
    assert found[0].confidence.tolist() == [0.9, 0.9, 0.95]


def test_a_map_without_signs_has_none_twice() -> None:
    drive = drive_past(straight_poses(4), signs_at([(4.0, 30.0, 3.0)]))
    none = map_of(drive)[torch.zeros(0, dtype=torch.int64)]
    association = associated(drive, torch.zeros(len(drive.sign), dtype=torch.bool))
    assert join_duplicates(none, [drive.journey], [association], CONFIG) is None


@pytest.mark.parametrize(
    ("of_sign_m", "of_cameras_m", "astray"),
    [(8.0, 0.0, True), (8.0, 8.0, False), (0.0, 8.0, True), (3.0, 0.0, False)],
)
def test_signs_go_astray_beside_the_cameras_that_saw_them(
    drive: SignDrive, of_sign_m: float, of_cameras_m: float, *, astray: bool
) -> None:
    known = torch.ones(len(drive.sign), dtype=torch.bool)
    before, association = map_of(drive), associated(drive, known)
    moved, given = before.T_world_sign.clone(), drive.journey.T_world_camera
    # All cameras rise, of the signs the second does not rise with them.
    moved[:, 2, 3] += of_cameras_m
    moved[1, 2, 3] += of_sign_m - of_cameras_m
    after = AssociatedSigns(
        replace(before, T_world_sign=moved),
        before[:0],
        (association,),
        CompletedTracks((association,), 0, 0),
    )
    begun, risen = torch.zeros(len(drive.journey.T_world_camera), 6, dtype=F64), [given.clone()]
    risen[0][:, 2, 3] += of_cameras_m
    seen = torch.zeros(len(PLACES), dtype=torch.bool)
    of_map = [drive.journey], risen, after.heads, [association], before, [begun]
    goes = none_of_the_map(*of_map, seen, CONFIG, COMPLETION)
    if not astray:
        assert not bool(goes.any())
        # What too few saw is none wherever it stands.
        unseen = torch.tensor([False, True, False])
        goes = none_of_the_map(*of_map, unseen, CONFIG, COMPLETION)
    assert goes.tolist() == [False, True, False]
    given = [drive.journey], risen, [tracklets_of(drive.sign)]
    found = without_strayed(*given, after, goes, COMPLETION, torch.tensor([True]))
    assert torch.equal(found.heads.T_world_sign, moved[[0, 2]])
    number = torch.tensor([0, -1, 1])
    assert torch.equal(found.associations[0].sign, number[association.sign])
    assert found.completed is not None
    assert torch.equal(found.completed.associations[0].sign, number[association.sign])


def test_of_two_that_may_be_one_none_goes_that_is_still_there(drive: SignDrive) -> None:
    signs = with_copy(map_of(drive), 1, (0.05, 0.0, 0.02))
    first = associated(drive, torch.ones(len(drive.sign), dtype=torch.bool))
    other = replace(first, sign=torch.where(first.sign == 1, len(PLACES), first.sign))
    journeys, begun = [drive.journey] * 2, [torch.zeros(len(drive.journey.t_ns), 6, dtype=F64)] * 2
    of_map = journeys, [j.T_world_camera for j in journeys], signs, [first, other], signs, begun
    unseen = torch.tensor([True, False, False, True])
    goes = none_of_the_map(*of_map, unseen, CONFIG, COMPLETION)
    assert goes.tolist() == [True, False, False, False]


def test_what_goes_is_no_sign_and_takes_none_with_it(drive: SignDrive) -> None:
    n = len(PLACES)
    signs = with_copy(map_of(drive), 2, (0.1, 0.0, 0.05))
    first = associated(drive, torch.ones(len(drive.sign), dtype=torch.bool))
    other = replace(first, sign=torch.where(first.sign == 2, n, first.sign))
    shown = [first, other]
    assert same_sign(signs, [drive.journey] * 2, shown, CONFIG).tolist() == [0, 1, 2, 2]
    goes = torch.arange(n + 1) == n
    into = same_sign(signs, [drive.journey] * 2, shown, CONFIG, goes)
    assert into.tolist() == [0, 1, 2, -1]
    left, (here, there) = merged_signs(signs, shown, into)
    assert torch.equal(left.T_world_sign, signs.T_world_sign[:n])
    assert torch.equal(here.sign, first.sign)
    assert torch.equal(there.sign, torch.where(other.sign == n, -1, other.sign))


@pytest.mark.parametrize("fault", ["", "to the side", "too far", "beside it"])
def test_a_sign_seen_from_afar_alone_is_the_one_behind_it(fault: str):
    """From 80 m a metre along the ray is less than a pixel: a second one there, that no other drive saw."""
    off = {"to the side": (1.5, 0.0, 0.0), "too far": (0.0, 8.0, 0.0)}.get(fault, (0.0, 3.0, 0.0))
    drive = drive_past(straight_poses(80), signs_at([(4.0 + off[0], 90.0, 3.0)]))
    rays = drive.journey.T_world_camera[:, :3, 3]
    distance = (rays[drive.journey.signs.frame] - drive.T_world_sign[0, :3, 3]).norm(dim=1)
    far = distance > 60
    if fault == "beside it":
        # Frames in which the same drive has the other one too, it has two of them.
        drive = with_rows(drive, torch.cat((torch.arange(len(far)), torch.nonzero(far)[:, 0])))
        second = torch.cat((drive.sign[: len(far)], torch.ones_like(drive.sign[len(far) :])))
    else:
        drive, second = with_rows(drive, torch.nonzero(far)[:, 0]), torch.ones(int(far.sum()))
        second = second.long()
    first = drive_past(straight_poses(80), signs_at([(4.0, 90.0, 3.0)]))
    journeys = [first.journey, first.journey, drive.journey]
    shown = [first.sign, first.sign, second]
    none = torch.zeros(0, dtype=torch.int64)
    associations = [Association(s, torch.zeros_like(s), none) for s in shown]
    heads = with_copy(map_of(first), 0, off)
    heads = replace(heads, n_journeys=torch.tensor([2, 1]))
    completed = CompletedTracks(tuple(associations), 0, 0)
    after = AssociatedSigns(heads, heads[:0], tuple(associations), completed)
    nothing = [torch.zeros(len(j.T_world_camera), 6, dtype=F64) for j in journeys]
    unseen = torch.zeros(2, dtype=torch.bool)
    poses, made = [j.T_world_camera for j in journeys], [tracklets_of(s) for s in shown]
    of_map = journeys, poses, heads, associations, heads, nothing, unseen
    goes = none_of_the_map(*of_map, CONFIG, COMPLETION)
    assert goes.tolist() == [False, not fault]
    if fault:
        return
    trusted = torch.ones(3, dtype=torch.bool)
    found = without_strayed(journeys, poses, made, after, goes, COMPLETION, trusted)
    assert torch.equal(found.heads.T_world_sign, heads.T_world_sign[:1])
    # What showed it shows the other now.
    assert bool((found.associations[2].sign == 0).all()) and int(found.heads.n_journeys) == 3
