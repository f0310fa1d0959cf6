"""Drives that no sign ties to others are placed by their lane markers, where these tell how."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from worlds import lane_world

from crowdmap_torch.crowd_lanes.tie_groups import GroupTieConfig, GroupTies, _Told, tie_groups
from crowdmap_torch.crowd_signs.groups import OtherPlaces
from crowdmap_torch.geometry import se3
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.tables import Lanes

NOISE, CONFIG = PositioningNoise(), GroupTieConfig()
GROUP = torch.tensor([0, 0, 1, 1])
SIGMA = torch.tensor([0.6, 0.6, 0.9], dtype=torch.float64).expand(4, 3)
ROAD = (-3.6, 0.0, 3.4)
"""Two lanes: where their markers are to the left of the middle [m]."""


def along(offset: float, length: float, *, north: bool = False) -> np.ndarray:
    """A straight line with control points 10 m apart, `offset` left of the axis that it runs along."""
    s = np.arange(0.0, length + 1, 10.0)
    return np.stack((-offset + 0 * s, s, 0 * s) if north else (s, offset + 0 * s, 0 * s), axis=1)


def way(offset: float, length: float, *, north: bool = False) -> Tensor:
    """Poses of a drive there."""
    position = torch.from_numpy(along(offset, length, north=north))
    return se3.make(torch.eye(3).double().expand(len(position), 3, 3), position)


def drives(
    lines: list[list[np.ndarray]], shift: tuple[float, float, float], seed: int = 0
) -> Lanes:
    """Two drives that saw the first lines, and two that saw the others, moved by a shift."""
    rng = np.random.default_rng(seed)
    rows = [
        (points + (np.array(shift) if drive > 1 else 0.0), drive, track)
        for drive in range(4)
        for track, points in enumerate(lines[drive > 1])
    ]
    control, journey, track = (list(column) for column in zip(*rows, strict=True))
    control = [points + 0.05 * rng.normal(size=points.shape) for points in control]
    kind, frame = [0] * len(rows), [50] * len(rows)
    return lane_world.pieces(control, type=kind, journey=journey, tracklet=track, frame=frame)


def tied(lanes: Lanes, ways: list[Tensor], *, sigma: Tensor = SIGMA) -> GroupTies:
    return tie_groups(lanes, ways, GROUP, sigma, NOISE, CONFIG)


def relative(ties: GroupTies) -> Tensor:
    """By how much the second group is moved against the first one, all its drives alike."""
    assert torch.equal(ties.move[0], ties.move[1]) and torch.equal(ties.move[2], ties.move[3])
    return ties.move[2] - ties.move[0]


def both_ways(shift: tuple[float, float, float], length: float, *, turns: bool) -> list[Tensor]:
    """Two drives one way, two the other, these moved."""
    there = (
        way(-1.8, length)
        if not turns
        else torch.cat((way(-1.8, length), way(-1.8, length, north=True)))
    )
    back = there.clone()
    back[:, :3, 3] += torch.tensor([0.0, 3.5, 0.0]).double() + torch.tensor(shift).double()
    return [there, there, back, back]


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("shift", [(0.8, -2.6, 0.5), (-1.9, 1.1, -0.7), (0.0, 0.9, 0.0)])
def test_where_roads_turn_both_axes_and_the_height_are_found(
    shift: tuple[float, float, float], seed: int
):
    lines = [along(x, 600, north=north) for north in (False, True) for x in ROAD]
    ties = tied(drives([lines, lines], shift, seed), both_ways(shift, 600, turns=True))
    torch.testing.assert_close(
        relative(ties), -torch.tensor(shift, dtype=torch.float64), rtol=0, atol=0.2
    )
    # What all share is not touched.
    assert float((ties.move / SIGMA.square()).sum(0).abs().max()) < 1e-9


def test_along_a_straight_road_drives_stay_where_they_are():
    lines, shift = [along(x, 400) for x in ROAD], (0.9, 1.3, 0.0)
    found = relative(tied(drives([lines, lines], shift), both_ways(shift, 400, turns=False)))
    assert abs(float(found[1]) + 1.3) < 0.2
    assert abs(float(found[0])) < 0.3


@pytest.mark.parametrize("across", [0.3, -0.4, 0.8, -0.9])
def test_drives_that_see_their_own_lane_alone_are_not_put_into_that_of_the_others(across: float):
    lines = [[along(x, 400) for x in ROAD[:2]], [along(x, 400) for x in ROAD[1:]]]
    ways = both_ways((0.0, across, 0.0), 400, turns=False)
    found = relative(tied(drives(lines, (0.0, across, 0.0)), ways))
    assert abs(float(found[1]) + across) < 1.0


def test_what_fits_as_well_otherwise_is_told():
    lines = [along(3.5 * k, 400) for k in range(-3, 4)]
    shift = (0.0, 1.75, 0.0)
    ties = tied(drives([lines, lines], shift), both_ways(shift, 400, turns=False))
    assert ties.open_groups == [1]
    assert abs(abs(float(relative(ties)[1])) - 1.75) < 0.3
    # The other one is to the other side.
    assert abs(float(ties.rival[1, 1] + 2 * relative(ties)[1])) < 0.3


def alike(*aside: float, hosts: int = 3) -> OtherPlaces:
    """The last of four drives has one sign; those like it are so far to the left of its place, its own first."""
    n = len(aside)
    shift = torch.tensor([(0.0, left) for left in aside], dtype=torch.float64)
    seen_by = (torch.arange(4) < hosts).expand(n, 4)
    is_own, head = torch.arange(n) == 0, torch.arange(n)
    return OtherPlaces(torch.full((n,), 3), 0 * head, head, is_own, shift, 0 * shift, seen_by)


@pytest.mark.parametrize("way_out", [-1.0, 1.0])
def test_where_lanes_fit_twice_signs_that_are_alike_tell(way_out: float):
    """Markers 3.5 m apart; those of the last drive are half way between the others'."""
    lines = [along(3.5 * k, 400) for k in range(-3, 4)]
    step = np.array([0.0, 1.75, 0.0])
    rows = [(line, drive) for drive in range(3) for line in lines]
    rows += [(line + step, 3) for line in lines[:-1]]
    control, journey = (list(column) for column in zip(*rows, strict=True))
    made = lane_world.pieces(
        control,
        type=[0] * len(rows),
        journey=journey,
        tracklet=[*range(len(rows))],
        frame=[50] * len(rows),
    )
    ways = [way(0.0, 400)] * 4
    group = torch.tensor([0, 0, 0, 1])
    told = made, ways, group, SIGMA, NOISE, CONFIG
    ties = tie_groups(*told, others=alike(0.0, 1.9 * way_out))
    moved = ties.move[3, 1] - ties.move[0, 1]
    assert abs(float(moved) - 1.75 * way_out) < 0.4
    assert ties.is_shifted.tolist() == [False, True] and ties.open_groups == []
    # Where its own sign is the only one, neither place is better.
    assert tie_groups(*told, others=alike(0.0)).open_groups == [1]


