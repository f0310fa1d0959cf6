"""Steps with a kept matrix against Levenberg-Marquardt that factorises at every step."""

from __future__ import annotations

from dataclasses import replace

import torch

from crowdmap_torch.benchmark import free_corners
from crowdmap_torch.benchmark.bundle import MINIMISATION
from crowdmap_torch.benchmark.kept_matrix import minimise
from crowdmap_torch.optim.robust import Tukey
from crowdmap_torch.optim.solvers.chain_schur import ChainBackend
from crowdmap_torch.optim.solvers.plan import EliminationPlan


def test_a_kept_matrix_and_fresh_ones_reach_one_cost():
    problem = free_corners.simulate(3, 30, 4, seed=1)
    built, values = free_corners.bundle(problem, Tukey(50.0), torch.device("cpu"))
    chain = torch.arange(problem.J).repeat_interleave(problem.F)
    tight = replace(MINIMISATION, lm=replace(MINIMISATION.lm, cost_tolerance=1e-9))
    states = [
        minimise(
            built,
            values,
            replace(tight, reuse_below=below),
            ChainBackend(EliminationPlan("pose", chain)),
        )
        for below in (0.0, 1e-2)
    ]
    assert all(state.done for state in states)
    assert states[1].linearizations < states[0].linearizations
    torch.testing.assert_close(states[1].cost, states[0].cost, rtol=1e-7, atol=0)
