"""Levenberg-Marquardt with gain-ratio damping, for one problem or a batch of independent ones.

`init` weighs the first values, `step` takes one step and returns the next state, `solve` is the same step in a
loop. Every independent problem has its own damping, and each accepts or rejects its own step. After a rejected step the
linearisation is kept. A failure is a reason in the state, never an exception.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.optim.corrections import Point, corrected
from crowdmap_torch.optim.problem import Problem, Values, retract
from crowdmap_torch.optim.solvers.assembly import Costs, cost_and_gradient
from crowdmap_torch.optim.solvers.dense import DenseBackend
from crowdmap_torch.optim.solvers.normal_equations import (
    Backend,
    Correctable,
    NormalEquations,
    Step,
)
from crowdmap_torch.ranges import Damping, Factor, RoundsOrNone, Settings, Share

RUNNING, CONVERGED_COST, CONVERGED_STEP, STALLED, NOT_FINITE, CONVERGED_MOVE = range(6)
_UNDAMPED = 1e-6
"""Steps that are damped by more are short by themselves: they say nothing of how far the minimum is."""
_FELT = 1e-4
"""Less damping than this hardly shortens a step: one that was rejected is damped by as much at least."""
_NEAR_BEST = 0.2
"""Steps that should be longer or shorter by less than this share stay as they are."""
_FAR = 0.02
"""Steps that lower the cost by more than this share stay as well: weights change on the way, and it is no parabola."""
REASONS = (
    "still running",
    "converged: the cost no longer falls",
    "converged: the step is below its tolerance",
    "stalled: no damping up to the largest gives a lower cost",
    "failed: the cost is not finite at the start",
    "converged: the step is lost in how little is known",
)
"""What a reason code of `LmState.reason` means."""


@dataclass(frozen=True)
class LmConfig(Settings):
    """When to stop, and how the damping moves (Madsen, Nielsen and Tingleff 2004, section 3.2)."""

    max_iterations: RoundsOrNone = 50
    """Most steps, rejected ones counted."""
    cost_tolerance: Share = 1e-6
    """Stop when an accepted step lowers the cost by less than this share of it."""
    step_tolerance: Share = 1e-10
    """Stop when the step's norm, in tangent units, is below this."""
    move_tolerance: Share = 0.0
    """Stop when a step moves the unknowns that are solved for last (a map's landmarks) by less than this share of their own
    standard deviations, as root mean square: the rest is lost in how little is known of them. So is a step that is not
    accepted, if it is as short and promises no more than `cost_tolerance`. 0: never."""
    initial_damping: Damping = 1e-4
    """First damping, relative to the Hessian's diagonal."""
    max_damping: Damping = 1e12
    """A problem whose damping passes this has stalled."""
    min_damping: Damping = 1e-12
    """The damping never falls below this."""
    max_stretch: Factor = 1.0
    """Longest that an accepted step may be made, as a multiple, where the model proved wrong about its length: the
    weights of robust losses overrate the curvature. 1: never; a change costs one more evaluation of the cost."""
    corrections: RoundsOrNone = 0
    """Most further steps that a step is followed by with its own matrix, at new gradients (`corrections`): a fraction of the
    work each. A step ends with those that no longer do what its matrix promises. 0: none."""
    correct_below: Share = 0.005
    """Corrected are steps that promise to lower the cost by less than this share of it: while it falls by more, the weights
    of robust losses change too much for the matrix to serve again. They are made longer only where corrections fail."""


