"""The matrix of what stays, block by block, against the same matrix in full."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from crowdmap_torch.optim.problem import Variable, euclidean
from crowdmap_torch.optim.solvers.journey_system import JourneySystem
from crowdmap_torch.optim.solvers.layout import Layout
from crowdmap_torch.optim.solvers.sparse_tiles import TileMatrix, TilePattern
from crowdmap_torch.optim.solvers.staying_blocks import Between, StayingBlocks

SIGN, LANE = Variable(4, euclidean).tangent_dim, Variable(3, euclidean).tangent_dim
WIDTH = 8


def blocks(seed):
    """Three signs and two lane points, a column between them that is nobody's, and the same matrix in full."""
    draw = torch.Generator().manual_seed(seed)
    sign, lane = torch.tensor([0, 4, 8]), torch.tensor([13, 16])
    used = torch.ones(1, 19, dtype=torch.bool)
    used[0, 12] = False
    where = Layout(
        {"sign": sign, "lane": lane},
        {"sign": torch.zeros_like(sign), "lane": torch.zeros_like(lane)},
        {"sign": SIGN, "lane": LANE},
        19,
        used,
    )
    own = {
        "sign": torch.randn(3, SIGN, SIGN, dtype=torch.float64, generator=draw),
        "lane": torch.randn(2, LANE, LANE, dtype=torch.float64, generator=draw),
    }
    own = {name: square + square.mT for name, square in own.items()}
    # The last two are of one place, the second touches a lane point twice.
    between = [
        Between(
            sign[[0, 2, 2]],
            lane[[1, 0, 0]],
            torch.randn(SIGN, LANE, 3, dtype=torch.float64, generator=draw),
        ),
        Between(
            lane[[0]], lane[[0]], torch.randn(LANE, LANE, 1, dtype=torch.float64, generator=draw)
        ),
    ]
    full = torch.zeros(19, 19, dtype=torch.float64)
    for name, at in where.offset.items():
        k = where.tangent_dim[name]
        for begin, square in zip(at.tolist(), own[name], strict=True):
            full[begin : begin + k, begin : begin + k] += square
    for row, column, square in between:
        for i, (r, c) in enumerate(zip(row.tolist(), column.tolist(), strict=True)):
            here, there = slice(r, r + square.shape[0]), slice(c, c + square.shape[1])
            full[here, there] += square[..., i]
            full[there, here] += square[..., i].T
    return StayingBlocks(where, own, tuple(of.joined(19) for of in between)), full


def summand_of(system, where):
    """What a system says at some point, which costs nothing."""
    values = {"sign": torch.arange(12.0).view(3, 4), "lane": torch.arange(6.0).view(2, 3)}
    return JourneySystem.of(system, where, values, torch.zeros(1)), values


def all_tiles(full):
    count = -(-len(full) // WIDTH)
    pattern = TilePattern.of(len(full), WIDTH, np.ones((count, count), bool), full.device)
    return TileMatrix.zeros(pattern, full)


@pytest.mark.parametrize("seed", range(3))
def test_blocks_add_up_to_the_matrix(seed):
    found, full = blocks(seed)
    system = all_tiles(full)
    found.add_to(system)
    torch.testing.assert_close(system.dense(), full)
    torch.testing.assert_close(found.diagonal(), full.diagonal())
    assert torch.nonzero(found.where.gaps).tolist() == [[12]]


def test_neighbours_of_one_place_are_added_up():
    found, _ = blocks(0)
    assert [len(of.row) for of in found.between] == [2, 1]


@pytest.mark.parametrize("seed", range(3))
def test_a_summand_holds_the_numbers_that_are_there_and_adds_them_to_others(seed):
    found, full = blocks(seed)
    system = all_tiles(full)
    found.add_to(system)
    system.right_side.copy_(torch.arange(19.0))
    summand, _ = summand_of(system, found.where)
    assert len(summand.information) == int((system.tiles != 0).sum())
    total = all_tiles(full)
    for _ in range(2):
        summand.add_to(total)
    torch.testing.assert_close(total.dense(), 2 * system.dense(), rtol=0, atol=0)
    torch.testing.assert_close(total.right_side, 2 * system.right_side, rtol=0, atol=0)


def test_a_sum_without_the_tiles_of_a_summand_is_refused():
    found, full = blocks(0)
    system = all_tiles(full)
    found.add_to(system)
    diagonal = TilePattern.of(19, WIDTH, np.eye(3, dtype=bool), full.device)
    with pytest.raises(AssertionError, match="has the tiles of its summands"):
        summand_of(system, found.where)[0].add_to(TileMatrix.zeros(diagonal, full))


def test_a_summand_knows_its_landmarks_and_where_they_are():
    found, full = blocks(0)
    system = all_tiles(full)
    found.add_to(system)
    # Nothing is said of the second sign, nor of the first lane point.
    system.tiles[...] = system.tiles * 0
    system.add_diagonal((torch.arange(19) < 4).double() + (torch.arange(19) >= 16))
    summand, values = summand_of(system, found.where)
    assert {name: of.tolist() for name, of in summand.block.items()} == {"sign": [0], "lane": [1]}
    assert torch.equal(summand.point["lane"], values["lane"][1:])
    assert summand.holds_at(values)
    elsewhere = {**values, "lane": values["lane"] + 1e-12 * torch.arange(3.0).double()}
    assert not summand.holds_at(elsewhere)
    others = {**values, "sign": values["sign"] + torch.tensor([[0.0], [1.0], [1.0]])}
    assert summand.holds_at(others)
