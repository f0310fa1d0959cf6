"""Steps with corrections: fewer factors to the same minimum, and nothing that the next step would have to remember."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import pytest
import torch

from crowdmap_torch.benchmark import free_corners
from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.corrections import Point, corrected
from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean
from crowdmap_torch.optim.robust import Tukey
from crowdmap_torch.optim.solvers.assembly import cost_and_gradient
from crowdmap_torch.optim.solvers.chain_schur import ChainBackend
from crowdmap_torch.optim.solvers.dense import DenseBackend
from crowdmap_torch.optim.solvers.normal_equations import Correction, StepPart, solved_step
from crowdmap_torch.optim.solvers.plan import EliminationPlan

CONFIG = lm.LmConfig(max_iterations=40, cost_tolerance=1e-10, initial_damping=1e-9, max_stretch=3.0)


@pytest.fixture(scope="module")
def race():
    """A problem of the race near its minimum, where only weights still move, and its back end."""
    given = free_corners.simulate(3, 40, 5, seed=2)
    built, values = free_corners.bundle(given, Tukey(30.0), torch.device("cpu"))
    chain = torch.arange(given.J).repeat_interleave(given.F)
    backend = ChainBackend(EliminationPlan("pose", chain))
    begun = lm.solve(built, values, replace(CONFIG, cost_tolerance=1e-2), backend=backend)
    corner = replace(built.terms["corner"], loss=Tukey(given.tukey_c))
    return replace(built, terms={**built.terms, "corner": corner}), begun.values, backend


def test_the_gradient_alone_is_that_of_the_normal_equations(race):
    built, values, backend = race
    costs, gradient = cost_and_gradient(built, values)
    normal = backend.assemble(built, values)
    torch.testing.assert_close(costs.total, normal.cost)
    for name, own in normal.tangent_gradient.items():
        torch.testing.assert_close(gradient[name], own, rtol=1e-9, atol=1e-7)


def test_corrections_reach_the_same_minimum_with_fewer_factors(race):
    built, values, backend = race
    plain, with_them = (
        lm.solve(built, values, replace(CONFIG, corrections=most), backend=backend)
        for most in (0, 8)
    )
    assert plain.done and with_them.done
    assert plain.corrections == 0
    assert with_them.linearizations <= plain.linearizations / 2
    torch.testing.assert_close(with_them.cost, plain.cost, rtol=1e-7, atol=0)
    # The weights are those of the minimum: the state says what its values cost.
    torch.testing.assert_close(with_them.cost, cost_and_gradient(built, with_them.values)[0].total)
    assert with_them.term_cost.keys() == built.terms.keys()


def test_what_a_step_promises_decides_whether_it_is_corrected(race):
    built, values, backend = race
    promises = backend.assemble(built, values)
    share = float(promises.solve(torch.tensor([1e-9]).double()).predicted / promises.cost)
    for below, tried in ((0.9 * share, False), (1.1 * share, True)):
        config = replace(CONFIG, corrections=8, correct_below=below)
        state = lm.step(built, lm.init(built, values, config), config, backend=backend)
        assert (state.corrections > 0) == tried


def test_a_step_with_corrections_follows_from_the_values_alone(race):
    built, values, backend = race
    config = replace(CONFIG, corrections=2)
    states = [lm.init(built, values, config)]
    while not states[-1].done:
        states.append(lm.step(built, states[-1], config, backend=backend))
    assert len(states) > 2
    # Another process has another back end, and what a checkpoint holds.
    for before, after in pairwise(states):
        again = ChainBackend(backend.plan)
        found = lm.step(built, replace(before, normal=None), config, backend=again)
        for name, value in found.values.items():
            assert torch.equal(value, after.values[name])


@dataclass
class _Rough:
    """Normal equations whose matrix is several times too large, by a different factor along every axis."""

    cost: torch.Tensor
    matrix: torch.Tensor
    gradient: torch.Tensor
    asked: list[dict[str, torch.Tensor]] = field(default_factory=list)

    @property
    def term_cost(self):
        return {"bowl": self.cost}

    @property
    def tangent_gradient(self):
        return {"x": self.gradient[None]}

    def solve(self, damping):
        step = -torch.linalg.solve(self.matrix, self.gradient)
        part = StepPart(step[None], self.gradient[None], torch.zeros_like(step)[None])
        return solved_step({"x": step[None]}, part)

    def covariance(self):
        raise NotImplementedError

    def correct(self, gradient):
        self.asked.append(gradient)
        step = -torch.linalg.solve(self.matrix, gradient["x"][0])
        in_sigmas = (-(step @ gradient["x"][0]) / len(step)).sqrt()
        return Correction({"x": step[None]}, in_sigmas[None])


def _bowl(sides=(1.0, 3.0, 10.0), above=0.0):
    """A bowl with its minimum at zero, a point of it, and equations that are wrong by factors from 1 to 2.

    It costs half the square of `above` more.
    """
    scale, more = torch.tensor(sides).double(), torch.tensor([above]).double()
    n = len(sides)

    def residual(x):
        return torch.cat((scale * x, more))

    term = CostTerm(residual, (("x", torch.zeros(1, dtype=torch.long)),))
    problem = Problem({"x": Variable(n, euclidean)}, {"bowl": term})
    values = {"x": torch.ones(1, n, dtype=torch.float64)}
    dense = DenseBackend().assemble(problem, values)
    wrong = torch.diag(dense.hessian[0].diagonal() * torch.linspace(1, 2, n).double())
    return problem, values, _Rough(dense.cost, wrong, dense.gradient[0])


def test_pairs_find_the_minimum_of_a_bowl_whatever_the_matrix():
    problem, values, normal = _bowl()
    step = normal.correct(normal.tangent_gradient).delta
    first = Point.of(problem, {"x": values["x"] + step["x"]}, step)
    found = corrected(problem, normal, step, first, most=12, cost_tolerance=1e-12)
    # A matrix alone, right to a factor of two, halves what is left at each step: 2^-24 of the cost after twelve.
    assert float(found.costs.total) < 1e-10 * float(normal.cost)
    assert len(normal.asked) == 1 + found.count


def test_a_correction_that_raises_the_cost_is_not_taken():
    problem, values, normal = _bowl()
    step = normal.correct(normal.tangent_gradient).delta
    first = Point.of(problem, {"x": values["x"] + step["x"]}, step)
    # A matrix that is far too small sends the next step far beyond the minimum.
    normal.matrix = normal.matrix / 1e3
    found = corrected(problem, normal, step, first, most=5, cost_tolerance=1e-12)
    assert found.costs.total <= first.costs.total
    assert not bool(found.converged)


@dataclass
class _OnlyOnce:
    """A back end with the same equations always."""

    normal: _Rough

    def assemble(self, problem, values):
        return self.normal


@pytest.mark.parametrize(("above", "stretch"), [(200.0, 2.0), (20.0, 1.0)])
def test_where_corrections_fail_a_step_that_changes_little_is_made_longer(above, stretch):
    # The step takes some fifty of a cost of 20,000, or of 200, where weights would have changed on the way.
    problem, values, normal = _bowl(above=above)
    # Twice the curvature everywhere: the step leads half the way, and its factors are lost.
    normal.matrix = 2 * DenseBackend().assemble(problem, values).hessian[0]
    nothing = torch.full((1,), torch.nan)
    normal.correct = lambda gradient: Correction({"x": nothing * gradient["x"]}, nothing)
    config = replace(CONFIG, corrections=5, correct_below=1.0)
    state = lm.init(problem, values, config)
    state = lm.step(problem, state, config, backend=_OnlyOnce(normal))
    assert state.corrections == 1
    torch.testing.assert_close(state.stretch, torch.full_like(state.cost, stretch))
    torch.testing.assert_close(state.values["x"], values["x"] * (1 - stretch / 2))


def test_equations_without_kept_factors_take_plain_steps():
    problem, values, _ = _bowl()
    config = replace(CONFIG, corrections=5, correct_below=1.0)
    state = lm.solve(problem, values, config, backend=DenseBackend())
    assert state.done
    assert state.corrections == 0


def test_a_problem_that_changed_a_little_is_settled_by_one_correction(race):
    built, values, backend = race
    config = replace(CONFIG, cost_tolerance=1e-8, move_tolerance=0.05)
    state, normal = lm.init(built, values, config), backend.assemble(built, values)
    while not state.done:
        normal = backend.assemble(built, state.values)
        state = lm.step(built, replace(state, normal=normal), config, backend=backend)

    def changed(factor):
        corner = built.terms["corner"]
        corner = replace(corner, loss=Tukey(corner.loss.c * factor))
        return replace(built, terms={**built.terms, "corner": corner})

    little = changed(1.02)
    settled = lm.settled(little, state, normal, config)
    assert settled.reasons == ("converged: the step is lost in how little is known",)
    assert settled.corrections == state.corrections + 1 and settled.iterations == state.iterations
    costs, gradient = cost_and_gradient(little, settled.values)
    torch.testing.assert_close(settled.cost, costs.total)
    before, was = cost_and_gradient(little, state.values)
    assert float(costs.total) < float(before.total)
    assert gradient["point"].norm() < 0.5 * was["point"].norm()
    # More than that is for steps of its own, and so is what has nothing to be corrected by.
    for problem, by in (
        (changed(0.3), normal),
        (little, DenseBackend().assemble(little, state.values)),
    ):
        left = lm.settled(problem, state, by, config)
        assert left.reasons == ("still running",) and left.corrections == state.corrections
        assert left.values is state.values
    damped = replace(state, damping=torch.full_like(state.damping, 1e-3))
    assert not lm.settled(little, damped, normal, config).done