@dataclass(frozen=True)
class LmState:
    """Where the minimisation stands; every tensor has one entry per independent problem."""

    values: Values
    damping: Float[Tensor, " groups"]
    growth: Float[Tensor, " groups"]
    """Factor by which the next rejection raises the damping."""
    cost: Float[Tensor, " groups"]
    term_cost: Mapping[str, Float[Tensor, " groups"]]
    gain_ratio: Float[Tensor, " groups"]
    """Decrease of the cost over the decrease that the model predicted, of the last step."""
    step_norm: Float[Tensor, " groups"]
    in_sigmas: Float[Tensor, " groups"]
    """By how many of their own standard deviations the last step that was taken moved what is solved for last."""
    in_sigmas_before: Float[Tensor, " groups"]
    """The same of the one before it; infinite until there was one."""
    stretch: Float[Tensor, " groups"]
    """What multiple of the step that was proposed last counts."""
    accepted: Bool[Tensor, " groups"]
    """Whether the last step was taken."""
    reason: Int[Tensor, " groups"]
    """Index into `REASONS`."""
    normal: NormalEquations | None = field(default=None, repr=False)
    """Normal equations at the values; None where they moved since, or the problem changed."""
    iterations: int = 0
    corrections: int = 0
    """How many were tried in all steps."""
    linearizations: int = 0

    @property
    def done(self) -> bool:
        """True when no problem is running any more."""
        return bool((self.reason != RUNNING).all())

    @property
    def in_sigmas_left(self) -> Float[Tensor, " groups"]:
        """How far all steps to come will go, if each is so much shorter than the one before as the last one was.

        Infinite where that is not known: damping makes steps short, too.
        """
        ratio = self.in_sigmas / self.in_sigmas_before
        left = self.in_sigmas * ratio / (1 - ratio)
        return torch.where((ratio < 1) & (self.damping <= _UNDAMPED), left, torch.inf)

    @property
    def reasons(self) -> tuple[str, ...]:
        """The reason of every problem in words."""
        return tuple(REASONS[code] for code in self.reason.tolist())


def init(
    problem: Problem, values: Values, config: LmConfig, *, backend: Backend | None = None
) -> LmState:
    """The state before the first step: the cost at `values`, nothing moved; by a back end with its normal equations."""
    normal = None if backend is None else backend.assemble(problem, values)
    costs = Costs.at(problem, values) if normal is None else Costs(normal.cost, normal.term_cost)
    cost = costs.total
    nothing = torch.zeros_like(cost)
    return LmState(
        values=values,
        damping=torch.full_like(nothing, config.initial_damping),
        growth=torch.full_like(nothing, 2.0),
        cost=cost,
        term_cost=costs.by_term,
        gain_ratio=nothing,
        step_norm=nothing,
        in_sigmas=torch.full_like(nothing, torch.inf),
        in_sigmas_before=torch.full_like(nothing, torch.inf),
        stretch=torch.ones_like(cost),
        accepted=torch.zeros_like(cost, dtype=torch.bool),
        reason=torch.where(cost.isfinite(), RUNNING, NOT_FINITE),
        normal=normal,
        linearizations=0 if normal is None else 1,
    )


