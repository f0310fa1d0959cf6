"""Damped normal equations of a linearised problem, and the dense back end: many small problems in one batch.

A back end has two methods: `assemble(problem, values)` gives normal equations at a point, and these give the step for a
damping, so that a rejected step costs a solve and not a linearisation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.optim.linearize import CHUNK_ROWS, chunks, linearize
from crowdmap_torch.optim.problem import Problem, Values

DIAGONAL_FLOOR = 1e-9
"""Least diagonal entry that the damping scales, so that an unseen block keeps a solvable equation."""


@dataclass(frozen=True)
class Step:
    """A step of the tangents, and what the quadratic model says of it."""

    delta: Mapping[str, Tensor]
    """Tangent of every block, by variable."""
    predicted: Float[Tensor, " groups"]
    """Decrease of the cost that the model predicts."""
    solved: Bool[Tensor, " groups"]
    """False where the matrix was not positive definite."""
    norm: Float[Tensor, " groups"]
    """Length of the step in tangent units."""


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


@runtime_checkable
class ReusableEquations(NormalEquations, Protocol):
    """Normal equations whose factorised matrix serves for gradients at other points too."""

    def moved(self, problem: Problem, values: Values) -> ReusableEquations:
        """Cost and gradient at other values, with the matrix as the last solve factorised it."""
        ...

    def slope(self, delta: Mapping[str, Tensor]) -> Float[Tensor, " groups"]:
        """Derivative of the cost along `delta`."""
        ...


@runtime_checkable
class Backend(Protocol):
    """A way to assemble and solve normal equations."""

    def assemble(self, problem: Problem, values: Values) -> NormalEquations:
        """Normal equations at `values`."""
        ...


@dataclass(frozen=True)
class Layout:
    """Where every block's tangent lies: a row of a [groups, dim] array and an offset in it."""

    offset: Mapping[str, Int[Tensor, " n"]]
    group: Mapping[str, Int[Tensor, " n"]]
    tangent_dim: Mapping[str, int]
    dim: int
    used: Bool[Tensor, "groups dim"]
    """False for the padding of groups with fewer unknowns than the largest."""


def layout(problem: Problem, values: Values, *, skip: tuple[str, ...] = ()) -> Layout:
    """Blocks of every variable (but those in `skip`) packed behind each other, group by group."""
    first = next(iter(values.values()))
    used_dim = torch.zeros(problem.group_count, dtype=torch.long, device=first.device)
    offset, group = {}, {}
    for name, variable in problem.variables.items():
        if name in skip:
            continue
        n = len(values[name])
        of = variable.group
        of = torch.zeros(n, dtype=torch.long, device=first.device) if of is None else of
        order = torch.argsort(of, stable=True)
        counts = torch.bincount(of, minlength=problem.group_count)
        rank = torch.empty_like(of)
        rank[order] = torch.arange(n, device=of.device) - (counts.cumsum(0) - counts)[of[order]]
        offset[name] = used_dim[of] + rank * variable.tangent_dim
        group[name] = of
        used_dim = used_dim + counts * variable.tangent_dim
    dim = int(used_dim.max()) if len(used_dim) else 0
    used = torch.arange(dim, device=first.device)[None] < used_dim[:, None]
    dims = {name: problem.variables[name].tangent_dim for name in offset}
    return Layout(offset, group, dims, dim, used)


def unpack(packed: Float[Tensor, "groups dim"], where: Layout) -> dict[str, Tensor]:
    """The tangent of every block, by variable, out of packed vectors."""
    return {
        name: packed[
            where.group[name][:, None],
            offset[:, None] + torch.arange(where.tangent_dim[name], device=offset.device),
        ]
        for name, offset in where.offset.items()
    }


def outer(a: Float[Tensor, "m d k"], b: Float[Tensor, "m d l"]) -> Float[Tensor, "m k l"]:
    """`a^T b` of every row; residuals are short, and broadcasting beats a batch of tiny products."""
    if a.shape[1] > 4:
        return a.mT @ b
    total = a[:, 0, :, None] * b[:, 0, None, :]
    for i in range(1, a.shape[1]):
        total = torch.addcmul(total, a[:, i, :, None], b[:, i, None, :])
    return total


