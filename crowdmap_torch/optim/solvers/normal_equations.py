"""Damped normal equations: what every back end makes of a linearised problem, and what it can be asked for.

Around a point with cost c, gradient g and Gauss-Newton Hessian H the model of the cost is a parabola, and a step of it is
damped by the factor t on the Hessian's diagonal:

    m(s) = c + g.s + s.H s / 2        (H + D) s = -g        D = t diag(H)        m(0) - m(s) = (s.D s - g.s) / 2

A back end has two methods: `assemble(problem, values)` gives normal equations at a point, and these give the step for a
damping, so that a rejected step costs a solve and not a linearisation. How sure the unknowns are is asked of the same
equations, as covariances of linear functions of the tangents.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.optim.problem import Problem, Values

DIAGONAL_FLOOR = 1e-9
"""Least diagonal entry that the damping scales, so that an unseen block keeps a solvable equation."""

Tangents = Mapping[str, Tensor]
"""One tangent of every block, `[n, k]` by variable, or several at once, `[n, k, c]`."""


@dataclass(frozen=True)
class Step:
    """A step of the tangents, and what the quadratic model says of it."""

    delta: Tangents
    predicted: Float[Tensor, " groups"]
    """Decrease of the cost that the model predicts."""
    solved: Bool[Tensor, " groups"]
    """False where the matrix was not positive definite."""
    norm: Float[Tensor, " groups"]
    """Length of the step in tangent units."""
    in_sigmas: Float[Tensor, " groups"]
    """By how many of their own standard deviations the unknowns that are solved for last move, all others free: the root
    mean square over their number, whichever way they are correlated."""


@dataclass(frozen=True)
class StepPart:
    """Some of the unknowns in a step, by independent problem."""

    step: Float[Tensor, "groups ..."]
    gradient: Float[Tensor, "groups ..."]
    added: Float[Tensor, "groups ..."]
    """What the damping adds to the Hessian's diagonal, D."""

    @classmethod
    def alone(cls, step: Float[Tensor, " n"], gradient: Float[Tensor, " n"]) -> StepPart:
        """Those of one problem, of whose damping nothing is said."""
        return cls(step[None], gradient[None], torch.zeros_like(step)[None])


def solved_step(
    delta: Tangents,
    *parts: StepPart,
    last: Sequence[StepPart] | None = None,
    count: Float[Tensor, " groups"] | None = None,
    solved: Bool[Tensor, " groups"] | None = None,
) -> Step:
    """The step `delta`, whose unknowns are those of `parts`; `solved` where it is finite, unless told otherwise.

    `last` are those that are solved for last, with the gradient that the elimination of the others has left (None: all
    are), and `count` is how many they are (None: as many as there are numbers).
    """
    along, damped, squared = (
        torch.stack([term.flatten(1).sum(1) for term in terms]).sum(0)
        for terms in (
            [part.gradient * part.step for part in parts],
            [part.added * part.step.square() for part in parts],
            [part.step.square() for part in parts],
        )
    )
    norm = squared.sqrt()
    solved = norm.isfinite() if solved is None else solved
    predicted = torch.where(solved, (damped - along) / 2, 0.0)
    return Step(delta, predicted, solved, norm, _in_sigmas(parts if last is None else last, count))


def _in_sigmas(
    last: Sequence[StepPart], count: Float[Tensor, " groups"] | None
) -> Float[Tensor, " groups"]:
    """The root of the mean of s.S s, which is -g.s, for the step s and the gradient g of what has the information S."""
    along = torch.stack([(of.gradient * of.step).flatten(1).sum(1) for of in last]).sum(0)
    if count is None:
        count = torch.full_like(along, sum(of.step[0].numel() for of in last))
    return mean_in_sigmas(-along, count)


def mean_in_sigmas(
    squared: Float[Tensor, " groups"], count: Float[Tensor, " groups"]
) -> Float[Tensor, " groups"]:
    """The root mean square of a step's sigmas, by their sum of squares s.S s over so many numbers."""
    return (squared / count.clamp_min(1)).clamp_min(0).sqrt()


def failed_step(like: Tangents, cost: Float[Tensor, " groups"]) -> Step:
    """The step that moves nothing, as the matrix is not positive definite; `like` are tangents of its shapes."""
    still = {name: torch.zeros_like(tangent) for name, tangent in like.items()}
    nothing = torch.zeros_like(cost)
    return Step(still, nothing, torch.zeros_like(cost, dtype=torch.bool), nothing, nothing)


@dataclass(frozen=True)
class LinearFunctions:
    """`m` linear functions of the tangents in each of `n` rows; like a cost term's, a row touches one block per slot."""

    slots: tuple[tuple[str, Int[Tensor, " n"]], ...]
    jacobians: tuple[Float[Tensor, "n m _"], ...]
    """Per slot the derivatives by the block's tangent."""

    @classmethod
    def of_tangents(
        cls, slots: tuple[tuple[str, Int[Tensor, " n"]], ...], like: Tensor, *dims: int
    ) -> LinearFunctions:
        """The tangents of each row's blocks themselves, one behind the other; `dims` are their sizes, by slot."""
        eye = torch.eye(sum(dims), dtype=like.dtype, device=like.device)
        parts = eye.split(dims, dim=1)
        rows = len(slots[0][1])
        return cls(slots, tuple(part.expand(rows, *part.shape) for part in parts))