def step(
    problem: Problem, state: LmState, config: LmConfig, *, backend: Backend | None = None
) -> LmState:
    """The state after one step: each problem that is still running moves, or raises its damping."""
    normal = state.normal
    if normal is None:
        normal = (backend or DenseBackend()).assemble(problem, state.values)
        state = replace(state, linearizations=state.linearizations + 1)
    running = state.reason == RUNNING
    proposal = normal.solve(state.damping)
    length = torch.ones_like(state.damping)
    point = _to_be_corrected(problem, state.values, normal, proposal, config)
    if point is None:
        trial = _trial(problem, state.values, proposal.delta, length)
    else:
        trial = point.values, point.costs.by_term, point.costs.total
    decrease = normal.cost - trial[2]
    gain = decrease / proposal.predicted.clamp_min(torch.finfo(decrease.dtype).tiny)
    accepted = running & proposal.solved & trial[2].isfinite() & (decrease > 0)

    shrink = (1 - (2 * gain - 1) ** 3).clamp(1 / 3, 2.0)
    raised = (state.damping * state.growth).clamp_min(_FELT)
    damping = torch.where(accepted, state.damping * shrink, raised)
    damping = torch.where(running, damping, state.damping).clamp_min(config.min_damping)
    growth = torch.where(accepted, torch.full_like(gain, 2.0), state.growth * 2)
    tried = replace(state, accepted=accepted, damping=damping, stretch=length)
    reason = _reason(state, tried, proposal, decrease, normal.cost, config)

    after = None
    if point is not None and bool(accepted & (reason == RUNNING)):
        assert isinstance(normal, Correctable)
        after = corrected(
            *(problem, normal, proposal.delta, point),
            most=config.corrections,
            cost_tolerance=config.cost_tolerance,
        )
    if after is not None and point is not None and after.costs is not point.costs:
        trial = after.values, after.costs.by_term, after.costs.total
        reason[after.converged] = CONVERGED_COST
    elif config.max_stretch > 1:
        # Along the step the cost is a parabola by its slope and by where it came out: this is its lowest point.
        is_near = accepted & (decrease < _FAR * normal.cost)
        best = (1 / (2 - gain).clamp_min(1 / config.max_stretch)).where(is_near, length)
        if bool(((best - 1).abs() > _NEAR_BEST).any()):
            other = _trial(problem, state.values, proposal.delta, best)
            length = torch.where(other[2] < trial[2], best, length)
            trial = _better(problem, trial, other)
            tried, decrease = replace(tried, stretch=length), normal.cost - trial[2]
            reason = _reason(state, tried, proposal, decrease, normal.cost, config)

    moved = bool(accepted.any())
    candidate, term_cost, cost = trial
    return replace(
        state,
        values=_merge(problem, state.values, candidate, accepted) if moved else state.values,
        damping=damping,
        growth=growth,
        cost=torch.where(accepted, cost, normal.cost),
        term_cost={
            name: torch.where(accepted, new, normal.term_cost[name])
            for name, new in term_cost.items()
        },
        gain_ratio=torch.where(running, gain, state.gain_ratio),
        step_norm=torch.where(running, proposal.norm, state.step_norm),
        in_sigmas=torch.where(accepted, proposal.in_sigmas * length, state.in_sigmas),
        in_sigmas_before=torch.where(accepted, state.in_sigmas, state.in_sigmas_before),
        stretch=length,
        accepted=accepted,
        reason=reason,
        # After a rejected step the linearisation still holds.
        normal=None if moved else normal,
        iterations=state.iterations + 1,
        corrections=state.corrections + (0 if after is None else after.count),
    )


def _reason(
    before: LmState,
    after: LmState,
    proposal: Step,
    decrease: Float[Tensor, " groups"],
    cost: Float[Tensor, " groups"],
    config: LmConfig,
) -> Int[Tensor, " groups"]:
    """Why each problem ends with a step that lowered its cost by so much, if it does.

    Of the state `after` the step whether it is accepted, how long it was made, and the damping count.
    """
    running, accepted = before.reason == RUNNING, after.accepted
    reason, tolerance = before.reason.clone(), config.cost_tolerance * cost
    # Where the model itself promises next to nothing, a rejection is rounding and not a bad step.
    nothing_left = proposal.solved & ~accepted & (proposal.predicted <= 1e-3 * tolerance)
    reason[running & ((accepted & (decrease <= tolerance)) | nothing_left)] = CONVERGED_COST
    # So is one that would go no further, and is not worth a shorter one.
    lost = accepted | (proposal.solved & (proposal.predicted <= tolerance))
    lost &= proposal.in_sigmas * after.stretch < config.move_tolerance
    lost &= before.damping <= _UNDAMPED
    reason[running & lost & (reason == RUNNING)] = CONVERGED_MOVE
    tiny = proposal.solved & (proposal.norm < config.step_tolerance)
    reason[running & tiny & (reason == RUNNING)] = CONVERGED_STEP
    too_damped = ~accepted & (after.damping > config.max_damping)
    reason[running & too_damped & (reason == RUNNING)] = STALLED
    return reason


