"""What a plan of elimination promises is checked where it is stated."""

from __future__ import annotations

import pytest
import torch

from crowdmap_torch.optim.solvers.plan import EliminationPlan


def test_blocks_are_counted_over_leaves_and_chains():
    chain, carrier = torch.tensor([4, 4, 2]), torch.tensor([2, 0, 1, 2])
    plan = EliminationPlan("drift", chain, "pose", carrier)
    assert plan.first_block == {"pose": 0, "drift": 4}
    assert plan.owner.tolist() == [2, 4, 4, 2, 4, 4, 2]
    assert (plan.chain_count, plan.leaf_count) == (2, 4)
    assert EliminationPlan("drift", chain).owner.tolist() == chain.tolist()


def test_a_chain_in_pieces_is_refused():
    with pytest.raises(ValueError, match="2 chains in 3 pieces"):
        EliminationPlan("drift", torch.tensor([0, 1, 0]))


def test_leaves_that_hang_on_nothing_are_refused():
    chain = torch.tensor([0, 0])
    with pytest.raises(ValueError, match="both or neither"):
        EliminationPlan("drift", chain, leaves="pose")
    with pytest.raises(ValueError, match="carrier"):
        EliminationPlan("drift", chain, "pose", torch.tensor([0, 2]))
