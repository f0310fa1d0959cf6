"""How much of what a detection's corners have wrong together lasts from one detection to the next."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
import torch
from torch import Tensor

from crowdmap_torch.adjustment.bundle import Bundle, Evidence
from crowdmap_torch.adjustment.observations import CornerObservations
from crowdmap_torch.adjustment.shared_corner_errors import (
    Lasting,
    corner_detections,
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
    assert abs(float(found.shift) - expected) < 0.25 * expected + 0.03
    # A shift is no size, and what noise leaves of it is none.
    assert float(found.size) == 0


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
    assert abs(float(found.size) - expected) <= 0.35 * expected
    assert float(found.shift) < 0.03
    # Centres of boxes, which have no size, change nothing.
    centres = torch.arange(len(table)) % _CORNERS == 0
    more = replace(
        table, **{name: torch.cat((of, of[centres])) for name, of in vars(table).items()}
    )
    alone = table.detection[centres] + 1
    more = replace(more, detection=torch.cat((table.detection, alone)))
    error = errors(0.0, lasts, seed, size) + larger
    beside = lasting(more, torch.cat((error, error[centres])), used.repeat(2), 0.0)
    torch.testing.assert_close(beside.size, found.size)


def test_outliers_and_what_is_given_up_do_not_matter():
    table, error = rows(), errors(0.0, 0.0, 0)
    detections = corner_detections(table)
    wild = table.detection % 40 == 0
    error[wild] += 30.0
    for counted in (~wild, torch.ones_like(wild)):
        used = detections.have(counted)
        assert int(used.sum()) == int(counted.sum()) // _CORNERS
        assert float(lasting(table, error, used, 0.0).shift) < 0.15
    none = lasting(table, error, used & False, 1.0)
    assert not none.shift and not none.size


def test_detections_of_other_signs_drives_and_kinds_do_not_follow_each_other():
    table = rows()
    first = corner_detections(table)
    follower = first.follower
    count = len(follower)
    expected = torch.arange(count) + _SIGNS
    expected[torch.arange(count) // _SIGNS % _VIEWS == _VIEWS - 1] = -1
    assert (follower == expected).all()
    # The centres of boxes, of odd numbers, are detections beside those of their corners.
    both = replace(table, detection=table.detection + (torch.arange(len(table)) % 4 == 3))
    twice = corner_detections(both)
    assert (twice.count[::2] == 3).all() and (twice.count[1::2] == 1).all()
    used = twice.follower >= 0
    assert (twice.follower[used] % 2 == torch.nonzero(used)[:, 0] % 2).all()


def test_what_lasts_takes_off_the_say_of_the_mean_and_of_the_size_alone():
    table = rows()
    sigma = torch.full((len(table),), 0.5, dtype=F64)
    lasts = Lasting(torch.tensor(3.0, dtype=F64), torch.tensor(1e-4, dtype=F64))
    shared = shared_errors(corner_detections(table), table.px, sigma, lasts)
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
    changed.lasting.zero_()
    changed.lasting_size.zero_()
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
    assert 1.0 < float(tight.lasting) < 7.0
    torch.testing.assert_close(mixed.lasting, tight.lasting)
