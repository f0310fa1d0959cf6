"""Corrections of a step: further steps with the same factors, at new gradients (limited-memory BFGS).

Once weights and directions hardly change any more, most of a step's time goes into a matrix that is nearly the one of
the step before. With the factors of H, the gradients g_i, the moves s_i from one point to the next and y_i = g_i+1 - g_i,
the next move is that of the matrix nearest to H that agrees with what the gradients have shown,

    s = -(H corrected by the pairs s_i, y_i)^-1 g        (Nocedal and Wright 2006, algorithm 7.4, H^-1 as its first matrix)

which is superlinear where steps with a matrix of weights are linear: the weights of robust losses overrate the curvature,
and the pairs tell by how much. H^-1 y_i is the difference of two solves, so that each correction takes one gradient and
one solve. Tangents of points so near to each other are taken for those of one point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from crowdmap_torch.optim.problem import Problem, Values, retract
from crowdmap_torch.optim.solvers.assembly import Costs, cost_and_gradient
from crowdmap_torch.optim.solvers.normal_equations import Correctable, Tangents

_Dot = Callable[[Tensor, Tensor], Tensor]
"""The product of two vectors of everybody's tangents."""
_SERVES = 0.5
"""A correction that lowers the cost by less than this share of what its model promises is the last one with its matrix."""


_LEAST = 1 / 3
"""Share of the curvature of H that is left to a direction whatever was seen along it: weights that come back as outliers
draw near can make it next to nothing, and the next move a leap."""


@dataclass(frozen=True)
class Point:
    """Values, their costs, and the gradient by the tangents that a step has."""

    values: Values
    costs: Costs
    gradient: Float[Tensor, " n"]

    @classmethod
    def of(cls, problem: Problem, values: Values, step: Tangents) -> Point:
        """That of values; `step` says which variables move, and in which order."""
        costs, gradient = cost_and_gradient(problem, values)
        return cls(values, costs, packed(gradient, step))


@dataclass(frozen=True)
class Corrected:
    """What corrections have come to."""

    values: Values
    costs: Costs
    count: int
    """How many were tried."""
    converged: Bool[Tensor, " 1"]
    """Whether the last one lowered the cost by less than the tolerance."""


@dataclass(frozen=True)
class _Pair:
    """What was seen on the way from one point to the next."""

    move: Float[Tensor, " n"]
    """s."""
    lifted: Float[Tensor, " n"]
    """H s."""
    change: Float[Tensor, " n"]
    """Of the gradient, y."""
    solved: Float[Tensor, " n"]
    """H^-1 y."""
    curvature: Float[Tensor, ""]
    """s.y."""

    @classmethod
    def of(
        cls,
        dot: _Dot,
        move: Float[Tensor, " n"],
        lifted: Float[Tensor, " n"],
        change: Float[Tensor, " n"],
        solved: Float[Tensor, " n"],
    ) -> _Pair:
        """That of a move, with at least a share of the curvature that H has along it (Powell 1978)."""
        expected, curvature = dot(move, lifted), dot(move, change)
        lacking = (_LEAST * expected - curvature).clamp_min(0)
        share = lacking / (expected - curvature).where(lacking > 0, 1)
        change = torch.lerp(change, lifted, share)
        solved = torch.lerp(solved, move, share)
        return cls(move, lifted, change, solved, dot(move, change))


def corrected(
    problem: Problem,
    normal: Correctable,
    step: Tangents,
    first: Point,
    *,
    most: int,
    cost_tolerance: float,
) -> Corrected:
    """Where at most so many corrections come to from `first`, the `step` of normal equations away from their point.

    They end with the first that raises the cost, which is not taken, that lowers it by less than the tolerance, or by much
    less than it promised.
    """
    values, costs, slope = first.values, first.costs, first.gradient
    move, pairs = packed(step, step), ()
    gradient, newton = packed(normal.tangent_gradient, step), move
    lifted = -gradient
    converged = torch.zeros_like(costs.total, dtype=torch.bool)

    def dot(one: Float[Tensor, " n"], other: Float[Tensor, " n"]) -> Float[Tensor, ""]:
        return problem.dot(one, other, step)

    for count in range(1, most + 1):
        new = packed(normal.correct(unpacked(slope, step)).delta, step)
        pair = _Pair.of(dot, move, lifted, slope - gradient, newton - new)
        pairs, gradient, newton = (*pairs, pair), slope, new
        move, lifted = _quasi_newton(dot, gradient, newton, pairs)
        promised = -dot(gradient, move) / 2
        next_values = retract(problem, values, unpacked(move, step))
        # The last one needs no gradient, which takes twice as long as costs.
        is_last = count == most or bool(promised <= cost_tolerance * costs.total)
        point = None if is_last else Point.of(problem, next_values, step)
        next_costs = Costs.at(problem, next_values) if point is None else point.costs
        decrease = costs.total - next_costs.total
        # Neither is it taken where it is not a number.
        if not bool(decrease > 0):
            return Corrected(values, costs, count, converged)
        values, costs = next_values, next_costs
        converged = decrease <= cost_tolerance * costs.total
        if bool(converged | (decrease < _SERVES * promised)):
            return Corrected(values, costs, count, converged)
        if count < most:
            slope = (point or Point.of(problem, values, step)).gradient
    return Corrected(values, costs, most, converged)


def _quasi_newton(
    dot: _Dot, gradient: Float[Tensor, " n"], newton: Float[Tensor, " n"], pairs: Sequence[_Pair]
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """The step s by the corrected matrix, of the one `newton` = -H^-1 g, and H s."""
    left, step, shares = gradient, newton, []
    for pair in reversed(pairs):
        share = dot(pair.move, left) / pair.curvature
        left, step = left - share * pair.change, step + share * pair.solved
        shares.append(share)
    lifted = -left
    for pair, share in zip(pairs, reversed(shares), strict=True):
        further = -(share + dot(pair.change, step) / pair.curvature)
        step, lifted = step + further * pair.move, lifted + further * pair.lifted
    return step, lifted


def packed(tangents: Tangents, like: Tangents) -> Float[Tensor, " n"]:
    """Tangents of the variables of a step, one behind the other."""
    return torch.cat([tangents[name].reshape(-1) for name in like])


def unpacked(vector: Float[Tensor, " n"], like: Tangents) -> dict[str, Tensor]:
    """The tangents of such a vector, by variable."""
    parts = vector.split([block.numel() for block in like.values()])
    return {name: part.view_as(like[name]) for name, part in zip(like, parts, strict=True)}
