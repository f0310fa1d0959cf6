"""Levenberg-Marquardt that keeps its matrix near the minimum: limited-memory BFGS from there, at a third of a step's price.

The mapper does not use it: its scales and matches change from step to step, and the matrix with them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.linearize import RowGradients, row_gradients
from crowdmap_torch.optim.problem import Problem, Values, retract
from crowdmap_torch.optim.solvers.assembly import Costs, TermRows, assemble
from crowdmap_torch.optim.solvers.chain_schur import ChainBackend, ChainNormalEquations
from crowdmap_torch.optim.solvers.normal_equations import Tangents

_NEAR_ENOUGH = (0.5, 1.8)
"""Steps that should be within these multiples stay as they are: the next one learns from what is left."""


@dataclass(frozen=True)
class KeptMatrixConfig:
    """When the matrix is kept, and what is learnt on the way."""

    lm: lm.LmConfig
    """The minimisation before, and what ends it."""
    reuse_below: float = 5e-3
    """Once a step lowers the cost by less than this share, the factorised matrix serves those that follow. 0: never."""
    memory: int = 3
    """Most places whose gradients are remembered."""


@dataclass(frozen=True)
class _Place:
    """Where the minimisation came by since the matrix was factorised."""

    gradient: Tangents
    newton: Tangents
    """The step there by the kept matrix."""
    step: Tangents
    """The step that was taken from there."""
    length: Float[Tensor, " 1"]
    """What multiple of the step proposed it is."""


def minimise(
    problem: Problem, values: Values, config: KeptMatrixConfig, backend: ChainBackend
) -> lm.LmState:
    """The state at the end: converged, stalled, or out of iterations."""
    state = lm.init(problem, values, config.lm)
    while not state.done and state.iterations < config.lm.max_iterations:
        before, normal = state, state.normal
        if normal is None:
            normal = backend.assemble(problem, state.values)
            state = replace(state, normal=normal, linearizations=state.linearizations + 1)
        assert isinstance(normal, ChainNormalEquations)
        state = lm.step(problem, state, config.lm, backend=backend)
        gained = bool((before.cost - state.cost <= config.reuse_below * before.cost).all())
        newton = state.proposed
        if newton is not None and bool(state.accepted.all()) and gained and not state.done:
            gradient = normal.unpack(normal.eliminated_gradient, normal.gradient)
            step = _scaled(newton, state.stretch)
            place = _Place(gradient, newton, step, state.stretch)
            state = _with_kept_matrix(problem, state, config, normal, place)
    return state


def _with_kept_matrix(
    problem: Problem,
    state: lm.LmState,
    config: KeptMatrixConfig,
    normal: ChainNormalEquations,
    place: _Place,
) -> lm.LmState:
    """The state when the kept matrix no longer serves, or nothing is left to gain."""
    places, gradient = [place], _gradient(problem, state.values)[1]
    while not state.done and state.iterations < config.lm.max_iterations:
        newton = normal.solve_again(gradient)
        direction = _quasi_newton(places, gradient, newton)
        slope = _slope(gradient, direction)
        # What the kept matrix has wrong about lengths it has wrong again.
        length = places[-1].length
        candidate, costs, there = _look(problem, state.values, direction, length)
        curvature = (_slope(there, direction) - slope) / (-slope * length)
        best = 1 / curvature.clamp_min(1 / config.lm.max_stretch)
        low, high = _NEAR_ENOUGH
        if not bool(((best > low * length) & (best < high * length)).all()):
            other = _look(problem, state.values, direction, best)
            if bool((other[1].total < costs.total).all()):
                (candidate, costs, there), length = other, best
        decrease = state.cost - costs.total
        state = replace(state, iterations=state.iterations + 1)
        if not bool(((decrease > 0) & costs.total.isfinite()).all()):
            # The kept matrix no longer serves: linearise here, and judge by that.
            return state
        done = (decrease <= config.lm.cost_tolerance * state.cost) & (state.reason == lm.RUNNING)
        keeps = bool((decrease <= config.reuse_below * state.cost).all())
        state = replace(
            state,
            values=candidate,
            cost=costs.total,
            term_cost=costs.by_term,
            reason=torch.where(done, lm.CONVERGED_COST, state.reason),
        )
        if not keeps:
            return state
        places.append(_Place(gradient, newton, _scaled(direction, length), length))
        places, gradient = places[-config.memory :], there
    return state


def _quasi_newton(places: list[_Place], gradient: Tangents, newton: Tangents) -> Tangents:
    """The step of limited-memory BFGS from the kept matrix and the way since (Nocedal and Wright 2006, algorithm 7.4).

    The kept matrix's inverse times a difference of gradients is the difference of its own steps, so that nothing is
    solved but the `newton` step here; and the step sought is a sum of steps that are there, so that the recursion is
    one of their shares, by the derivatives of the cost along each of them at every place.
    """
    newtons = [place.newton for place in places] + [newton]
    spans = [place.step for place in places] + newtons
    count = len(places)
    slope = torch.stack(
        [
            torch.stack([_slope(at, along) for along in spans]).flatten()
            for at in [*(place.gradient for place in places), gradient]
        ]
    ).cpu()
    change = slope[1:] - slope[:-1]
    """Change of the derivatives over each step that was taken."""
    curvature = change[:, :count].diagonal()
    learnt = torch.nonzero(curvature > 0)[:, 0].tolist()
    share = torch.zeros_like(slope[0])
    share[-1] = 1
    weight = torch.zeros_like(curvature)
    for i in reversed(learnt):
        weight[i] = (slope[-1, i] - weight @ change[:, i]) / curvature[i]
        share[count + i + 1] -= weight[i]
        share[count + i] += weight[i]
    if learnt:
        last = learnt[-1]
        by_matrix = change[last, count + last] - change[last, count + last + 1]
        share *= curvature[last] / by_matrix
    for i in learnt:
        share[i] -= weight[i] + change[i] @ share / curvature[i]
    if not slope[-1] @ share < slope[-1, -1] / 10:
        return newton
    direction = {name: torch.zeros_like(tangent) for name, tangent in newton.items()}
    for part, delta in zip(share.tolist(), spans, strict=True):
        for name, tangent in direction.items():
            tangent.add_(delta[name], alpha=part)
    return direction


def _look(
    problem: Problem, values: Values, direction: Tangents, length: Float[Tensor, " 1"]
) -> tuple[Values, Costs, Tangents]:
    """Values at a multiple of the step, with the costs and the gradient there."""
    candidate = retract(problem, values, _scaled(direction, length))
    return candidate, *_gradient(problem, candidate)


def _gradient(problem: Problem, values: Values) -> tuple[Costs, Tangents]:
    """The costs at some values, and their gradient."""
    total = {
        name: value.new_zeros(problem.variables[name].tangent_dim, len(value))
        for name, value in values.items()
    }

    def add(chunk: TermRows[RowGradients]) -> None:
        for (name, block), gradient in zip(chunk.slots, chunk.blocks.gradient, strict=True):
            total[name].index_add_(1, block, gradient)

    costs = assemble(problem, values, row_gradients, add)
    return costs, {name: gradient.mT.contiguous() for name, gradient in total.items()}


def _slope(gradient: Tangents, delta: Tangents) -> Float[Tensor, " 1"]:
    """Derivative of the cost along a tangent."""
    return torch.stack([(gradient[name] * delta[name]).sum() for name in delta]).sum()[None]


def _scaled(delta: Tangents, length: Float[Tensor, " 1"]) -> Tangents:
    return {name: tangent * length for name, tangent in delta.items()}
