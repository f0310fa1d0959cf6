"""Orders of landmarks whose matrices stay sparse."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from crowdmap_torch.optim.problem import Problem, Variable, euclidean
from crowdmap_torch.optim.solvers.dissection import dissected, incidence, near_each_other
from crowdmap_torch.optim.solvers.layout import layout
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


def bound_by(rows, count):
    row = np.repeat(np.arange(len(rows)), [len(r) for r in rows])
    return incidence(row, np.concatenate(rows), count)


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
    found = dissected(bound, np.full(count, 8), near_each_other(bound))
    assert sorted(found) == list(range(count))


def test_what_binds_two_parts_is_behind_both():
    bound, count = road(8, each=30, over=4)
    found = dissected(bound, np.full(count, 8), near_each_other(bound))
    # Cells of 30 landmarks: the last ones of all are among those that two cells share.
    last = np.argsort(found)[-3:]
    assert (last % 30 >= 26).all()


def test_the_factor_of_a_city_is_sparser_than_in_a_line():
    bound, count = grid(16)
    line = near_each_other(bound)
    assert fill(bound, dissected(bound, np.full(count, 30), line)) < 0.8 * fill(bound, line)


def test_the_factor_of_a_road_grows_with_its_length():
    sizes = []
    for cells in (8, 16, 32):
        bound, count = road(cells)
        sizes.append(fill(bound, dissected(bound, np.full(count, 8), near_each_other(bound))))
    assert sizes[1] < 2.3 * sizes[0] and sizes[2] < 2.3 * sizes[1]


def test_few_landmarks_and_those_that_all_are_bound_to_stay_in_line():
    bound, count = road(4)
    line = near_each_other(bound)
    assert (dissected(bound, np.ones(count, dtype=np.int64), line) == line).all()
    clique = bound_by([np.arange(count)], count)
    assert (dissected(clique, np.full(count, 8), line) == line).all()


def test_roads_apart_from_each_other_are_ordered_one_by_one():
    one, count = road(4)
    row, column = (np.asarray(at, dtype=np.int64) for at in one.nonzero())
    row, column = np.concatenate((row, row + 4)), np.concatenate((column, column + count))
    bound = incidence(row, column, 2 * count)
    found = dissected(bound, np.full(2 * count, 8), near_each_other(bound))
    first, second = found[:count], found[count:]
    assert first.max() < second.min() or second.max() < first.min()


@pytest.mark.parametrize("world", [road, grid])
def test_tiles_of_a_factor_are_those_that_elimination_fills(world):
    bound, count = world(12)
    each = 24
    by, landmark = (torch.from_numpy(x).long() for x in bound.nonzero())
    variables = {"mark": Variable(each, euclidean)}
    where = layout(Problem(variables, {}), {"mark": torch.zeros(count, each)})
    blocks = LandmarkBlocks.of(where, torch.device("cpu"))
    line = near_each_other(bound)
    for found in (line, dissected(bound, np.full(count, each), line)):
        tiles = tiles_of_factor(by, landmark, blocks, torch.from_numpy(found))
        # Tiles of 160 columns hold up to eight landmarks of 24.
        order = np.argsort(found)
        tile = np.arange(count) * each // 160, ((np.arange(count) + 1) * each - 1) // 160
        holds = np.zeros((bound.shape[0], tile[1].max() + 1), dtype=bool)
        dense = bound.toarray()[:, order] > 0
        for at in tile:
            for k, t in enumerate(at):
                holds[:, t] |= dense[:, k]
        expected = fill(
            bound_by([np.nonzero(r)[0] for r in holds], holds.shape[1]), np.arange(holds.shape[1])
        )
        assert tiles == expected
