"""Orders of landmarks whose matrices stay sparse."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

from crowdmap_torch.optim.problem import Problem, Variable, euclidean
from crowdmap_torch.optim.solvers.dissection import dissected, incidence, near_each_other
from crowdmap_torch.optim.solvers.layout import layout
from crowdmap_torch.optim.solvers.sparse_tiles import tile_width
from crowdmap_torch.optim.solvers.tile_patterns import tiles_of_factor
from crowdmap_torch.optim.solvers.windows import LandmarkBlocks


def road(cells, each=30, over=3):
    """Landmarks along a road, each bound to those of its cell, the last few of a cell to the next cell as well."""
    count = cells * each
    rows = [np.arange(max(c * each - over, 0), (c + 1) * each) for c in range(cells)]
    return bound_by(rows, count), count


def grid(cells, each=6):
    """Landmarks of the squares of a city, bound to those of their square and of the next ones along either street."""
    number = np.arange(cells * cells * each).reshape(cells, cells, each)
    rows = [number[:, i : i + 2][r].ravel() for i in range(cells - 1) for r in range(cells)]
    rows += [number[i : i + 2, c].ravel() for i in range(cells - 1) for c in range(cells)]
    return bound_by(rows, number.size), number.size


def streets(each_way, each=24, seen=12):
    """Landmarks along streets that cross, each bound to the next ones along its street, and at crossings across."""
    length = (each_way - 1) * each
    number = np.arange(2 * each_way * length).reshape(2 * each_way, length)
    rows = [street[i : i + seen] for street in number for i in range(0, length, seen // 2)]
    for i in range(1, each_way - 1):
        for j in range(1, each_way - 1):
            own = (number[i, j * each - 2 : j * each + 2], number[each_way + j, i * each - 2 :][:4])
            rows.append(np.concatenate(own))
    return bound_by(rows, number.size), number.size


def bound_by(rows, count):
    row = np.repeat(np.arange(len(rows)), [len(r) for r in rows])
    return incidence(row, np.concatenate(rows), count)


def landmarks(count, each):
    """So many landmarks of a width."""
    values = {"mark": torch.zeros(count, each)}
    where = layout(Problem({"mark": Variable(each, euclidean)}, {}), values)
    return LandmarkBlocks.of(where, torch.device("cpu"))


def fill(bound, position):
    """Entries of the factor of a matrix in this order, by elimination one after the other."""
    matrix = (bound.T @ bound).toarray() > 0
    order = np.argsort(position)
    matrix = np.triu(matrix[order][:, order])
    for k in range(len(matrix)):
        right = np.nonzero(matrix[k, k + 1 :])[0] + k + 1
        if len(right):
            matrix[right[0], right] = True
    return int(matrix.sum())


@pytest.mark.parametrize("world", [road, grid])
def test_every_landmark_has_a_place_of_its_own(world):
    bound, count = world(6)
    found, _ = dissected(bound, np.full(count, 8), near_each_other(bound))
    assert sorted(found) == list(range(count))


def test_what_binds_two_parts_is_behind_both():
    bound, count = road(8, each=30, over=4)
    found, _ = dissected(bound, np.full(count, 8), near_each_other(bound))
    # Cells of 30 landmarks: the last ones of all are among those that two cells share.
    last = np.argsort(found)[-3:]
    assert (last % 30 >= 26).all()


def test_the_factor_of_a_city_is_sparser_than_in_a_line():
    bound, count = grid(16)
    line = near_each_other(bound)
    found, _ = dissected(bound, np.full(count, 30), line)
    assert fill(bound, found) < 0.8 * fill(bound, line)


def test_tiles_that_begin_with_the_halves_of_a_city_are_fewer():
    bound, count = streets(12)
    width = np.full(count, 24)
    blocks = landmarks(count, 24)
    by, landmark = (torch.from_numpy(x).long() for x in bound.nonzero())
    line = near_each_other(bound)
    found, section = (torch.from_numpy(x) for x in dissected(bound, width, line))
    with_sections = tiles_of_factor(by, landmark, blocks, found, section)
    assert with_sections < 0.7 * tiles_of_factor(by, landmark, blocks, found)
    assert with_sections < 0.5 * tiles_of_factor(by, landmark, blocks, torch.from_numpy(line))


def test_what_is_in_a_section_is_bound_to_no_other_but_by_what_is_behind_both():
    bound, count = grid(16)
    found, section = dissected(bound, np.full(count, 30), near_each_other(bound))
    ordered = section[np.argsort(found)]
    assert (np.diff(ordered) >= 0).all() and ordered[-1] > 3
    begins = np.searchsorted(ordered, np.arange(ordered[-1] + 1))
    matrix = ((bound.T @ bound).toarray() > 0)[np.argsort(found)][:, np.argsort(found)]
    # By elimination: what the first section leaves behind touches its next neighbour only where that ends.
    for this, after in pairwise(begins):
        assert not matrix[this:after, after : after + 4].any()


def test_the_factor_of_a_road_grows_with_its_length():
    sizes = []
    for cells in (8, 16, 32):
        bound, count = road(cells)
        found, _ = dissected(bound, np.full(count, 8), near_each_other(bound))
        sizes.append(fill(bound, found))
    assert sizes[1] < 2.3 * sizes[0] and sizes[2] < 2.3 * sizes[1]


def test_few_landmarks_and_those_that_all_are_bound_to_stay_in_line():
    bound, count = road(4)
    line = near_each_other(bound)
    clique = bound_by([np.arange(count)], count)
    for one, width in ((bound, 1), (clique, 8)):
        found, section = dissected(one, np.full(count, width), line)
        assert (found == line).all() and not section.any()


def test_roads_apart_from_each_other_are_ordered_one_by_one():
    one, count = road(4)
    row, column = (np.asarray(at, dtype=np.int64) for at in one.nonzero())
    row, column = np.concatenate((row, row + 4)), np.concatenate((column, column + count))
    bound = incidence(row, column, 2 * count)
    found, section = dissected(bound, np.full(2 * count, 8), near_each_other(bound))
    assert not np.isin(section[:count], section[count:]).any()
    first, second = found[:count], found[count:]
    assert first.max() < second.min() or second.max() < first.min()


@pytest.mark.parametrize("world", [road, grid])
def test_tiles_of_a_factor_are_those_that_elimination_fills(world):
    bound, count = world(12)
    each = 24
    by, landmark = (torch.from_numpy(x).long() for x in bound.nonzero())
    blocks, line = landmarks(count, each), near_each_other(bound)
    nested = dissected(bound, np.full(count, each), line)
    grid_of = tile_width(count * each, torch.device("cpu"))
    for found, section in ((line, 0 * line), nested):
        order = np.argsort(found)
        tiles = tiles_of_factor(by, landmark, blocks, *map(torch.from_numpy, (found, section)))
        first, at = np.empty(count, dtype=np.int64), 0
        for place, own in enumerate(section[order]):
            if place and own != section[order][place - 1]:
                at = -(-at // grid_of) * grid_of
            first[place], at = at, at + each
        tile = first // grid_of, (first + each - 1) // grid_of
        holds = np.zeros((bound.shape[0], tile[1].max() + 1), dtype=bool)
        dense = bound.toarray()[:, order] > 0
        for at in tile:
            for k, t in enumerate(at):
                holds[:, t] |= dense[:, k]
        expected = fill(
            bound_by([np.nonzero(r)[0] for r in holds], holds.shape[1]), np.arange(holds.shape[1])
        )
        assert tiles == expected
