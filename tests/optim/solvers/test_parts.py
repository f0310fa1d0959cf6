"""Which chains are eliminated together, and what their memory is."""

from __future__ import annotations

import pytest
import torch

from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean
from crowdmap_torch.optim.solvers import elimination, parts
from crowdmap_torch.optim.solvers.chain_schur import ChainBackend
from crowdmap_torch.optim.solvers.elimination import planned_ahead
from crowdmap_torch.optim.solvers.parts import parts_of_chains
from crowdmap_torch.optim.solvers.plan import EliminationPlan

_LENGTH = 3000
"""Blocks of a chain: two of them are a part."""


def along(x, mark, measured):
    return mark - x - measured


def moved(x, y):
    return y - x


def roads(*first_mark: int) -> tuple[Problem, dict[str, torch.Tensor], EliminationPlan]:
    """Chains that drive past thirty landmarks each, from their first one on; each block sees the nearest."""
    chain = torch.arange(len(first_mark)).repeat_interleave(_LENGTH)
    step = torch.arange(_LENGTH).repeat(len(first_mark))
    mark = torch.tensor(first_mark)[chain] + step * 30 // _LENGTH
    every = torch.arange(len(chain))
    linked = torch.nonzero(chain[1:] == chain[:-1])[:, 0]
    measured = torch.randn(len(chain), 2, generator=torch.Generator().manual_seed(1)).double()
    terms = {
        "along": CostTerm(along, (("pose", every), ("mark", mark)), (measured,)),
        "moved": CostTerm(moved, (("pose", linked), ("pose", linked + 1))),
    }
    variables = {"pose": Variable(2, euclidean), "mark": Variable(2, euclidean)}
    values = {
        "pose": torch.zeros(len(chain), 2).double(),
        "mark": torch.zeros(int(mark.max()) + 1, 2).double(),
    }
    return Problem(variables, terms), values, EliminationPlan("pose", chain)


def test_chains_that_see_the_same_landmarks_are_a_part():
    # Two roads, driven in turns; the last drive sees more of the second than of the first.
    built, values, plan = roads(0, 40, 2, 38, 1, 25)
    part = planned_ahead(built, values, plan).part
    assert part is not None
    assert part[0] == part[2] == part[4] != part[1]
    assert part[1] == part[3] == part[5]


def test_all_chains_are_one_part_where_they_see_the_same_or_are_few():
    built, values, plan = roads(0, 2, 4)
    assert planned_ahead(built, values, plan).part is None
    # One chain alone is less than a part is worth.
    built, values, plan = roads(0, 40)
    assert planned_ahead(built, values, plan).part is None


def test_a_chain_that_sees_nothing_is_of_some_part():
    _, _, plan = roads(0, 0, 40, 40, 40)
    seen = torch.arange(4 * _LENGTH)
    mark = torch.tensor([0, 0, 40, 40]).repeat_interleave(_LENGTH)
    part = parts_of_chains(seen * 100 + mark, plan, 100)
    assert part is not None
    assert part[0] == part[1] != part[2]
    assert part[2] == part[3] and part[4] in (0, 1)


def test_parts_share_memory_and_the_step_is_that_of_all_at_once():
    built, values, plan = roads(0, 40, 2, 38)
    whole, apart = ChainBackend(plan), ChainBackend(planned_ahead(built, values, plan))
    damping = torch.tensor([1e-4], dtype=torch.float64)
    one, other = (b.assemble(built, values).solve(damping) for b in (whole, apart))
    for name in values:
        torch.testing.assert_close(one.delta[name], other.delta[name], rtol=1e-9, atol=1e-12)
    of_whole, of_parts = (b.prepare(built, values)[0].parts for b in (whole, apart))
    assert len(of_whole) == 1 and len(of_parts) == 2
    assert max(part.store_rows for part in of_parts) < 0.6 * of_whole[0].store_rows


def test_large_parts_are_cut_between_chains_into_an_even_number_of_pieces(
    monkeypatch: pytest.MonkeyPatch,
):
    chain = torch.arange(10).repeat_interleave(torch.tensor([30, 10, 20, 30, 10, 20, 10, 5, 5, 20]))
    plan = EliminationPlan("pose", chain, part=torch.tensor([0, 1, 0, 0, 1, 0, 1, 1, 1, 0]))
    monkeypatch.setattr(parts, "_PIECE", 30)
    cut = parts.in_pieces(plan).part
    assert cut is not None
    # 120 blocks make four pieces of a chain or two; 40 are not enough for two pieces.
    assert cut.tolist() == [0, 4, 1, 1, 4, 2, 4, 4, 4, 3]
    monkeypatch.setattr(parts, "_PIECE", 81)
    assert parts.in_pieces(plan) is plan


def test_leaves_are_in_the_piece_of_the_chain_that_carries_them(monkeypatch: pytest.MonkeyPatch):
    chain = torch.arange(4).repeat_interleave(5)
    plan = EliminationPlan("drift", chain, "pose", torch.arange(20).repeat_interleave(3))
    monkeypatch.setattr(parts, "_PIECE", 40)
    cut = parts.in_pieces(plan)
    assert cut.part is not None and cut.part.tolist() == [0, 0, 1, 1]
    assert torch.bincount(cut.part_of_blocks).tolist() == [40, 40]


@pytest.mark.parametrize("few_rows", [0, 1 << 21])
def test_pieces_give_the_step_of_the_whole_with_the_same_bits_by_any_number_of_threads(
    monkeypatch: pytest.MonkeyPatch, few_rows: int
):
    built, values, plan = roads(0, 5, 2, 3, 8)
    damping = torch.tensor([1e-4], dtype=torch.float64)
    whole = ChainBackend(plan).assemble(built, values).solve(damping)
    monkeypatch.setattr(parts, "_PIECE", 3000)
    monkeypatch.setattr(elimination, "_FEW_ROWS", few_rows)
    found, before = [], torch.get_num_threads()
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        backend = ChainBackend(plan)
        equations = backend.assemble(built, values)
        found.append((equations.solve(damping), equations.correct(values)))
        torch.set_num_threads(before)
        structure, _ = backend.prepare(built, values)
        assert len(structure.parts) == 4 and len(structure.lanes) == (2 if few_rows else 1)
        assert sorted(i for lane in structure.lanes for i in lane) == [0, 1, 2, 3]
    for name in values:
        torch.testing.assert_close(found[0][0].delta[name], whole.delta[name])
        for step, correction in found[1:]:
            assert torch.equal(step.delta[name], found[0][0].delta[name])
            assert torch.equal(correction.delta[name], found[0][1].delta[name])
