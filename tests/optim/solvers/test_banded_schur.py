"""Landmarks along a path: the band's answers are those of the dense matrix."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from crowdmap_torch.optim.problem import CostTerm, Problem, Values, Variable, euclidean, positive
from crowdmap_torch.optim.solvers.banded_schur import BandBackend
from crowdmap_torch.optim.solvers.dense import DenseBackend, DenseNormalEquations
from crowdmap_torch.optim.solvers.normal_equations import LinearFunctions

F64 = torch.float64
LANDMARKS, NODES, ROWS = 5, 20, 120


def sighting(place: Tensor, size: Tensor, before: Tensor, after: Tensor, A: Tensor, B: Tensor):
    return A @ torch.cat((place, size, before)) + B @ after - 1


def step(before: Tensor, after: Tensor) -> Tensor:
    return after - before


def prior(node: Tensor) -> Tensor:
    return node - 1


@pytest.fixture
def along_a_path(generator) -> tuple[Problem, Values]:
    """Landmarks of two kinds of unknowns, each seen from a stretch of nodes of its own."""

    def random(*shape: int) -> Tensor:
        return torch.randn(shape, dtype=F64, generator=generator)

    landmark = torch.randint(0, LANDMARKS, (ROWS,), generator=generator)
    node = landmark * 3 + torch.randint(0, 6, (ROWS,), generator=generator)
    every = torch.arange(NODES)
    terms = {
        "sighting": CostTerm(
            sighting,
            (("place", landmark), ("size", landmark), ("path", node), ("path", node + 1)),
            (random(ROWS, 4, 7), random(ROWS, 4, 3)),
        ),
        # Backwards on purpose: which of two nodes a row names first must not matter.
        "step": CostTerm(step, (("path", every[1:]), ("path", every[:-1]))),
        "prior": CostTerm(prior, (("path", every),)),
    }
    variables = {
        "place": Variable(3, euclidean),
        "size": Variable(1, positive),
        "path": Variable(3, euclidean),
    }
    values = {
        "place": random(LANDMARKS, 3),
        "size": random(LANDMARKS, 1).exp(),
        "path": random(NODES, 3),
    }
    return Problem(variables, terms), values


@pytest.fixture
def dense(along_a_path) -> DenseNormalEquations:
    return DenseBackend().assemble(*along_a_path)


def test_steps_are_those_of_the_dense_matrix(along_a_path, dense):
    damping = torch.tensor([0.1], dtype=F64)
    expected = dense.solve(damping)
    found = BandBackend("path", chunk_rows=50).assemble(*along_a_path).solve(damping)
    for name, delta in expected.delta.items():
        torch.testing.assert_close(found.delta[name], delta, rtol=0, atol=1e-10)
    torch.testing.assert_close(found.predicted, expected.predicted)
    torch.testing.assert_close(found.norm, expected.norm)


def test_covariances_of_functions_are_those_of_the_dense_matrix(along_a_path, dense, generator):
    normal = BandBackend("path").assemble(*along_a_path)
    by_landmark = torch.randn(LANDMARKS, 2, 4, dtype=F64, generator=generator)
    by_path = torch.randn(LANDMARKS, 2, 2, 3, dtype=F64, generator=generator)
    # Nodes inside of the stretch that a landmark was seen from, at its end, and far from it.
    block = torch.tensor([[3, 4], [8, 9], [0, 19], [12, 12], [19, 5]])
    covariance = torch.linalg.inv(dense.hessian[0])
    offset, dims = dense.where.offset, dense.where.tangent_dim
    every = torch.arange(LANDMARKS)
    functions = LinearFunctions(
        (("place", every), ("size", every), ("path", block[:, 0]), ("path", block[:, 1])),
        (*by_landmark.split([3, 1], dim=-1), *by_path.unbind(1)),
    )
    found = normal.covariance().of(functions)
    for i in range(LANDMARKS):
        J = torch.zeros(2, len(covariance), dtype=F64)
        J[:, offset["place"][i] + torch.arange(dims["place"])] = by_landmark[i, :, :3]
        J[:, offset["size"][i]] = by_landmark[i, :, 3]
        for k in range(2):
            J[:, offset["path"][block[i, k]] + torch.arange(3)] += by_path[i, k]
        torch.testing.assert_close(found[i], J @ covariance @ J.T, rtol=1e-5, atol=1e-7)


def test_evidence_is_the_integral_of_the_model(along_a_path, dense):
    H, g = dense.hessian[0], dense.gradient[0]
    expected = dense.cost[0] + (torch.logdet(H) - g @ torch.linalg.solve(H, g)) / 2
    found = BandBackend("path").assemble(*along_a_path).log_evidence()
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=0)


def test_more_of_the_path_is_as_if_it_were_weighted(along_a_path):
    """Each component of the chain's squares can be weighted without a new linearisation."""
    problem, values = along_a_path
    problem.terms.pop("prior")
    factor = torch.tensor([3.0, 0.0, 8.0], dtype=F64)
    step = problem.terms["step"]
    heavy = replace(step, weight=(1 + factor).sqrt().expand(len(step), 3))
    backend = BandBackend("path")
    expected = backend.assemble(replace(problem, terms={**problem.terms, "step": heavy}), values)
    alone = backend.assemble(replace(problem, terms={"step": step}), values)
    found = backend.assemble(problem, values).plus(alone, factor, values["path"])
    torch.testing.assert_close(found.path, expected.path)
    torch.testing.assert_close(found.log_evidence(), expected.log_evidence())


def test_a_matrix_that_is_not_definite_is_a_step_not_solved(along_a_path):
    problem, values = along_a_path
    unbound = {name: term for name, term in problem.terms.items() if name == "step"}
    normal = BandBackend("path").assemble(Problem(problem.variables, unbound), values)
    step = normal.solve(torch.zeros(1, dtype=F64))
    assert not bool(step.solved[0])
    assert all(not bool(delta.any()) for delta in step.delta.values())


def test_a_batch_is_refused(along_a_path):
    problem, values = along_a_path
    with pytest.raises(ValueError, match="one problem"):
        BandBackend("path").assemble(Problem(problem.variables, problem.terms, 2), values)
