"""Chains with unknowns of their own against the dense solve."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.bordered_chains import (
    assert_the_last_factors_serve_another_gradient,
    drives,
    rows_of,
    shared_drives,
    wandering_drives,
)

from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.solvers import border
from crowdmap_torch.optim.solvers.chain_schur import ChainBackend
from crowdmap_torch.optim.solvers.dense import DenseBackend
from crowdmap_torch.optim.solvers.normal_equations import LinearFunctions


@pytest.fixture(params=["all", "one by one"])
def right_sides_at_once(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param != "all":
        monkeypatch.setattr(border, "_NUMBERS", 1)


@pytest.mark.parametrize("world", [drives, shared_drives, wandering_drives])
@pytest.mark.parametrize("lengths", [(30, 1, 17), (1,), (64, 63)])
def test_a_border_gives_the_dense_step(lengths, world, right_sides_at_once):
    problem, values, plan = world(lengths)
    ours, dense = (b.assemble(problem, values) for b in (ChainBackend(plan), DenseBackend()))
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


def test_a_place_has_nothing_to_do_with_drives_elsewhere():
    """120 drives along a road in turn: the step is the dense one, and the border's tiles are those of drives past them."""
    problem, values, plan = drives((6,) * 120, 500, apart=8.0)
    backend, dense = ChainBackend(plan), DenseBackend().assemble(problem, values)
    damping = torch.tensor([1e-3], dtype=torch.float64)
    normal = backend.assemble(problem, values)
    mine, theirs = normal.solve(damping), dense.solve(damping)
    for name in values:
        torch.testing.assert_close(mine.delta[name], theirs.delta[name], rtol=1e-8, atol=1e-10)
    pattern, begin = normal.structure.direct, normal.structure.border_begin // 96
    assert pattern.width == 96
    assert not bool(pattern.present[:begin, begin:].any())
    between = normal.structure.reduced.present[:begin, begin:]
    assert between.shape[1] > 2
    assert float(between.double().mean()) < 0.8


@pytest.mark.parametrize("world", [drives, shared_drives, wandering_drives])
def test_the_last_factors_serve_another_gradient(world):
    problem, values, plan = world()
    assert_the_last_factors_serve_another_gradient(problem, values, plan)


@pytest.mark.parametrize("world", [drives, shared_drives, wandering_drives])
def test_a_step_tells_by_how_many_sigmas_landmarks_and_border_move(world):
    problem, values, plan = world()
    dense = DenseBackend().assemble(problem, values)
    damping = torch.tensor([1e-12], dtype=torch.float64)
    step = ChainBackend(plan).assemble(problem, values).solve(damping)
    gone = torch.cat([rows_of(dense, name) for name in ("pose", "drift")])
    stays = torch.ones(dense.where.dim, dtype=torch.bool)
    stays[gone] = False
    # Their own covariance, all others free: of the inverse what is theirs.
    covariance = torch.linalg.inv(dense.hessian[0])[stays][:, stays]
    moved = dense.where.pack(step.delta)[0][stays]
    expected = (moved @ torch.linalg.solve(covariance, moved) / len(moved)).sqrt()
    torch.testing.assert_close(step.in_sigmas[0], expected, rtol=1e-7, atol=0)