@dataclass(frozen=True)
class ChainChanges:
    """Changes along drives: differences between blocks of chains of one drive."""

    pair: Int[Tensor, "q 2"]
    """The blocks, the first is subtracted."""
    column: Int[Tensor, " q"]
    """Those of one column are of different drives, and asked for at once."""
    columns: int
    """How many columns there may be; those who ask together have as many."""
    whose: Int[Tensor, " q"]
    """The drive of each."""
    of: Float[Tensor, "k m"]
    """By columns, the sums of a block's numbers whose changes they are."""
    drive: Int[Tensor, " chains"]
    """The drive of each chain."""
    drives: int
    """How many drives there are, whether any of them changes or not."""

    def variance(self, of_drives: Float[Tensor, "drives c c"]) -> Float[Tensor, "q m"]:
        """Of each, out of the covariances that each drive's changes have together, column by column."""
        by_column = of_drives.diagonal(dim1=-2, dim2=-1).unflatten(1, (self.columns, -1))
        return by_column[self.whose, self.column]


@runtime_checkable
class Covariance(Protocol):
    """The inverse of the Hessian, as far as it is asked for."""

    def of(self, functions: LinearFunctions) -> Float[Tensor, "n m m"]:
        """Covariance of each row's functions."""
        ...


@runtime_checkable
class MapCovariance(Covariance, Protocol):
    """That of landmarks whose observers were eliminated along chains; `of` is told of landmarks alone."""

    def common(self, functions: LinearFunctions) -> Float[Tensor, "m m"]:
        """What all rows have in common.

        The largest covariance that can be taken off all of them together, so that what is left is a covariance.
        """
        ...

    def of_border(self, *names: str) -> Float[Tensor, "n b b"]:
        """Covariance of every block of what drives have to themselves or share, of several such variables jointly."""
        ...

    def of_border_mean(self, name: str) -> Float[Tensor, "k k"]:
        """Covariance of the mean over all blocks of such a variable."""
        ...

    def resting(self) -> MapCovariance:
        """The same with what it is found from in a file; of sums over chains it tells nothing more."""
        ...

    def of_sums(
        self, weight: Float[Tensor, "n k m"], of: Int[Tensor, " chains"], count: int
    ) -> Float[Tensor, "j m m"]:
        """Covariance of `m` weighted sums over chains' blocks; `of` says of which of them each chain is."""
        ...


@runtime_checkable
class NormalEquations(Protocol):
    """The quadratic model of the cost around a point."""

    @property
    def cost(self) -> Float[Tensor, " groups"]:
        """Cost at the point."""
        ...

    @property
    def term_cost(self) -> Mapping[str, Float[Tensor, " groups"]]:
        """The same by term."""
        ...

    def solve(self, damping: Float[Tensor, " groups"]) -> Step:
        """The step of the model whose Hessian's diagonal is raised by the factor `1 + damping`."""
        ...

    def covariance(self) -> Covariance:
        """The inverse of the Hessian, undamped."""
        ...


@dataclass(frozen=True)
class BorderInformation:
    """Information on all that drives have to themselves or share, priors included, everything else marginalised."""

    matrix: Float[Tensor, "z z"]
    entries: Mapping[str, Int[Tensor, "n k"]]
    """By variable, where in the matrix the tangent of each block is."""

    def on(self, *names: str) -> Float[Tensor, "m m"]:
        """That on all numbers of some variables, one behind the other, the others marginalised too."""
        own = torch.cat([self.entries[name].flatten() for name in names])
        others = torch.ones(len(self.matrix), dtype=torch.bool, device=own.device)
        others[own] = False
        others = torch.nonzero(others)[:, 0]
        across = self.matrix[others[:, None], own]
        factor, failed = torch.linalg.cholesky_ex(self.matrix[others[:, None], others])
        assert not bool(failed), "the border of a step that was solved is positive definite"
        return self.matrix[own[:, None], own] - across.mT @ torch.cholesky_solve(across, factor)


@dataclass(frozen=True)
class Correction:
    """A step by the factors of an earlier one."""

    delta: Tangents
    in_sigmas: Float[Tensor, " 1"]
    """As of a `Step`."""


@runtime_checkable
class Correctable(NormalEquations, Protocol):
    """Those of one problem whose last factors serve other gradients too."""

    @property
    def tangent_gradient(self) -> Tangents:
        """The gradient by variable."""
        ...

    def correct(self, gradient: Tangents) -> Correction:
        """The step for another gradient, by the factors of the last `solve`."""
        ...


@runtime_checkable
class MapEquations(NormalEquations, Protocol):
    """Those of a map: the observers' blocks form chains, and are eliminated."""

    def covariance(self) -> MapCovariance:
        """The inverse of the Hessian, undamped."""
        ...

    def conditional_covariance(self, name: str, *, told: float = 1.0) -> Float[Tensor, "n k k"]:
        """Covariance of every block of an eliminated variable, landmarks and border known.

        As if observations told so many times as much as they do, of chains whose leaves alone observe.
        """
        ...

    def variance_of_changes(self, changes: ChainChanges) -> Float[Tensor, "q m"]:
        """Variances of changes along drives, nothing else known, by the last factors."""
        ...

    def variance_of_leaves(self) -> Float[Tensor, "l k"]:
        """Variance of each leaf's numbers less those of the block that carries it, landmarks and border known."""
        ...

    def border_information(self) -> BorderInformation:
        """Information on what drives have to themselves or share, as the last step had it."""
        ...


@runtime_checkable
class Backend(Protocol):
    """A way to assemble and solve normal equations."""

    def assemble(self, problem: Problem, values: Values) -> NormalEquations:
        """Normal equations at `values`."""
        ...


@runtime_checkable
class MapBackend(Backend, Protocol):
    """A way to assemble and solve those of a map."""

    def assemble(self, problem: Problem, values: Values) -> MapEquations:
        """Normal equations at `values`."""
        ...
