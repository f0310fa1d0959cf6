"""Nonlinear least squares as data: variables on manifolds, cost terms, and the problem they make.

A variable is a stack of blocks (camera poses, sign planes, spline coefficients), each with its own small tangent
space. A cost term is a stack of rows (observations); each row touches one block per slot. Nothing here knows what a
camera is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.robust import Loss, Quadratic
from crowdmap_torch.optim.shared_errors import SharedErrors
from crowdmap_torch.processes.sums import lasting
from crowdmap_torch.processes.together import ALONE, Together

Values = Mapping[str, Tensor]
"""The value of every block of every variable, by name; blocks are the leading axis."""


@dataclass(frozen=True)
class Variable:
    """A stack of unknown blocks of one kind."""

    tangent_dim: int
    retract: Callable[[Tensor, Tensor], Tensor]
    """`(values [n, ...], tangents [n, tangent_dim]) -> values`; must be the identity at zero."""
    group: Int[Tensor, " n"] | None = None
    """Which of several independent problems each block belongs to; None: there is one problem."""
    pull: Callable[[Tensor, Tensor], Tensor] | None = None
    """The chain rule through `retract` at zero tangent: `(values [..., m], gradients by the values [d, ..., m]) -> gradients
    by the tangents [d, tangent_dim, m]`, the rows last. None: by autograd of `retract`, which is slower."""


@dataclass(frozen=True)
class SparseJacobian:
    """A Jacobian of many rows of which all entries are zero but for some adjacent ones by each number of the residual."""

    columns: int
    rows: tuple[tuple[int, Float[Tensor, "_ m"]], ...]
    """By number of the residual: the first column that is not zero, and the entries from there on."""

    @classmethod
    def diagonal(cls, entries: Float[Tensor, "k m"]) -> SparseJacobian:
        """That of numbers which depend on one tangent each."""
        return cls(len(entries), tuple((i, x[None]) for i, x in enumerate(entries)))

    def dense(self) -> Float[Tensor, "d columns m"]:
        """All entries."""
        whole = self.rows[0][1].new_zeros(len(self.rows), self.columns, self.rows[0][1].shape[-1])
        for row, (first, entries) in enumerate(self.rows):
            whole[row, first : first + len(entries)] = entries
        return whole


@dataclass(frozen=True)
class Follows:
    """The Jacobian of a block whose moving is a multiple of the first slot's: of a point, minus the camera's."""

    columns: int
    """The first slot's Jacobian counts up to here."""
    factor: float | Float[Tensor, " m"] = -1.0


Jacobian = Tensor | SparseJacobian | Follows
"""Derivatives of many rows by the tangents of one slot, [d, k, m]."""


@dataclass(frozen=True)
class CostTerm:
    """`1/2 sum_row rho(|weight * residual|^2)`."""

    residual: Callable[..., Tensor]
    """Residual of ONE row: the value of one block per slot, then one row of each constant, to a vector [d].

    With a `jacobian` beside it, or if it `takes_rows`, it is handed many rows at once as well, the rows their last axis;
    else `vmap` maps it.
    """
    slots: tuple[tuple[str, Int[Tensor, " m"]], ...]
    """Per slot the variable's name and the block that each row touches."""
    constants: tuple[Tensor, ...] = ()
    """Arrays with the rows as their leading axis."""
    weight: Float[Tensor, " m"] | Float[Tensor, "m d"] | None = None
    """One over the standard deviation of each row, or of each of its residual's entries; None: one."""
    loss: Loss = field(default_factory=Quadratic)
    jacobian: Callable[..., tuple[Tensor, tuple[Jacobian, ...]]] | None = None
    """Residuals [d, m] and Jacobians [d, k, m] of many rows in closed form, at zero tangent; None: by autograd.

    The arguments are those of `residual`, the rows their last axis. There is one Jacobian per slot, in their order; any
    further ones, of arguments that this term holds constant, are not looked at.
    """
    takes_rows: bool = False
    """Whether `residual` serves many rows at once, their number its last axis."""
    shared: SharedErrors | None = None
    """What rows have wrong together; None: each errs for itself. The `weight` of such rows is the same, and their loss one
    of them together."""

    def by_autograd(self) -> CostTerm:
        """The same term without its closed form."""
        rows = self.takes_rows or self.jacobian is not None
        return replace(self, jacobian=None, takes_rows=rows)

    def __len__(self) -> int:
        return len(self.slots[0][1])


@dataclass(frozen=True)
class Problem:
    """Variables, the terms over them, and how many independent problems they make."""

    variables: Mapping[str, Variable]
    terms: Mapping[str, CostTerm]
    group_count: int = 1
    together: Together = ALONE
    """Those who have other terms of the same problem: costs, and gradients of what is in `common`, are sums over all."""
    common: frozenset[str] = frozenset()
    """Variables whose blocks all of them have; others are their own."""

    def dot(
        self, first: Float[Tensor, " n"], second: Float[Tensor, " n"], like: Mapping[str, Tensor]
    ) -> Float[Tensor, ""]:
        """The product of two vectors of all tangents, of everybody's; `like` has one's own, one behind the other."""
        if self.together.is_alone:
            return first @ second
        at, total = 0, first.new_zeros(())
        for name, tangent in like.items():
            here = slice(at, at + tangent.numel())
            at = here.stop
            if name not in self.common or self.together.leads:
                total = total + first[here] @ second[here]
        return self.together.sum(total)

    def group_of_rows(self, term: CostTerm) -> Int[Tensor, " m"] | None:
        """The independent problem of each row; None where there is one problem."""
        name, block = term.slots[0]
        group = self.variables[name].group
        return None if group is None else lasting("group", lambda: group[block], block, group)


def retract(problem: Problem, values: Values, delta: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The values moved by tangents `delta`, variable by variable."""
    return {
        name: problem.variables[name].retract(value, delta[name]) if name in delta else value
        for name, value in values.items()
    }


def euclidean(value: Float[Tensor, "n k"], delta: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """Retraction of a vector space: the sum."""
    return value + delta


def pull_euclidean(
    value: Float[Tensor, "k m"], gradient: Float[Tensor, "d k m"]
) -> Float[Tensor, "d k m"]:
    """Chain rule through `euclidean`."""
    return gradient


def positive(value: Float[Tensor, "n k"], delta: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """Retraction of positive numbers: tangents are relative changes, and no step leaves the set."""
    return value * torch.exp(delta)


def pull_positive(
    value: Float[Tensor, "k m"], gradient: Float[Tensor, "d k m"]
) -> Float[Tensor, "d k m"]:
    """Chain rule through `positive` at zero."""
    return gradient * value