@pytest.mark.parametrize("world", [drives, shared_drives, wandering_drives])
def test_covariances_are_blocks_of_the_dense_inverse(world, right_sides_at_once):
    problem, values, plan = world()
    dense = DenseBackend().assemble(problem, values)
    inverse, chain = torch.linalg.inv(dense.hessian[0]), plan.chain
    # Sums over each chain: of the first entry by mean, of the second by differing weights.
    width = values["drift"].shape[1]
    weight = torch.zeros(len(chain), width, 2, dtype=torch.float64)
    weight[:, 0, 0] = 1 / torch.bincount(chain)[chain].double()
    weight[:, 1, 1] = torch.linspace(-1, 2, len(chain)).double()
    found = ChainBackend(plan).assemble(problem, values).covariance(floor=0.0)
    mark, drift = rows_of(dense, "mark"), rows_of(dense, "drift")
    at = found.where.entries("mark", slice(None)).flatten()
    of_marks = found.solve(torch.eye(found.where.dim).double())[at][:, at]
    torch.testing.assert_close(of_marks, inverse[mark][:, mark], rtol=1e-8, atol=1e-12)
    per_chain = torch.zeros(len(drift), 4, 2, dtype=torch.float64)
    rows = torch.arange(len(drift))
    per_chain[rows, chain[rows // width]] = weight.flatten(0, 1)
    sums = per_chain.flatten(1)
    joint = (sums.mT @ inverse[drift][:, drift] @ sums).view(4, 2, 4, 2)
    every = torch.arange(4)
    expected = joint[every, :, every]
    torch.testing.assert_close(
        found.of_sums(weight, torch.arange(3), 4), expected, rtol=1e-8, atol=1e-12
    )
    # Two chains of one sum.
    of = torch.tensor([0, 1, 0])
    both = joint.view(4, 2, 4, 2)
    expected[0] += expected[2] + both[0, :, 2] + both[2, :, 0]
    expected = expected[:2]
    torch.testing.assert_close(found.of_sums(weight, of, 2), expected, rtol=1e-8, atol=1e-12)
    for name in plan.border:
        at = rows_of(dense, name).view(len(values[name]), -1)
        expected = inverse[at[:, :, None], at[:, None]]
        torch.testing.assert_close(found.of_border(name), expected, rtol=1e-8, atol=1e-12)
        every = inverse[at[:, None, :, None], at[None, :, None, :]].mean((0, 1))
        torch.testing.assert_close(found.of_border_mean(name), every, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("world", [drives, shared_drives, wandering_drives])
@pytest.mark.parametrize("marks", [7, 400])
def test_information_on_the_border_is_the_inverse_of_its_covariance(marks, world):
    problem, values, plan = world(marks=marks)
    dense = DenseBackend().assemble(problem, values)
    normal = ChainBackend(plan).assemble(problem, values)
    normal.solve(torch.tensor([1e-12], dtype=torch.float64))
    at = torch.cat([rows_of(dense, name) for name in plan.border])
    expected = torch.linalg.inv(torch.linalg.inv(dense.hessian[0])[at[:, None], at])
    found = normal.border_information().on(*plan.border)
    torch.testing.assert_close(found, expected, rtol=1e-7, atol=1e-9)


def test_a_covariance_whose_factors_are_gone_is_refused():
    problem, values, plan = drives()
    normal = ChainBackend(plan).assemble(problem, values)
    covariance = normal.covariance()
    normal.solve(torch.tensor([1e-3], dtype=torch.float64))
    with pytest.raises(ValueError, match="solved since"):
        covariance.of_sums(torch.zeros(len(plan.chain), 2, 1).double(), torch.arange(3), 3)


def test_a_covariance_at_rest_outlives_the_factors():
    problem, values, plan = drives(marks=400)
    normal = ChainBackend(plan).assemble(problem, values)
    functions = LinearFunctions.of_tangents(
        (("mark", torch.arange(400)),), values["mark"], values["mark"].shape[1]
    )
    expected = normal.covariance().of(functions)
    right_side = torch.ones(normal.structure.where.dim, 1).double()
    solved = normal.covariance().solve(right_side)
    resting = normal.covariance().resting()
    normal.solve(torch.tensor([1e-3], dtype=torch.float64))
    assert torch.equal(resting.of(functions), expected)
    assert torch.equal(resting.solve(right_side), solved)
    with pytest.raises(AssertionError, match="who has the chains"):
        resting.of_sums(torch.zeros(len(plan.chain), 2, 1).double(), torch.arange(3), 3)


@pytest.mark.parametrize("world", [drives, shared_drives, wandering_drives])
def test_the_minimum_is_that_of_the_dense_back_end(world):
    problem, values, plan = world(seed=1)
    config = lm.LmConfig(cost_tolerance=1e-13)
    ours = lm.solve(problem, values, config, backend=ChainBackend(plan))
    theirs = lm.solve(problem, values, config)
    assert ours.done
    for name, value in theirs.values.items():
        torch.testing.assert_close(ours.values[name], value, rtol=0, atol=1e-6)


def test_a_chain_that_is_not_positive_definite_moves_nothing():
    problem, values, plan = drives()
    normal = ChainBackend(plan).assemble(problem, values)
    normal.diagonal[40] = -normal.diagonal[40]
    step = normal.solve(torch.tensor([1e-9], dtype=torch.float64))
    assert not bool(step.solved)
    assert not any(delta.any() for delta in step.delta.values())


def test_terms_that_touch_the_same_blocks_share_their_factors():
    """A second term as the first one: the step is the dense one, and B takes no more memory."""
    problem, values, plan = drives()
    sighting = problem.terms["sighting"]
    again = replace(sighting, constants=(sighting.constants[0] + 0.3,))
    both = replace(problem, terms={**problem.terms, "again": again})
    normal = ChainBackend(plan).assemble(both, values)
    assert list(normal.coupling) == ["sighting"]
    damping = torch.full((1,), 1e-3, dtype=torch.double)
    found, expected = normal.solve(damping), DenseBackend().assemble(both, values).solve(damping)
    for name, delta in expected.delta.items():
        torch.testing.assert_close(found.delta[name], delta, rtol=1e-8, atol=1e-10)
    # Seen in another order, the blocks are the same ones.
    turned = torch.arange(len(again)).flip(0)
    slots = tuple((name, block[turned]) for name, block in again.slots)
    again = replace(again, slots=slots, constants=(again.constants[0][turned],))
    other = replace(problem, terms={**problem.terms, "again": again})
    same = ChainBackend(plan).assemble(other, values)
    assert list(same.coupling) == ["sighting"]
    torch.testing.assert_close(same.coupling["sighting"], normal.coupling["sighting"])