@dataclass(frozen=True)
class DenseBackend:
    """One dense matrix per independent problem: for problems of tens of unknowns, thousands at a time."""

    chunk_rows: int = CHUNK_ROWS

    def assemble(self, problem: Problem, values: Values) -> DenseNormalEquations:
        """Normal equations at `values`, [groups, dim, dim] and [groups, dim]."""
        where = layout(problem, values)
        first = next(iter(values.values()))
        hessian = first.new_zeros(problem.group_count, where.dim, where.dim)
        gradient = first.new_zeros(problem.group_count, where.dim)
        term_cost = {}
        for name, term in problem.terms.items():
            cost = first.new_zeros(problem.group_count)
            for _, piece in chunks(term, self.chunk_rows):
                linear = linearize(piece, dict(problem.variables), values)
                group = where.group[piece.slots[0][0]][piece.slots[0][1]]
                cost.index_add_(0, group, linear.rho / 2)
                J = torch.cat(linear.jacobians, dim=-1)
                columns = torch.cat(
                    [
                        where.offset[slot][block][:, None]
                        + torch.arange(problem.variables[slot].tangent_dim, device=block.device)
                        for slot, block in piece.slots
                    ],
                    dim=-1,
                )
                weighted = J * linear.robust_weight[:, None, None]
                flat = group[:, None] * where.dim + columns
                gradient.view(-1).index_add_(
                    0, flat.flatten(), (weighted * linear.residual[..., None]).sum(1).flatten()
                )
                squares = flat[:, :, None] * where.dim + columns[:, None, :]
                hessian.view(-1).index_add_(0, squares.flatten(), outer(weighted, J).flatten())
            term_cost[name] = cost
        total = torch.stack(list(term_cost.values())).sum(0)
        return DenseNormalEquations(total, term_cost, hessian, gradient, where)


@dataclass(frozen=True)
class DenseNormalEquations:
    """Normal equations of independent problems as one batch of dense matrices."""

    cost: Float[Tensor, " groups"]
    term_cost: Mapping[str, Float[Tensor, " groups"]]
    hessian: Float[Tensor, "groups dim dim"]
    gradient: Float[Tensor, "groups dim"]
    where: Layout

    def solve(self, damping: Float[Tensor, " groups"]) -> Step:
        """The damped step of every problem, by Cholesky factors."""
        diagonal = self.hessian.diagonal(dim1=-2, dim2=-1)
        added = damping[:, None] * diagonal.clamp_min(DIAGONAL_FLOOR)
        # Padding gets a one on the diagonal: it stays at zero and disturbs nobody.
        added = torch.where(self.where.used, added, torch.ones_like(added))
        factor, failed = torch.linalg.cholesky_ex(self.hessian + torch.diag_embed(added))
        solved = (failed == 0) & self.gradient.isfinite().all(-1)
        eye = torch.eye(self.where.dim, dtype=factor.dtype, device=factor.device)
        factor = torch.where(solved[:, None, None], factor, eye)
        step = -torch.cholesky_solve(self.gradient[..., None], factor)[..., 0]
        step = torch.where(solved[:, None], step, torch.zeros_like(step))
        # m(0) - m(step) = -(g.s + s.H.s / 2), and (H + D) s = -g.
        predicted = ((added * step.square()).sum(-1) - (self.gradient * step).sum(-1)) / 2
        return Step(unpack(step, self.where), predicted, solved, step.norm(dim=-1))

    def covariance(self, *, floor: float = 1e-12) -> Float[Tensor, "groups dim dim"]:
        """Inverse of the Gauss-Newton Hessian; padding and unobserved directions get a large variance."""
        pad = (~self.where.used).to(self.hessian) + floor
        return torch.linalg.inv(self.hessian + torch.diag_embed(pad))
