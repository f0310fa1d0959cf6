"""Chains with unknowns of their own against the dense solve."""

from __future__ import annotations

import pytest
import torch

from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.border import BorderedBackend
from crowdmap_torch.optim.chain import ChainBackend
from crowdmap_torch.optim.linear import DenseBackend
from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean

KEEP = 0.9


def step_without_bias(before, after, bias):
    return (after - bias) - KEEP * (before - bias)


def step_jacobian(before, after, bias):
    eye = torch.eye(2, dtype=before.dtype).expand(len(before), 2, 2)
    return step_without_bias(before, after, bias), (-KEEP * eye, eye, (KEEP - 1) * eye)


def start_jacobian(first, bias):
    eye = torch.eye(2, dtype=first.dtype).expand(len(first), 2, 2)
    return first - bias, (eye, -eye)


def prior_jacobian(bias):
    return bias, (torch.eye(2, dtype=bias.dtype).expand(len(bias), 2, 2),)


def sighting(pose, mark, measured):
    """Bends, so that the normal equations differ from point to point."""
    offset = mark - pose
    return offset + 0.01 * offset.square() - measured


def drives(lengths=(30, 1, 17), marks=7, seed=0):
    """Poses on drifting chains, each chain with a bias of its own; the last bias has no chain."""
    generator = torch.Generator().manual_seed(seed)

    def noise(*shape):
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    chain = torch.repeat_interleave(torch.arange(len(lengths)), torch.tensor(lengths))
    n, biases = len(chain), len(lengths) + 1
    way = torch.cat([torch.linspace(0, 10, length) for length in lengths]).double()
    # Two poses hang on every block of the chain.
    carrier = torch.arange(n).repeat_interleave(2)
    place = torch.linspace(0, 10, marks).double()
    pose, mark = torch.nonzero((way[carrier][:, None] - place).abs() < 4, as_tuple=True)
    follows = torch.nonzero(chain[1:] == chain[:-1])[:, 0]
    first = torch.cat((chain[:1] >= 0, chain[1:] != chain[:-1])).nonzero()[:, 0]
    terms = {
        "start": CostTerm(
            lambda d, b: d - b, (("drift", first), ("bias", chain[first])), jacobian=start_jacobian
        ),
        "step": CostTerm(
            step_without_bias,
            (("drift", follows), ("drift", follows + 1), ("bias", chain[follows])),
            weight=torch.full((len(follows),), 3.0).double(),
            jacobian=step_jacobian,
        ),
        "bias": CostTerm(
            lambda b: b,
            (("bias", torch.arange(biases)),),
            weight=torch.full((biases,), 0.7).double(),
            jacobian=prior_jacobian,
        ),
        "bound": CostTerm(lambda x, d: x - d, (("pose", torch.arange(2 * n)), ("drift", carrier))),
        "sighting": CostTerm(
            sighting, (("pose", pose), ("mark", mark)), (noise(len(pose), 2),), None
        ),
    }
    names = {"pose": 2 * n, "drift": n, "bias": biases, "mark": marks}
    variables = {name: Variable(2, euclidean) for name in names}
    values = {name: noise(count, 2) for name, count in names.items()}
    backend = BorderedBackend(ChainBackend("drift", chain, leaves="pose", carrier=carrier), "bias")
    return Problem(variables, terms), values, backend, chain


def rows_of(dense, name):
    """Rows of a variable's tangents in the dense system."""
    at = dense.where.offset[name][:, None]
    return (at + torch.arange(dense.where.tangent_dim[name])).flatten()


@pytest.mark.parametrize("lengths", [(30, 1, 17), (1,), (64, 63)])
def test_a_border_gives_the_dense_step(lengths):
    problem, values, backend, _ = drives(lengths)
    ours, dense = (b.assemble(problem, values) for b in (backend, DenseBackend()))
    torch.testing.assert_close(ours.cost, dense.cost)
    for name, cost in dense.term_cost.items():
        torch.testing.assert_close(ours.term_cost[name], cost)
    for damping in (1e-9, 1e-2, 1e2):
        damping = torch.tensor([damping], dtype=torch.float64)
        mine, theirs = ours.solve(damping), dense.solve(damping)
        for name in values:
            torch.testing.assert_close(mine.delta[name], theirs.delta[name], rtol=1e-8, atol=1e-10)
        torch.testing.assert_close(mine.predicted, theirs.predicted)
        torch.testing.assert_close(mine.norm, theirs.norm)


def test_covariances_are_blocks_of_the_dense_inverse():
    problem, values, backend, chain = drives()
    dense = DenseBackend().assemble(problem, values)
    inverse = torch.linalg.inv(dense.hessian[0])
    # Sums over each chain: of the first entry by mean, of the second by differing weights.
    weight = torch.zeros(len(chain), 2, 2, dtype=torch.float64)
    weight[:, 0, 0] = 1 / torch.bincount(chain)[chain].double()
    weight[:, 1, 1] = torch.linspace(-1, 2, len(chain)).double()
    found = backend.assemble(problem, values).covariances(weight, floor=0.0)
    mark, bias, drift = (rows_of(dense, name) for name in ("mark", "bias", "drift"))
    torch.testing.assert_close(found.landmarks, inverse[mark][:, mark], rtol=1e-8, atol=1e-12)
    torch.testing.assert_close(found.border, inverse[bias][:, bias], rtol=1e-8, atol=1e-12)
    per_chain = torch.zeros(len(drift), 4, 2, dtype=torch.float64)
    rows = torch.arange(len(drift))
    per_chain[rows, chain[rows // 2]] = weight.flatten(0, 1)
    sums = per_chain.flatten(1)
    expected = sums.mT @ inverse[drift][:, drift] @ sums
    torch.testing.assert_close(found.sums, expected, rtol=1e-8, atol=1e-12)


def test_the_minimum_is_that_of_the_dense_back_end():
    problem, values, backend, _ = drives(seed=1)
    config = lm.LmConfig(cost_tolerance=1e-13)
    ours = lm.solve(problem, values, config, backend=backend)
    theirs = lm.solve(problem, values, config)
    assert ours.done
    for name, value in theirs.values.items():
        torch.testing.assert_close(ours.values[name], value, rtol=0, atol=1e-6)


def test_a_chain_that_is_not_positive_definite_moves_nothing():
    problem, values, backend, _ = drives()
    normal = backend.assemble(problem, values)
    normal.inner.diagonal[40] = -normal.inner.diagonal[40]
    step = normal.solve(torch.tensor([1e-9], dtype=torch.float64))
    assert not bool(step.solved)
    assert not any(delta.any() for delta in step.delta.values())
