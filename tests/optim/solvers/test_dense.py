"""Independent problems of different size in one batch of dense matrices."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean
from crowdmap_torch.optim.solvers.dense import DenseBackend
from crowdmap_torch.optim.solvers.normal_equations import LinearFunctions

GROUP = torch.tensor([0, 1, 1, 1])
VALUES = {"x": torch.zeros(4, 2, dtype=torch.float64)}


def moved(x: Tensor, y: Tensor, measured: Tensor) -> Tensor:
    """A linear residual of two blocks."""
    return torch.stack((x[0] + 2 * x[1] - y[0], 3 * y[1] - x[1])) - measured


@pytest.fixture
def problem() -> Problem:
    generator = torch.Generator().manual_seed(0)

    def noise(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    first, second = torch.tensor([0, 1, 2, 3]), torch.tensor([0, 2, 3, 1])
    terms = {
        "prior": CostTerm(lambda x, mean: x - mean, (("x", torch.arange(4)),), (noise(4, 2),)),
        "moved": CostTerm(moved, (("x", first), ("x", second)), (noise(4, 2),)),
    }
    return Problem({"x": Variable(2, euclidean, GROUP)}, terms, group_count=2)


def whole(problem: Problem) -> tuple[Tensor, Tensor]:
    """Hessian [8, 8] and gradient [8] over all blocks, from the residuals as one function."""

    def stacked(flat: Tensor) -> Tensor:
        x = flat.view(4, 2)
        prior, both = problem.terms["prior"], problem.terms["moved"]
        (_, a), (_, b) = both.slots
        rows = [moved(x[i], x[j], m) for i, j, m in zip(a, b, both.constants[0], strict=True)]
        return torch.cat([(x - prior.constants[0]).flatten(), *rows])

    at = VALUES["x"].flatten()
    J = torch.func.jacfwd(stacked)(at)
    return J.T @ J, J.T @ stacked(at)


def test_steps_of_a_batch_are_those_of_each_problem(problem: Problem):
    hessian, gradient = whole(problem)
    damping = torch.tensor([0.5, 2.0]).double()
    step = DenseBackend(chunk_rows=3).assemble(problem, VALUES).solve(damping)
    by_entry = damping[GROUP].repeat_interleave(2)
    expected = -torch.linalg.solve(hessian + torch.diag(by_entry * hessian.diagonal()), gradient)
    assert step.solved.all()
    assert torch.allclose(step.delta["x"].flatten(), expected, atol=1e-12)


def test_the_prediction_is_the_decrease_of_the_parabola(problem: Problem):
    hessian, gradient = whole(problem)
    step = DenseBackend().assemble(problem, VALUES).solve(torch.ones(2).double())
    s = step.delta["x"].flatten()
    assert float(step.predicted.sum()) == pytest.approx(float(-gradient @ s - s @ hessian @ s / 2))


def test_covariances_are_the_inverse_of_each_problem(problem: Problem):
    inverse = torch.linalg.inv(whole(problem)[0])
    slots = (("x", torch.arange(4)),)
    functions = LinearFunctions.of_tangents(slots, VALUES["x"], 2)
    found = DenseBackend().assemble(problem, VALUES).covariance().of(functions)
    blocks = torch.stack([inverse[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] for i in range(4)])
    assert torch.allclose(found, blocks, atol=1e-9)


def test_a_problem_that_is_not_finite_fails_alone(problem: Problem):
    problem.terms["prior"].constants[0][0] = torch.nan
    step = DenseBackend().assemble(problem, VALUES).solve(torch.ones(2).double())
    assert step.solved.tolist() == [False, True]
    assert (step.delta["x"][0] == 0).all()
    assert (step.delta["x"][1:] != 0).any()
