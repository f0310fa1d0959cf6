"""Conjugate gradients on the Schur complement against the dense solve."""

from __future__ import annotations

import pytest
import torch
from worlds.bordered_chains import drives, rows_of, shared_drives, wandering_drives

from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean
from crowdmap_torch.optim.solvers.bordered import BorderedBackend
from crowdmap_torch.optim.solvers.conjugate_gradient import ConjugateGradientBackend
from crowdmap_torch.optim.solvers.dense import DenseBackend
from crowdmap_torch.optim.solvers.plan import EliminationPlan


def conjugate_gradients(plan: EliminationPlan, **changes) -> ConjugateGradientBackend:
    settings = {"tolerance": 1e-12, "chunk_rows": 50, **changes}
    return ConjugateGradientBackend(plan, **settings)


@pytest.mark.parametrize("world", [drives, shared_drives, wandering_drives])
@pytest.mark.parametrize("lengths", [(30, 1, 17), (1,), (64, 63)])
def test_conjugate_gradients_give_the_dense_step(lengths, world):
    problem, values, plan = world(lengths)
    ours, dense = (b.assemble(problem, values) for b in (conjugate_gradients(plan), DenseBackend()))
    torch.testing.assert_close(ours.cost, dense.cost)
    for damping in (1e-9, 1e-2, 1e2):
        damping = torch.tensor([damping], dtype=torch.float64)
        mine, theirs = ours.solve(damping), dense.solve(damping)
        assert bool(mine.solved)
        for name in values:
            torch.testing.assert_close(mine.delta[name], theirs.delta[name], rtol=1e-7, atol=1e-9)
        torch.testing.assert_close(mine.predicted, theirs.predicted)
        torch.testing.assert_close(mine.norm, theirs.norm)


@pytest.mark.parametrize("lengths", [(30, 1, 17), (1,), (64, 63)])
def test_block_covariances_are_those_of_the_dense_inverse_with_all_else_held(lengths):
    problem, values, plan = drives(lengths)
    dense = DenseBackend().assemble(problem, values)
    rows = torch.cat([rows_of(dense, name) for name in ("pose", "drift")])
    inverse = torch.linalg.inv(dense.hessian[0][rows[:, None], rows])
    k = problem.variables["drift"].tangent_dim
    n = len(rows) // k
    every = torch.arange(n)
    expected = inverse.view(n, k, n, k)[every, :, every]
    for one in (BorderedBackend(plan), conjugate_gradients(plan)):
        normal = one.assemble(problem, values)
        found = torch.cat([normal.conditional_covariance(name) for name in ("pose", "drift")])
        torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-12)


def test_a_chain_alone_is_solved_too():
    chain = torch.zeros(9, dtype=torch.long)
    every = torch.arange(9)
    terms = {"prior": CostTerm(lambda d: d - 1.5, (("drift", every),))}
    problem = Problem({"drift": Variable(2, euclidean)}, terms)
    values = {"drift": torch.linspace(0, 1, 18, dtype=torch.float64).view(9, 2)}
    backend = ConjugateGradientBackend(EliminationPlan("drift", chain))
    step = backend.assemble(problem, values).solve(torch.zeros(1).double())
    torch.testing.assert_close(
        values["drift"] + step.delta["drift"], torch.full((9, 2), 1.5).double()
    )


def test_the_minimum_is_that_of_the_bordered_back_end():
    problem, values, plan = drives(seed=1)
    config = lm.LmConfig(cost_tolerance=1e-13)
    ours = lm.solve(problem, values, config, backend=conjugate_gradients(plan))
    theirs = lm.solve(problem, values, config, backend=BorderedBackend(plan))
    assert ours.done
    for name, value in theirs.values.items():
        torch.testing.assert_close(ours.values[name], value, rtol=0, atol=1e-6)


def test_samples_have_the_covariance_of_the_dense_inverse():
    problem, values, plan = drives()
    inverse = torch.linalg.inv(DenseBackend().assemble(problem, values).hessian[0])
    dense = DenseBackend().assemble(problem, values)
    count = 4000
    drawn = (
        conjugate_gradients(plan)
        .assemble(problem, values)
        .samples(count, torch.Generator().manual_seed(0), floor=0.0)
    )
    for name in values:
        at = rows_of(dense, name)
        expected = inverse[at][:, at]
        flat = drawn[name].flatten(0, 1)
        found = flat @ flat.mT / count
        # An entry's standard deviation is at most sqrt(2 / count) of the variances' product.
        bound = 6 * (2 / count) ** 0.5 * expected.diagonal().max()
        assert (found - expected).abs().max() < bound


def test_too_few_iterations_are_no_step():
    problem, values, plan = drives()
    ours = conjugate_gradients(plan, max_iterations=2).assemble(problem, values)
    step = ours.solve(torch.tensor([1e-9], dtype=torch.float64))
    assert not bool(step.solved)
    assert not any(delta.any() for delta in step.delta.values())
