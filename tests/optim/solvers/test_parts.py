"""Which chains are eliminated together, and what their memory is."""

from __future__ import annotations

import torch

from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean
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
    whole, parts = ChainBackend(plan), ChainBackend(planned_ahead(built, values, plan))
    damping = torch.tensor([1e-4], dtype=torch.float64)
    one, other = (b.assemble(built, values).solve(damping) for b in (whole, parts))
    for name in values:
        torch.testing.assert_close(one.delta[name], other.delta[name], rtol=1e-9, atol=1e-12)
    rows = [backend.prepare(built, values)[0].store_rows for backend in (whole, parts)]
    assert rows[1] < 0.6 * rows[0]
