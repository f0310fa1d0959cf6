"""The dense back end: many small problems in one batch, a matrix for each.

Problem b has the Hessian H[b] and the gradient g[b] over all of its unknowns, packed behind each other and padded to the
largest; (H + D) s = -g is solved by Cholesky factors, all at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.optim.linearize import row_blocks
from crowdmap_torch.optim.problem import Problem, Values
from crowdmap_torch.optim.solvers.assembly import TermRows, add_blocks, assemble
from crowdmap_torch.optim.solvers.layout import Layout, layout, read_entries
from crowdmap_torch.optim.solvers.normal_equations import (
    DIAGONAL_FLOOR,
    LinearFunctions,
    Step,
    StepPart,
    solved_step,
)


@dataclass(frozen=True)
class DenseBackend:
    """One dense matrix per independent problem: for problems of tens of unknowns, thousands at a time."""

    chunk_rows: int | None = None

    def assemble(self, problem: Problem, values: Values) -> DenseNormalEquations:
        """Normal equations at `values`, [groups, dim, dim] and [groups, dim]."""
        where = layout(problem, values)
        like = next(iter(values.values()))
        hessian = like.new_zeros(problem.group_count, where.dim, where.dim)
        gradient = like.new_zeros(problem.group_count, where.dim)

        def add(chunk: TermRows) -> None:
            name, block = chunk.slots[0]
            group = where.group[name][block]
            column = [where.offset[name][block] for name, block in chunk.slots]
            row = [group * where.dim + at for at in column]
            for i, pull in enumerate(chunk.blocks.gradient):
                add_blocks(gradient.view(-1), group, column[i], where.dim, pull[None])
            for (i, j), square in chunk.blocks.hessian.items():
                add_blocks(hessian.view(-1), row[i], column[j], where.dim, square)
                if i != j:
                    transposed = square.transpose(0, 1)
                    add_blocks(hessian.view(-1), row[j], column[i], where.dim, transposed)

        costs = assemble(problem, values, row_blocks, add, chunk_rows=self.chunk_rows)
        return DenseNormalEquations(costs.total, costs.by_term, hessian, gradient, where)


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
        part = StepPart(step, self.gradient, added)
        count = self.where.used.sum(1).to(step)
        return solved_step(self.where.unpack(step), part, count=count, solved=solved)

    def covariance(self, *, floor: float = 1e-12) -> DenseCovariance:
        """Inverse of the Gauss-Newton Hessian; padding and unobserved directions get a large variance.

        NaN where there is no inverse.
        """
        pad = (~self.where.used).to(self.hessian) + floor
        inverse, failed = torch.linalg.inv_ex(self.hessian + torch.diag_embed(pad))
        return DenseCovariance(inverse.where((failed == 0)[:, None, None], torch.nan), self.where)


@dataclass(frozen=True)
class DenseCovariance:
    """The joint covariance of each problem's unknowns."""

    matrix: Float[Tensor, "groups dim dim"]
    where: Layout

    def of(self, functions: LinearFunctions) -> Float[Tensor, "n m m"]:
        """Covariance of each row's functions, whose blocks are of one problem."""
        at, J = read_entries(functions, self.where)
        name, block = functions.slots[0]
        group = self.where.group[name][block][:, None, None]
        return J @ self.matrix[group, at[:, :, None], at[:, None]] @ J.mT
