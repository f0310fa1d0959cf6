"""The one loop over rows: its costs, its order and its chunks."""

from __future__ import annotations

import torch
from worlds.bordered_chains import drives

from crowdmap_torch.optim.linearize import row_blocks, term_costs
from crowdmap_torch.optim.solvers.assembly import BlockDiagonal, TermRows, assemble
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
    assemble(problem, values, row_blocks, chunks.append, order={"sighting": order}, chunk_rows=50)
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
