"""The one loop over rows: its costs, its order and its chunks."""

from __future__ import annotations

import pytest
import torch
from worlds.bordered_chains import drives

from crowdmap_torch.optim.linearize import row_blocks, term_costs
from crowdmap_torch.optim.solvers.assembly import BlockDiagonal, RowGroups, TermRows, assemble
from crowdmap_torch.optim.solvers.dense import DenseBackend


def test_costs_are_those_of_the_terms():
    problem, values, _ = drives()
    costs = assemble(problem, values, row_blocks, lambda _: None, chunk_rows=7)
    for name, cost in term_costs(problem, values).items():
        torch.testing.assert_close(costs.by_term[name], cost)
    torch.testing.assert_close(costs.total, sum(costs.by_term.values()))


def test_rows_come_in_chunks_and_in_the_order_asked_for():
    problem, values, _ = drives()
    count = len(problem.terms["sighting"])
    order = torch.arange(count).flip(0)
    chunks: list[TermRows] = []
    assemble(
        problem,
        values,
        row_blocks,
        chunks.append,
        groups={"sighting": RowGroups(order)},
        chunk_rows=50,
    )
    mine = [chunk for chunk in chunks if chunk.term == "sighting"]
    assert [chunk.at.start for chunk in mine] == list(range(0, count, 50))
    for slot, (_, block) in enumerate(problem.terms["sighting"].slots):
        found = torch.cat([chunk.slots[slot][1] for chunk in mine])
        assert torch.equal(found, block[order])


def test_diagonal_blocks_are_those_of_the_dense_matrix():
    problem, values, _ = drives()
    sums = BlockDiagonal(problem, values)
    assemble(problem, values, row_blocks, sums.add)
    dense = DenseBackend().assemble(problem, values)
    for name in values:
        at = dense.where.entries(name, slice(None))
        expected = dense.hessian[0][at[:, :, None], at[:, None]]
        torch.testing.assert_close(sums.hessian(name), expected)
        torch.testing.assert_close(sums.gradient(name), dense.gradient[0][at])


@pytest.mark.parametrize("chunk_rows", [3, 50, 10_000])
def test_rows_of_a_group_are_added_up_whatever_chunks_they_are_in(chunk_rows: int):
    problem, values, _ = drives()
    pose, mark = (block for _, block in problem.terms["sighting"].slots)
    order = torch.argsort(mark, stable=True)
    by_mark = mark[order]
    group = torch.unique(by_mark, return_inverse=True)[1]
    # Of slots that rows of a group do not have in common, nothing is asked.
    total = torch.zeros(len(values["mark"]), 2, 2, dtype=torch.double)
    gradient = torch.zeros(len(values["mark"]), 2, dtype=torch.double)

    def add(chunk: TermRows) -> None:
        if chunk.term != "sighting":
            return
        block = chunk.slots[1][1]
        assert len(block) == chunk.at.stop - chunk.at.start <= chunk_rows
        total.index_add_(0, block, chunk.blocks.hessian[1, 1].permute(2, 0, 1))
        gradient.index_add_(0, block, chunk.blocks.gradient[1].mT)

    groups = {"sighting": RowGroups(order, group)}
    costs = assemble(problem, values, row_blocks, add, groups=groups, chunk_rows=chunk_rows)
    every = row_blocks(problem.terms["sighting"], problem.variables, values)
    expected = torch.zeros_like(total).index_add_(0, mark, every.hessian[1, 1].permute(2, 0, 1))
    torch.testing.assert_close(total, expected)
    torch.testing.assert_close(
        gradient, torch.zeros_like(gradient).index_add_(0, mark, every.gradient[1].mT)
    )
    torch.testing.assert_close(costs.by_term["sighting"], every.rho.sum()[None] / 2)
    assert len(pose) > len(total)
