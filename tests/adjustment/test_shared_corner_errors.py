"""How much of what a detection's corners have wrong together lasts from one detection to the next."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
import torch
from torch import Tensor

from crowdmap_torch.adjustment.bundle import Bundle, Evidence
from crowdmap_torch.adjustment.observations import CornerObservations
from crowdmap_torch.adjustment.shared_corner_errors import (
    Followed,
    Lasting,
    corner_detections,
    kept_in_tracks,
    lasting_errors,
    shared_errors,
)

if TYPE_CHECKING:
    from worlds.adjusted_street import Adjusted

F64 = torch.float64
_VIEWS, _SIGNS, _JOURNEYS, _CORNERS = 60, 5, 6, 4
_SIDE_PX, _NOISE_PX = 40.0, 0.5


def rows() -> CornerObservations:
    """Detections of four corners: in every frame of a journey all signs, one after the other."""
    count = _JOURNEYS * _VIEWS * _SIGNS
    detection = torch.arange(count).repeat_interleave(_CORNERS)
    frame = torch.arange(_JOURNEYS * _VIEWS).repeat_interleave(_SIGNS * _CORNERS)
    sign = torch.arange(_SIGNS).repeat_interleave(_CORNERS).repeat(_JOURNEYS * _VIEWS)
    m = len(detection)
    zero = torch.zeros(m, dtype=F64)
    outline = torch.tensor([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=F64) * _SIDE_PX / 2
    return CornerObservations(
        frame=frame,
        lens=torch.zeros_like(frame),
        px=outline.repeat(count, 1) + 300.0,
        ideal=torch.zeros(m, 2, dtype=F64),
        bend=torch.zeros(m, 2, dtype=F64),
        matrix=torch.zeros(m, 3, 3, dtype=F64),
        detection=2 * detection,
        journey=frame // _VIEWS,
        sign=sign,
        template=torch.zeros(m, 2, dtype=F64),
        box_px=zero,
        loose_px=zero,
    )


def pushes(numbers: int, lasts: float, g: torch.Generator) -> Tensor:
    """What pushes every detection, of variance one, by so many numbers: a share of it is still there a frame later."""
    push = torch.randn(_JOURNEYS, _VIEWS, _SIGNS, numbers, generator=g, dtype=F64)
    for view in range(1, _VIEWS):
        push[:, view] = lasts * push[:, view - 1] + (1 - lasts**2) ** 0.5 * push[:, view]
    return push.reshape(-1, numbers).repeat_interleave(_CORNERS, 0)


def errors(shift: float, lasts: float, seed: int, size: float = 0.0) -> Tensor:
    """Corners' noise of half a pixel; shifts, and shares by which outlines are too large, that last."""
    g = torch.Generator().manual_seed(seed)
    together = shift * pushes(2, lasts, g) + size * pushes(1, lasts, g) * (rows().px - 300.0)
    return together + _NOISE_PX * torch.randn(len(together), 2, generator=g, dtype=F64)


def lasting(table: CornerObservations, error: Tensor, used: Tensor, of_each: float) -> Lasting:
    """What is found to last of errors of corners."""
    noise = torch.full(used.shape, _NOISE_PX**2 / _CORNERS, dtype=F64)
    of_shift = torch.tensor(of_each, dtype=F64)
    return lasting_errors(corner_detections(table), table, error, noise, used, of_shift)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("shift", "lasts"), [(0.0, 0.0), (0.7, 0.0), (0.7, 0.8)])
def test_what_lasts_is_the_variance_of_long_means(shift: float, lasts: float, seed: int):
    table = rows()
    used = torch.ones(len(table) // _CORNERS, dtype=torch.bool)
    found = lasting(table, errors(shift, lasts, seed), used, shift**2)
    expected = shift**2 * (1 + lasts) / (1 - lasts)
    assert abs(float(found.of_many[0]) - expected) < 0.25 * expected + 0.03
    # A shift is no size, and what noise leaves of it is none.
    assert float(found.of_many[1]) == 0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("size", "lasts"), [(0.02, 0.0), (0.02, 0.8)])
