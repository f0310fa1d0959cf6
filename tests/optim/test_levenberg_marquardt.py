"""Levenberg-Marquardt: convergence, independent problems in one batch, reasons, kept linearisations."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.linearize import autograd_jacobians, linearize, rows, term_costs
from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean, positive
from crowdmap_torch.optim.robust import Huber, Quadratic, Tukey, median_scale
from crowdmap_torch.optim.solvers.dense import DenseBackend
from crowdmap_torch.optim.solvers.normal_equations import LinearFunctions, Step

ROWS = 40


def decay(x, t, y):
    return (x[0] * torch.exp(x[1] * t) - y)[None]


def curves(count, *, outliers=False, seed=0):
    """Exponential curves to fit, one independent problem each, with true parameters."""
    generator = torch.Generator().manual_seed(seed)
    t = 3 * torch.rand(count, ROWS, dtype=torch.float64, generator=generator)
    scale = torch.rand(count, 2, dtype=torch.float64, generator=generator)
    true = torch.stack((1 + scale[:, 0], -0.5 - scale[:, 1]), dim=-1)
    noise = 0.01 * torch.randn(count, ROWS, dtype=torch.float64, generator=generator)
    y = true[:, :1] * torch.exp(true[:, 1:] * t) + noise
    if outliers:
        y[:, ::10] += 5
    group = torch.arange(count)
    term = CostTerm(
        decay,
        (("x", group.repeat_interleave(ROWS)),),
        (t.flatten(), y.flatten()),
        torch.full((count * ROWS,), 100.0, dtype=torch.float64),
        Tukey(4.685) if outliers else Quadratic(),
    )
    return Problem({"x": Variable(2, euclidean, group)}, {"decay": term}, count), true


def test_a_batch_gives_what_each_problem_gives_alone():
    problem, true = curves(7)
    start = true + 0.3
    config = lm.LmConfig(cost_tolerance=1e-12)
    together = lm.solve(problem, {"x": start}, config).values["x"]
    for i in range(len(true)):
        of_problem = torch.arange(i * ROWS, (i + 1) * ROWS)
        alone = rows(problem.terms["decay"], of_problem)
        alone = replace(alone, slots=(("x", torch.zeros(ROWS, dtype=torch.long)),))
        single = Problem({"x": Variable(2, euclidean)}, {"decay": alone})
        result = lm.solve(single, {"x": start[i : i + 1]}, config).values["x"]
        torch.testing.assert_close(result[0], together[i], rtol=0, atol=1e-9)


def test_a_minimisation_is_linearised_once_at_each_point_and_begins_so():
    problem, true = curves(1)
    made: list[torch.Tensor] = []

    class Counting(DenseBackend):
        def assemble(self, problem, values):
            made.append(values["x"])
            return super().assemble(problem, values)

    state = lm.solve(problem, {"x": true + 0.3}, lm.LmConfig(), backend=Counting())
    assert state.iterations > 2
    assert len(made) == state.linearizations == state.iterations
    begun = lm.init(problem, {"x": true + 0.3}, lm.LmConfig(), backend=Counting())
    without = lm.init(problem, {"x": true + 0.3}, lm.LmConfig())
    assert begun.normal is not None and begun.linearizations == 1
    torch.testing.assert_close(begun.cost, without.cost)
    torch.testing.assert_close(dict(begun.term_cost), without.term_cost)


def test_outliers_do_not_move_a_tukey_fit():
    problem, true = curves(100, outliers=True)
    state = lm.solve(problem, {"x": true + 0.02}, lm.LmConfig())
    # One hundredth of noise over 36 points: parameters are known to about 0.01, four sigma here.
    assert (state.values["x"] - true).abs().max() < 0.08
    assert state.done


def test_the_cost_never_rises():
    problem, true = curves(5, seed=3)
    state = lm.init(problem, {"x": true * 3}, lm.LmConfig())
    while not state.done:
        after = lm.step(problem, state, lm.LmConfig())
        assert (after.cost <= state.cost).all()
        state = after


def test_a_step_that_is_lost_in_how_little_is_known_is_the_last():
    problem, true = curves(20, outliers=True)
    exact = lm.solve(problem, {"x": true + 0.02}, lm.LmConfig(cost_tolerance=1e-12))
    config = lm.LmConfig(cost_tolerance=0.0, move_tolerance=0.1, initial_damping=1e-9)
    early = lm.solve(problem, {"x": true + 0.02}, config)
    assert set(early.reason.tolist()) == {lm.CONVERGED_MOVE}
    assert early.iterations < exact.iterations
    inverse = DenseBackend().assemble(problem, exact.values).covariance()
    every = torch.arange(len(true))
    sigma = inverse.of(LinearFunctions.of_tangents((("x", every),), true, 2)).diagonal(0, 1, 2)
    left = (early.values["x"] - exact.values["x"]) / sigma.sqrt()
    assert float(left.square().mean().sqrt()) < 0.1


def test_what_is_left_of_steps_that_shrink_alike_is_their_sum():
    problem, true = curves(3)
    state = lm.init(problem, {"x": true}, lm.LmConfig(initial_damping=1e-9))
    assert state.in_sigmas_left.isinf().all()
    before, last = torch.tensor([[0.4, 0.2, 0.1], [0.1, 0.1, 0.1]], dtype=torch.float64)
    state = replace(state, in_sigmas_before=before, in_sigmas=last)
    # 1/40 + 1/160 + ...; 1/20 + 1/40 + ...; no end.
    expected = torch.tensor([1 / 30, 0.1, torch.inf], dtype=torch.float64)
    torch.testing.assert_close(state.in_sigmas_left, expected)
    assert replace(state, damping=torch.ones_like(last)).in_sigmas_left.isinf().all()


def test_a_step_that_damping_made_short_is_not_the_last():
    problem, true = curves(20)
    config = lm.LmConfig(cost_tolerance=0.0, move_tolerance=0.1, initial_damping=1e6)
    state = lm.step(problem, lm.init(problem, {"x": true + 0.02}, config), config)
    assert bool(state.accepted.all()) and set(state.reason.tolist()) == {lm.RUNNING}


def test_a_rejected_step_keeps_the_linearisation():
    problem, true = curves(1, seed=2)
    config = lm.LmConfig(initial_damping=1e-12)
    state = lm.init(problem, {"x": true * torch.tensor([1.0, -8.0])}, config)
    rejected = 0
    while not state.done:
        after = lm.step(problem, state, config)
        if not bool(after.accepted):
            rejected += 1
            assert after.normal is not None
            assert after.values is state.values
        state = after
    assert rejected
    assert state.linearizations == state.iterations - rejected + (0 if state.accepted else 1)


@pytest.mark.parametrize(("promise", "sigmas"), [(1e-6, 0.05), (1e-3, 0.05), (1e-6, 0.2)])
def test_a_step_that_is_not_worth_a_shorter_one_is_the_last(
    promise: float, sigmas: float, monkeypatch: pytest.MonkeyPatch
):
    problem, true = curves(1)
    exact = lm.solve(problem, {"x": true}, lm.LmConfig(cost_tolerance=1e-14))
    config = lm.LmConfig(cost_tolerance=1e-5, move_tolerance=0.1, initial_damping=1e-9)
    start = lm.init(problem, exact.values, config, backend=DenseBackend())

    def away(_: object, damping: torch.Tensor) -> Step:
        one = torch.ones_like(damping)
        return Step({"x": one[:, None] * 1e-3}, promise * start.cost, one > 0, one, sigmas * one)

    monkeypatch.setattr(type(start.normal), "solve", away)
    after = lm.step(problem, start, config)
    assert not bool(after.accepted) and after.values is start.values
    # What no longer counts is left; anything else is tried again, damped by as much as is felt.
    is_last = promise < config.cost_tolerance and sigmas < config.move_tolerance
    assert after.done == is_last
    assert float(after.damping) == 1e-4


def test_a_start_that_is_not_finite_is_a_reason():
    problem, true = curves(2)
    start = true.clone()
    start[1, 0] = torch.nan
    state = lm.solve(problem, {"x": start}, lm.LmConfig())
    assert "not finite" in state.reasons[1]
    assert "converged" in state.reasons[0]


def test_positive_numbers_stay_positive():
    values = positive(torch.tensor([[0.5, 2.0]]), torch.tensor([[-50.0, 3.0]]))
    assert (values > 0).all()


@pytest.mark.parametrize("loss", [Quadratic(), Huber(1.345), Tukey(4.685), Tukey(4.685, 0.01)])
def test_weights_are_the_derivative_of_the_loss(loss):
    s = torch.linspace(0.01, 40, 200, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss.rho(s).sum(), s)
    torch.testing.assert_close(gradient, loss.weight(s.detach()), rtol=1e-9, atol=1e-12)


def test_median_scale_of_normal_noise_is_its_sigma():
    generator = torch.Generator().manual_seed(0)
    noise = 0.7 * torch.randn(20000, dtype=torch.float64, generator=generator)
    noise[::20] += 100
    # Five percent of outliers raise the median by about seven percent.
    assert 0.68 < float(median_scale(noise)) < 0.77
    assert float(median_scale(noise[:0], floor=0.3)) == pytest.approx(0.3)


def test_chunks_do_not_change_the_normal_equations():
    problem, true = curves(9, outliers=True)
    values = {"x": true + 0.1}
    whole = DenseBackend().assemble(problem, values)
    parts = DenseBackend(chunk_rows=17).assemble(problem, values)
    torch.testing.assert_close(whole.hessian, parts.hessian)
    torch.testing.assert_close(whole.gradient, parts.gradient)
    torch.testing.assert_close(
        whole.cost, term_costs(problem, values, chunk_rows=11)["decay"], rtol=1e-12, atol=0
    )


def test_the_gradient_is_that_of_the_cost():
    problem, true = curves(3, outliers=True, seed=5)
    x = (true + 0.05).requires_grad_()
    cost = term_costs(problem, {"x": x})["decay"].sum()
    (expected,) = torch.autograd.grad(cost, x)
    with torch.no_grad():
        found = DenseBackend().assemble(problem, {"x": x.detach()}).gradient
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


def test_autograd_jacobians_go_through_the_retraction():
    problem, true = curves(2)
    kinds = {"x": Variable(2, positive, torch.arange(2))}
    _, (by_tangent,) = autograd_jacobians(problem.terms["decay"], kinds, {"x": true.abs()})
    _, (by_value,) = autograd_jacobians(
        problem.terms["decay"], dict(problem.variables), {"x": true.abs()}
    )
    block = problem.terms["decay"].slots[0][1]
    torch.testing.assert_close(by_tangent, by_value * true.abs()[block].mT)
    linear = linearize(problem.terms["decay"], kinds, {"x": true.abs()})
    torch.testing.assert_close(linear.jacobians[0], 100 * by_tangent)


def test_longer_steps_reach_the_same_minimum_in_fewer_steps():
    # A robust loss far out: its weights overrate the curvature, and plain steps are too short.
    x = torch.linspace(-3, 3, 41, dtype=torch.float64)
    target = 0.4 * x + 1.0
    target[::5] += 4.0

    def residual(line, at, value):
        return (line[0] * at + line[1] - value)[None]

    index = torch.zeros(len(x), dtype=torch.long)
    term = CostTerm(residual, (("line", index),), (x, target), None, Tukey(6.0))
    problem = Problem({"line": Variable(2, euclidean)}, {"fit": term})
    start = {"line": torch.tensor([[-0.3, 2.5]], dtype=torch.float64)}
    plain = lm.LmConfig(cost_tolerance=1e-10, initial_damping=1e-8)
    states = [lm.solve(problem, start, replace(plain, max_stretch=most)) for most in (1.0, 3.0)]
    assert all(state.done for state in states)
    torch.testing.assert_close(states[1].cost, states[0].cost, rtol=1e-6, atol=0)
    assert states[1].iterations < states[0].iterations