@pytest.mark.parametrize(("valley", "mean"), [(-1.0, 0.0), (-20.0, -2.0)])
def test_shifts_that_run_into_each_other_are_averaged(valley: float, mean: float):
    axis = torch.arange(-4, 5).double()
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), dim=-1)
    along_the_road = torch.full((9,), -30.0).double()
    along_the_road[2:7] = torch.tensor([0.0, valley, valley, valley, 0.0])
    logs = along_the_road[:, None] - 50 * axis.square()
    told = _Told(logs, grid, [axis, axis], CONFIG)
    torch.testing.assert_close(told.best[0], torch.tensor(-2.0).double(), rtol=0, atol=0.5)
    torch.testing.assert_close(told.mean(), torch.tensor([mean, 0.0]).double(), rtol=0, atol=1e-6)


def test_who_is_known_better_stays():
    lines = [along(x, 600, north=north) for north in (False, True) for x in ROAD]
    shift = (0.0, 1.2, 0.0)
    sigma = SIGMA * torch.tensor([0.1, 0.1, 1.0, 1.0]).double()[:, None]
    ties = tied(drives([lines, lines], shift), both_ways(shift, 600, turns=True), sigma=sigma)
    assert float(ties.move[0].norm()) < 0.02 < 0.9 < float(ties.move[2].norm())


def test_groups_on_other_roads_stay():
    lines = [[along(x, 200) for x in ROAD], [along(x + 500, 200) for x in ROAD]]
    ways = [way(-1.8, 200)] * 2 + [way(498.2, 200)] * 2
    assert not bool(tied(drives(lines, (0.0, 0.0, 0.0)), ways).move.any())


def test_drives_of_one_group_and_no_lanes_at_all_are_no_matter():
    lines = [along(x, 200) for x in ROAD]
    lanes, ways = (
        drives([lines, lines], (0.0, 2.0, 0.0)),
        both_ways((0.0, 2.0, 0.0), 200, turns=False),
    )
    one = tie_groups(lanes, ways, torch.zeros_like(GROUP), SIGMA, NOISE, CONFIG)
    none = tied(lanes.select(torch.zeros(0, dtype=torch.int64)), ways)
    assert not bool(one.move.any()) and not bool(none.move.any())


def test_several_groups_are_placed_one_after_the_other():
    lines = [along(x, 600, north=north) for north in (False, True) for x in ROAD]
    shift = (0.3, -1.6, 0.0)
    lanes, ways = drives([lines, lines], shift), both_ways(shift, 600, turns=True)
    third = replace(lanes, journey=torch.where(lanes.journey == 3, 4, lanes.journey))
    lanes = third.select(torch.argsort(third.journey, stable=True))
    group, sigma = torch.tensor([0, 0, 1, 2, 2]), SIGMA[:1].expand(5, 3)
    ties = tie_groups(lanes, [*ways, ways[3]], group, sigma, NOISE, CONFIG)
    for drive in (2, 4):
        found = ties.move[drive] - ties.move[0]
        torch.testing.assert_close(found, -torch.tensor(shift).double(), rtol=0, atol=0.3)


@pytest.mark.parametrize("height", [6.0, -7.5])
def test_a_road_over_another_one_is_not_put_onto_it(height: float):
    lines = [along(x, 600, north=north) for north in (False, True) for x in ROAD]
    shift = (0.8, -2.6, height)
    ties = tied(drives([lines, lines], shift), both_ways(shift, 600, turns=True))
    assert not ties.move.any() and not ties.open_groups