def test_sizes_that_last_are_told_from_shifts_and_from_signs_that_are_larger(
    size: float, lasts: float, seed: int
):
    table = rows()
    used = torch.ones(len(table) // _CORNERS, dtype=torch.bool)
    larger = 0.1 * torch.arange(_SIGNS, dtype=F64)[table.sign, None] * (table.px - 300.0)
    found = lasting(table, errors(0.0, lasts, seed, size) + larger, used, 0.0)
    # Beside the mean of sixty views more than half of what lasts for nine shows; of what does not last nothing does.
    expected = 0.57 * size**2 * (1 + lasts) / (1 - lasts) if lasts else 0.0
    assert abs(float(found.of_many[1]) - expected) <= 0.35 * expected
    assert float(found.of_many[0]) < 0.03
    # Centres of boxes, which have no size, change nothing.
    centres = torch.arange(len(table)) % _CORNERS == 0
    more = replace(
        table, **{name: torch.cat((of, of[centres])) for name, of in vars(table).items()}
    )
    alone = table.detection[centres] + 1
    more = replace(more, detection=torch.cat((table.detection, alone)))
    error = errors(0.0, lasts, seed, size) + larger
    beside = lasting(more, torch.cat((error, error[centres])), used.repeat(2), 0.0)
    torch.testing.assert_close(beside.of_many[1], found.of_many[1])


def test_outliers_and_what_is_given_up_do_not_matter():
    table, error = rows(), errors(0.0, 0.0, 0)
    detections = corner_detections(table)
    wild = table.detection % 40 == 0
    error[wild] += 30.0
    for counted in (~wild, torch.ones_like(wild)):
        used = detections.have(counted)
        assert int(used.sum()) == int(counted.sum()) // _CORNERS
        assert float(lasting(table, error, used, 0.0).of_many[0]) < 0.15
    none = lasting(table, error, used & False, 1.0)
    assert not none.of_many.any()


def test_detections_of_other_signs_drives_and_kinds_do_not_follow_each_other():
    table = rows()
    first = corner_detections(table)
    follower = first.follower
    count = len(follower)
    expected = torch.arange(count) + _SIGNS
    expected[torch.arange(count) // _SIGNS % _VIEWS == _VIEWS - 1] = -1
    assert (follower == expected).all()
    has = follower >= 0
    assert (first.track[follower[has]] == first.track[has]).all()
    assert int(first.track.max()) + 1 == _SIGNS * _JOURNEYS
    assert (first.order.diff()[first.track[first.order].diff() == 0] == _SIGNS).all()
    # The centres of boxes, of odd numbers, are detections beside those of their corners.
    both = replace(table, detection=table.detection + (torch.arange(len(table)) % 4 == 3))
    twice = corner_detections(both)
    assert (twice.count[::2] == 3).all() and (twice.count[1::2] == 1).all()
    used = twice.follower >= 0
    assert (twice.follower[used] % 2 == torch.nonzero(used)[:, 0] % 2).all()


def lasts(shift: float, size: float, *, of_each: float = 1.0) -> Lasting:
    """What lasts of shifts and of sizes, and a share of it that each has alone."""
    of_many = torch.tensor([shift, size], dtype=F64)
    return Lasting(of_many, of_each * of_many)


def test_what_lasts_takes_off_the_say_of_the_mean_and_of_the_size_alone():
    table = rows()
    sigma = torch.full((len(table),), 0.5, dtype=F64)
    detections = corner_detections(table)
    every = torch.ones(len(table), dtype=torch.bool)
    # Nothing of it is there a frame later: all views have the same say.
    shared = shared_errors(detections, table.px, sigma, lasts(3.0, 1e-4), every)
    assert shared is not None
    shift = torch.ones(2, len(table), dtype=F64)
    expected = (1 + _CORNERS * 3.0 / 0.25) ** -0.5
    torch.testing.assert_close(shared.whiten(shift), expected * shift)
    larger = (table.px - 300.0).T.contiguous()
    # One size alone, of the variance that it has, would be told as well by u and v together.
    spread = 2 * _CORNERS * (_SIDE_PX / 2) ** 2
    expected = (1 + spread * 1e-4 / 0.25) ** -0.5
    torch.testing.assert_close(shared.whiten(larger), expected * larger)
    wedge = larger.flip(0).contiguous() * torch.sign(larger)
    torch.testing.assert_close(shared.whiten(wedge), wedge)
    # What does not last takes nothing off, and no time.
    of_shifts = shared_errors(detections, table.px, sigma, lasts(3.0, 0.0), every)
    assert of_shifts is not None
    torch.testing.assert_close(of_shifts.whiten(shift), shared.whiten(shift))
    torch.testing.assert_close(of_shifts.whiten(larger), larger)
    assert shared_errors(detections, table.px, sigma, lasts(0.0, 0.0), every) is None


def in_track(of_many: float, of_each: float, own: Tensor, frame: Tensor) -> Tensor:
    """R^-1 1 as shares of what noise of variance `own` leaves, written out: views of one track at these frames."""
    stays = (of_many - of_each) / (of_many + of_each)
    apart = (frame[:, None] - frame).abs() / frame.diff().double().mean()
    together = torch.diag(own) + of_each * stays**apart
    return own * torch.linalg.solve(together, torch.ones_like(own))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("of_each", [0.5, 0.1])
def test_each_view_counts_as_in_the_mean_of_its_track(of_each: float, seed: int):
    g = torch.Generator().manual_seed(seed)
    detections = corner_detections(rows())
    own = 0.2 * (1 + 0.2 * torch.rand(len(detections.count), generator=g, dtype=F64))
    counted = torch.rand(len(own), generator=g) < 0.7
    precision = (1 / own)[:, None, None].expand(-1, 2, 2)
    kept = kept_in_tracks(detections, precision, lasts(8.0, 2.0, of_each=of_each), counted)
    for track in range(int(detections.track.max()) + 1):
        at = torch.nonzero(counted & (detections.track == track))[:, 0]
        for kind, of_many in enumerate((8.0, 2.0)):
            expected = in_track(of_many, of_each * of_many, own[at], detections.frame[at])
            alone = own[at] / (own[at] + of_each * of_many)
            among_many = own[at] / (own[at] + of_many)
            expected = torch.minimum(torch.maximum(expected, among_many / 2), alone)
            torch.testing.assert_close(kept[at, 0, kind], expected)
            torch.testing.assert_close(kept[at, 1, kind], expected)
            # Nothing beyond the last view errs like it does.
            assert float(kept[at[-1], 0, kind]) > 1.2 * float(kept[at[1:-1], 0, kind].median())


def test_a_sign_is_placed_nearly_as_well_as_by_all_covariances():
    detections = corner_detections(rows())
    own, of_each, stays = 0.25, 0.49, math.exp(-1 / 4.5)
    of_many = of_each * (1 + stays) / (1 - stays)
    # Passed at 4 m, seen from 56 to 9 m ahead of it: where it is beside the road and along it.
    ahead = 56 - 0.8 * torch.arange(_VIEWS, dtype=F64)
    shows = 1000 * torch.stack((1 / ahead, -4 / ahead**2, 1 / ahead, -2 / ahead**2)).view(2, 2, -1)
    beside, along = shows.unbind(1)
    tells = torch.cat(
        (torch.stack((beside[0], along[0])), torch.stack((0 * along[1], along[1]))), 1
    )
    apart = (torch.arange(_VIEWS)[:, None] - torch.arange(_VIEWS)).abs()
    one = own * torch.eye(_VIEWS, dtype=F64) + of_each * stays**apart
    covariance = torch.block_diag(one, one)
    best = torch.linalg.inv(tells @ torch.linalg.solve(covariance, tells.T)).diagonal().sqrt()

    def sigma(weight: Tensor) -> Tensor:
        weighed = tells * weight.repeat(2)
        gain = torch.linalg.solve(weighed @ tells.T, weighed)
        return (gain @ covariance @ gain.T).diagonal().sqrt() / best

    precision = torch.full((len(detections.count), 1, 1), 1 / own, dtype=F64)
    lasting_one = Lasting(*torch.tensor([[of_many], [of_each]], dtype=F64))
    kept = kept_in_tracks(detections, precision, lasting_one, detections.track >= 0)
    of_track = kept[detections.order[:_VIEWS], 0, 0]
    assert (sigma(of_track) < 1.05).all()
    assert float(sigma(torch.ones_like(of_track))[1]) > 1.1


def test_views_with_none_beside_them_count_by_what_each_has_wrong():
    detections = corner_detections(rows())
    count = len(detections.count)
    precision = torch.full((count, 1, 2), 5.0, dtype=F64)
    lasting_ones = lasts(8.0, 2.0, of_each=0.1)
    # Views of a sign that are 40 frames apart, and one alone.
    is_far = detections.frame % 40 == 0
    expected = 1 / (1 + lasting_ones.of_each * 5.0)
    for counted in (is_far, is_far & (detections.track == 3)):
        kept = kept_in_tracks(detections, precision, lasting_ones, counted)
        torch.testing.assert_close(kept[counted, 0], expected.expand(int(counted.sum()), 2))
    none = kept_in_tracks(detections, precision, lasting_ones, counted & False)
    torch.testing.assert_close(none[0, 0], 1 / (1 + lasting_ones.of_many * 5.0))
    # Two views of one sign in one frame are as near as any.
    twice = replace(detections, frame=detections.frame // 2)
    kept = kept_in_tracks(twice, precision, lasting_ones, ~is_far)
    assert bool(((kept > 0) & (kept <= expected + 1e-12)).all())


def with_boxes(bundle: Bundle, share: float, seed: int) -> Bundle:
    """The bundle with detections whose shifts last, a share of them boxes with centres, too large or too small."""
    g = torch.Generator().manual_seed(seed)
    changed, rows, found = deepcopy(bundle), bundle.corners, bundle.detections
    push = 0.4 * torch.randn(len(found.count), 2, generator=g, dtype=F64)
    shift, later = push.clone(), found.follower
    for _ in range(4):
        shift += torch.where((later >= 0)[:, None], push[later], 0.0)
        later = torch.where(later >= 0, found.follower[later], -1)
    side = torch.randn(len(push), 2, generator=g, dtype=F64)
    is_box = (torch.rand(len(push), generator=g) < share)[found.run]
    is_centre = is_box & (found.rank == found.count[found.run] - 1)
    loose = 0.25 * rows.box_px * (is_box & ~is_centre)
    error = shift[found.run] + 2 * rows.template * side[found.run] * loose[:, None]
    matrix = rows.matrix.clone()
    matrix[:, :2] -= error[..., None] * rows.matrix[:, 2:]
    number = rows.detection + is_centre
    observed = {"px": rows.px + error, "matrix": matrix, "loose_px": loose, "detection": number}
    changed.see(replace(rows, **observed))
    changed.given_up = torch.zeros(int(number.max()) + 1, dtype=torch.bool)
    changed.unjudged = torch.zeros_like(changed.given_up)
    changed.lasting.zero_()
    changed.lasting_each.zero_()
    # As if poses were known: each shift is its own innovation.
    known = torch.full((len(changed.innovation), 2), 1e-6, dtype=F64)
    square = changed.detections.mean(error).square().mean(1)
    changed.innovation = torch.cat((square[:, None], known), dim=1)
    return changed


def foreseen(bundle: Bundle) -> Evidence:
    """What its observations are said to tell, as if it was found anew."""
    told, off, innovation = (
        x.clone() for x in (bundle.drift_told, bundle.held_off, bundle.innovation)
    )
    return Evidence(told, bundle.poses_left.clone(), off, innovation)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("share", [0.5, 1.0])
def test_loose_corners_of_boxes_do_not_hide_what_lasts(adjusted: Adjusted, share: float, seed: int):
    mixed = with_boxes(adjusted.bundle, share, seed)
    tight = deepcopy(mixed)
    tight.given_up[mixed.corners.detection[mixed.corners.loose_px > 0]] = True
    for bundle in (mixed, tight):
        bundle.share_there.fill_(1.0)
        bundle.refresh(foreseen(bundle))
    # Five pushes of 0.4 px in each shift: 4 px^2 in the mean of many, less where centres follow each other with gaps.
    assert 1.0 < float(tight.lasting[0]) < 7.0
    torch.testing.assert_close(mixed.lasting, tight.lasting)


def followed(by: Callable[[float], float], steps: int) -> tuple[list[float], list[bool]]:
    """Variances of shifts, step by step, that are found by where they are, and whether they rest; noise of none."""
    zero, told = torch.zeros((), dtype=F64), torch.tensor(True)
    at = Followed(
        Lasting(torch.zeros(2, dtype=F64), torch.zeros(2, dtype=F64)), zero + 1, zero.expand(2)
    )
    been, rests = [], []
    for _ in range(steps):
        here = float(at.lasting.of_many[0])
        found = torch.tensor([by(here), 0.0], dtype=F64)
        at, rest = at.toward(Lasting(found, found / 2), zero + 0.9, zero, told)
        been.append(float(at.lasting.of_many[0]))
        rests.append(bool(rest[0]))
        assert float(at.lasting.of_each[0]) <= been[-1]
    return been, rests


def test_what_lasts_goes_all_the_way_once_and_then_half_of_it():
    been, rests = followed(lambda here: 1.0 if here == 0 else 2.0, 6)
    assert been == pytest.approx([1.0, 1.5, 1.75, 1.75, 1.75, 1.75])
    # It stays where it is by a fifth of what was found.
    assert rests == [False, False, False, True, True, True]


@pytest.mark.parametrize("jump", [0.83, 0.86, 0.92])
def test_what_is_found_to_be_little_where_it_is_much_comes_to_rest(jump: float):
    """Half of the way each time it would go round for ever: up, up, down."""
    been, rests = followed(lambda here: 1.05 if here < jump else 0.06, 30)
    assert been[:3] == pytest.approx([1.05, 0.555, been[2]])
    assert all(rests[-8:])
    assert abs(been[-1] - jump) < 0.25


def test_where_it_turns_back_for_once_it_goes_on_half_way():
    been, _ = followed(lambda here: 4.0 if here in (0.0, 1.0) else 1.0 if here == 4.0 else 8.0, 24)
    assert been[-1] == pytest.approx(8.0, rel=0.2)
