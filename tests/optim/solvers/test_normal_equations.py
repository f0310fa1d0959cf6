"""What all back ends promise alike: the predicted decrease, failed steps, and covariances of functions."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from worlds.bordered_chains import drives, rows_of, shared_drives

from crowdmap_torch.optim.problem import CostTerm, Problem, Values
from crowdmap_torch.optim.solvers.chain_schur import ChainBackend
from crowdmap_torch.optim.solvers.dense import DenseBackend
from crowdmap_torch.optim.solvers.normal_equations import (
    Backend,
    LinearFunctions,
    MapEquations,
    NormalEquations,
)
from crowdmap_torch.optim.solvers.plan import EliminationPlan

BACKENDS = {"dense": lambda plan: DenseBackend(), "bordered": ChainBackend}
DAMPING = torch.tensor([1e-2], dtype=torch.float64)


@pytest.fixture(params=BACKENDS)
def problem_of(request) -> tuple[Problem, Values, EliminationPlan, Backend]:
    problem, values, plan = drives(lengths=(5, 1, 4))
    return problem, values, plan, BACKENDS[request.param](plan)


def test_the_predicted_decrease_is_the_models(problem_of):
    problem, values, _, backend = problem_of
    step = backend.assemble(problem, values).solve(DAMPING)
    dense = DenseBackend().assemble(problem, values)
    s, g, H = dense.where.pack(step.delta)[0], dense.gradient[0], dense.hessian[0]
    expected = -(g @ s + s @ H @ s / 2)
    torch.testing.assert_close(step.predicted[0], expected)
    torch.testing.assert_close(step.norm[0], s.norm())


def test_a_step_that_failed_moves_nothing_and_promises_nothing(problem_of):
    problem, values, _, backend = problem_of
    broken = CostTerm(
        lambda m: m / 0, (("mark", torch.arange(len(values["mark"]))),), jacobian=None
    )
    normal = backend.assemble(replace(problem, terms={**problem.terms, "nan": broken}), values)
    step = normal.solve(DAMPING)
    assert not bool(step.solved) and not bool(step.predicted) and not bool(step.norm)
    assert step.delta.keys() == values.keys()
    assert all(not delta.any() for delta in step.delta.values())


def test_a_border_of_another_chain_is_refused():
    problem, values, plan = drives()
    term = problem.terms["start"]
    (drift, block), (bias, at) = term.slots
    terms = {**problem.terms, "start": replace(term, slots=((drift, block), (bias, at.flip(0))))}
    with pytest.raises(ValueError, match="'bias' of another chain"):
        ChainBackend(plan).assemble(replace(problem, terms=terms), values)


def test_what_another_chain_shares_is_refused():
    problem, values, plan = shared_drives()
    pose, drift, (car, at) = problem.terms["bound"].slots
    wrong = replace(problem.terms["bound"], slots=(pose, drift, (car, 1 - at)))
    terms = {**problem.terms, "bound": wrong}
    with pytest.raises(ValueError, match="'car' of another chain"):
        ChainBackend(plan).assemble(replace(problem, terms=terms), values)


def functions_of_marks(generator: torch.Generator) -> LinearFunctions:
    """Three functions of two marks each, four times."""
    jacobians = tuple(
        torch.randn(4, 3, 2, dtype=torch.float64, generator=generator) for _ in range(2)
    )
    return LinearFunctions(
        (("mark", torch.tensor([0, 2, 4, 6])), ("mark", torch.tensor([1, 2, 0, 3]))), jacobians
    )


def expected_joint(problem: Problem, values: Values, functions: LinearFunctions) -> Tensor:
    """Joint covariance of all rows' functions, by the inverse of the whole matrix."""
    dense = DenseBackend().assemble(problem, values)
    inverse = torch.linalg.inv(dense.hessian[0])
    J = torch.zeros(4, 3, len(inverse), dtype=torch.float64)
    for (name, block), by_block in zip(functions.slots, functions.jacobians, strict=True):
        at = rows_of(dense, name).view(-1, 2)[block]
        for row in range(4):
            J[row][:, at[row]] += by_block[row]
    J = J.flatten(0, 1)
    return J @ inverse @ J.mT


@pytest.mark.parametrize("name", ["dense", "bordered"])
def test_covariances_of_functions_are_those_of_the_whole_inverse(name: str, generator):
    problem, values, plan = drives(lengths=(5, 1, 4))
    functions = functions_of_marks(generator)
    normal: NormalEquations = BACKENDS[name](plan).assemble(problem, values)
    joint = expected_joint(problem, values, functions).view(4, 3, 4, 3)
    every = torch.arange(4)
    found = normal.covariance().of(functions)
    # The floors of covariances are 1e-9 of information and less.
    torch.testing.assert_close(found, joint[every, :, every], rtol=1e-6, atol=1e-9)


def test_what_functions_have_in_common_is_all_that_can_be_taken_off_them(generator):
    problem, values, plan = drives(lengths=(5, 1, 4))
    every = torch.arange(len(values["mark"]))
    marks = LinearFunctions.of_tangents((("mark", every),), values["mark"], 2)
    normal = ChainBackend(plan).assemble(problem, values)
    assert isinstance(normal, MapEquations)
    common = normal.covariance().common(marks)
    dense = DenseBackend().assemble(problem, values)
    at = rows_of(dense, "mark")
    joint = torch.linalg.inv(dense.hessian[0])[at][:, at]
    alike = torch.eye(2, dtype=torch.float64).repeat(len(every), 1)
    left = torch.linalg.eigvalsh(joint - alike @ common @ alike.mT)
    # The floor of covariances is 1e-9 of information, of variances of a tenth.
    assert (left[:2].abs() < 1e-6 * left[-1]).all() and (left[2:] > 0).all()
