"""The one loop over rows: its costs, its order and its chunks."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.bordered_chains import drives

from crowdmap_torch.optim import linearize
from crowdmap_torch.optim.linearize import row_blocks, term_costs
from crowdmap_torch.optim.robust import JointTukey
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


def test_pieces_of_all_terms_are_handed_over_in_order_on_any_number_of_threads(
    monkeypatch: pytest.MonkeyPatch,
):
    problem, values, _ = drives()
    monkeypatch.setattr(linearize, "_MANY_ROWS", 1)
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            chunks: list[TermRows] = []
            costs = assemble(problem, values, row_blocks, chunks.append, chunk_rows=20)
            found.append((costs, chunks))
    finally:
        torch.set_num_threads(before)
    (alone, chunks), *others = found
    every = [(name, i) for name, term in problem.terms.items() for i in range(0, len(term), 20)]
    assert [(chunk.term, chunk.at.start) for chunk in chunks] == every
    for costs, own in others:
        assert torch.equal(costs.total, alone.total)
        assert [(chunk.term, chunk.at) for chunk in own] == [(c.term, c.at) for c in chunks]
        for a, b in zip(own, chunks, strict=True):
            assert all(map(torch.equal, a.blocks.gradient, b.blocks.gradient))


def test_rows_that_are_joined_stay_together_in_an_order_of_their_own():
    problem, values, _ = drives()
    term = problem.terms["sighting"]
    together, bound = torch.arange(len(term)) // 4, torch.tensor(4.0).double()
    joined = replace(term, loss=JointTukey.by_efficiency(together, bound, row_dim=2))
    order = torch.arange(len(term)).view(-1, 4).flip(0).flatten()
    chunks: list[TermRows] = []
    assemble(
        replace(problem, terms={"sighting": joined}),
        *(values, row_blocks, chunks.append),
        groups={"sighting": RowGroups(order)},
        chunk_rows=10,
    )
    assert len(chunks) > 2
    assert all(chunk.at.stop % 4 == 0 for chunk in chunks)


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