def _to_be_corrected(
    problem: Problem, values: Values, normal: NormalEquations, proposal: Step, config: LmConfig
) -> Point | None:
    """Where the step leads, with the gradient there, if it is one to be corrected."""
    if not config.corrections or not isinstance(normal, Correctable):
        return None
    small = proposal.predicted < config.correct_below * normal.cost
    if not bool((proposal.solved & small).all()):
        return None
    return Point.of(problem, retract(problem, values, proposal.delta), proposal.delta)


_Trial = tuple[Values, Mapping[str, Tensor], Tensor]
"""Values, costs by term, and cost."""


def _trial(
    problem: Problem, values: Values, delta: Mapping[str, Tensor], length: Float[Tensor, " groups"]
) -> _Trial:
    """What comes out at a multiple of the step."""
    candidate = retract(problem, values, _scaled(problem, delta, length))
    costs = Costs.at(problem, candidate)
    return candidate, costs.by_term, costs.total


def _scaled(
    problem: Problem, delta: Mapping[str, Tensor], length: Float[Tensor, " groups"]
) -> dict[str, Tensor]:
    """A multiple of the step."""
    scaled = {}
    for name, tangent in delta.items():
        group = problem.variables[name].group
        scaled[name] = tangent * (length[0] if group is None else length[group][:, None])
    return scaled


def _better(problem: Problem, first: _Trial, second: _Trial) -> _Trial:
    """The trial with the lower cost, for each of the independent problems."""
    lower = second[2] < first[2]
    if not bool(lower.any()):
        return first
    return (
        _merge(problem, first[0], second[0], lower),
        {name: torch.where(lower, cost, first[1][name]) for name, cost in second[1].items()},
        torch.where(lower, second[2], first[2]),
    )


def changed(state: LmState) -> LmState:
    """The state for a problem that changed (matches refreshed, scales narrowed): linearised anew, running again."""
    reason = torch.where(state.reason == NOT_FINITE, state.reason, RUNNING)
    return replace(state, normal=None, reason=reason)


def settled(problem: Problem, state: LmState, normal: NormalEquations, config: LmConfig) -> LmState:
    """The state, which was done, for a problem that has changed a little since: done again, by one more step.

    The step is that of the factors of `normal`, the equations that were solved last, at the new gradient. Where it does
    not lower the cost, or would move what is solved for last by its tolerance or more, the state is as after `changed`.
    """
    again = changed(state)
    if not isinstance(normal, Correctable) or bool((state.damping > _UNDAMPED).any()):
        return again
    costs, gradient = cost_and_gradient(problem, state.values)
    step = normal.correct(gradient)
    if not bool((step.in_sigmas < config.move_tolerance).all()):
        return again
    whole = torch.ones_like(state.damping)
    values, term_cost, cost = _trial(problem, state.values, step.delta, whole)
    if not bool((cost < costs.total).all()):
        return again
    return replace(
        again,
        values=values,
        cost=cost,
        term_cost=term_cost,
        corrections=state.corrections + 1,
        reason=torch.full_like(state.reason, CONVERGED_MOVE),
    )


def solve(
    problem: Problem, values: Values, config: LmConfig, *, backend: Backend | None = None
) -> LmState:
    """The state at the end: every problem converged, stalled, or out of iterations."""
    backend = backend or DenseBackend()
    state = init(problem, values, config, backend=backend)
    while not state.done and state.iterations < config.max_iterations:
        state = step(problem, state, config, backend=backend)
    return state


def _merge(
    problem: Problem, old: Values, new: Values, accepted: Bool[Tensor, " groups"]
) -> dict[str, Tensor]:
    """Candidate values where the block's problem accepted its step, the old ones elsewhere."""
    if bool(accepted.all()):
        return dict(new)
    merged = {}
    for name, variable in problem.variables.items():
        if variable.group is None:
            merged[name] = new[name] if bool(accepted[0]) else old[name]
        else:
            take = accepted[variable.group]
            take = take.reshape(-1, *(1,) * (new[name].ndim - 1))
            merged[name] = torch.where(take, new[name], old[name])
    return merged
