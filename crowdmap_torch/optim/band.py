"""The back end for landmarks along a path: each landmark is eliminated by itself, what is left is one band.

A journey's signs are bound to the stretch of the path that they were seen from, and to nothing else. Without them
the path's blocks are bound to those within the longest such stretch: a banded matrix, factored in a time that grows
with the length of the path.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from torch import Tensor

from crowdmap_torch.optim.linear import DIAGONAL_FLOOR, Step, outer
from crowdmap_torch.optim.linearize import CHUNK_ROWS, chunks, linearize
from crowdmap_torch.optim.problem import Problem, Values

UNHELD_FLOOR = 1e-6
"""Information added to every unknown before its covariance is read: none is less sure than 1000 units."""
COLUMNS_AT_ONCE = 256
"""Right-hand sides of a banded system that are solved together; bounds the memory."""


@dataclass(frozen=True)
class BandBackend:
    """Normal equations of one problem: a variable `path` whose blocks are in order, and landmarks bound to parts of it.

    Every other variable has one block per landmark. A row may touch one landmark, and blocks of the path.
    """

    path: str
    chunk_rows: int = CHUNK_ROWS

    def assemble(self, problem: Problem, values: Values) -> BandNormalEquations:
        """Normal equations at `values`."""
        if problem.group_count != 1:
            raise ValueError("a path is solved as one problem, not in a batch")
        where = _layout(problem, values, self.path)
        first = values[self.path]
        n, k, width = len(where.first), where.landmark_dim, where.width
        nodes, d, reach = len(first), where.path_dim, where.reach
        own = first.new_zeros(n * k * k)
        own_gradient = first.new_zeros(n * k)
        coupling = first.new_zeros(n * k * width * d)
        path = first.new_zeros(nodes * (reach + 1) * d * d)
        path_gradient = first.new_zeros(nodes * d)
        term_cost = {}
        for name, term in problem.terms.items():
            cost = first.new_zeros(1)
            for _, piece in chunks(term, self.chunk_rows):
                linear = linearize(piece, dict(problem.variables), values)
                cost += linear.rho.sum() / 2
                weighted = [J * linear.robust_weight[:, None, None] for J in linear.jacobians]
                slots = [
                    (slot == self.path, block, where.offset.get(slot, 0))
                    for slot, block in piece.slots
                ]
                for (on_path, block, offset), W in zip(slots, weighted, strict=True):
                    pull = (W * linear.residual[..., None]).sum(1)
                    target, dim = (path_gradient, d) if on_path else (own_gradient, k)
                    at = block[:, None] * dim + offset + _range(W)
                    target.index_add_(0, at.flatten(), pull.flatten())
                for (on_a, a, off_a), W in zip(slots, weighted, strict=True):
                    for (on_b, b, off_b), J in zip(slots, linear.jacobians, strict=True):
                        row, column = off_a + _range(W)[:, :, None], off_b + _range(J)[:, None, :]
                        if on_a and on_b:
                            # Of the two halves the one below the diagonal is kept, and of it the blocks next to it.
                            lower = torch.nonzero(a >= b)[:, 0]
                            at = (b[lower] * (reach + 1) + a[lower] - b[lower])[:, None, None]
                            _add(path, (at * d + row) * d + column, outer(W[lower], J[lower]))
                        elif not on_a and not on_b:
                            _add(own, (a[:, None, None] * k + row) * k + column, outer(W, J))
                        elif on_b:
                            at = (b - where.first[a])[:, None, None] * d + column
                            at = (a[:, None, None] * k + row) * (width * d) + at
                            _add(coupling, at, outer(W, J))
            term_cost[name] = cost
        return BandNormalEquations(
            cost=torch.stack(list(term_cost.values())).sum(0),
            term_cost=term_cost,
            own=own.reshape(n, k, k),
            own_gradient=own_gradient.reshape(n, k),
            coupling=coupling.reshape(n, k, width * d),
            path=path.reshape(nodes, reach + 1, d, d),
            path_gradient=path_gradient,
            where=where,
        )


@dataclass(frozen=True)
class PathLayout:
    """Where tangents lie: landmark by landmark, and along the path."""

    path: str
    path_dim: int
    reach: int
    """Blocks of the path that a row without a landmark spans, less one."""
    offset: Mapping[str, int]
    """Of each landmark variable within its landmark's tangent."""
    tangent_dim: Mapping[str, int]
    landmark_dim: int
    first: Int[Tensor, " n"]
    """First block of the path that each landmark is bound to."""
    width: int
    """Blocks from there to the last, the longest of all."""


@dataclass(frozen=True)
class BandNormalEquations:
    """The quadratic model: one small matrix per landmark, its coupling to the path, and the path's own band."""

    cost: Float[Tensor, " 1"]
    term_cost: Mapping[str, Float[Tensor, " 1"]]
    own: Float[Tensor, "n k k"]
    own_gradient: Float[Tensor, "n k"]
    coupling: Float[Tensor, "n k w"]
    """By the blocks of the path from `where.first` on."""
    path: Float[Tensor, "p r d d"]
    """Blocks on and below the diagonal, by column."""
    path_gradient: Float[Tensor, " q"]
    where: PathLayout

    def solve(self, damping: Float[Tensor, " 1"]) -> Step:
        """The damped step: landmarks are eliminated, the band is solved, landmarks follow."""
        own_added = damping * self.own.diagonal(dim1=-2, dim2=-1).clamp_min(DIAGONAL_FLOOR)
        diagonal = self.path[:, 0].diagonal(dim1=-2, dim2=-1).flatten()
        path_added = damping * diagonal.clamp_min(DIAGONAL_FLOOR)
        reduced = self._reduced(own_added, path_added)
        if reduced is None:
            return self._failed()
        path_step = -reduced.solve(self._reduced_gradient(reduced)[:, None])[:, 0]
        bound = (self.coupling @ path_step[self.columns()][..., None])[..., 0]
        own_step = -(reduced.inverse @ (self.own_gradient + bound)[..., None])[..., 0]
        along = (self.own_gradient * own_step).sum() + self.path_gradient @ path_step
        damped = (own_added * own_step.square()).sum() + path_added @ path_step.square()
        where = self.where
        delta = {where.path: path_step.reshape(-1, where.path_dim)}
        for name, offset in where.offset.items():
            delta[name] = own_step[:, offset : offset + where.tangent_dim[name]]
        norm = (own_step.square().sum() + path_step.square().sum()).sqrt()
        solved = torch.ones(1, dtype=torch.bool, device=norm.device)
        return Step(delta, ((damped - along) / 2)[None], solved, norm[None])

    def covariance(
        self,
        by_landmark: Float[Tensor, "n m k"],
        by_path: Float[Tensor, "n b m d"],
        block: Int[Tensor, "n b"],
    ) -> Float[Tensor, "n m m"]:
        """Covariance of linear functions, `m` for each landmark; NaN where the matrix is not even semidefinite.

        `by_landmark` are their derivatives by the landmark's tangent, `by_path` by the path's blocks `block`.
        """
        reduced = self._reduced(*self._floor())
        if reduced is None:
            return by_landmark @ by_landmark.mT * torch.nan
        d = self.where.path_dim
        spread = by_landmark @ reduced.inverse
        through = torch.cat((-spread @ self.coupling, *by_path.unbind(1)), dim=-1)
        entry = (block[..., None] * d + torch.arange(d, device=block.device)).flatten(1)
        entry = torch.cat((self.columns(), entry), dim=-1)[:, None].expand_as(through)
        n, m, _ = through.shape
        parts = []
        for start in range(0, n, max(COLUMNS_AT_ONCE // m, 1)):
            part = slice(start, start + max(COLUMNS_AT_ONCE // m, 1))
            at = entry[part]
            number = torch.arange(len(at) * m, device=at.device).reshape(-1, m)
            function = self.path_gradient.new_zeros(len(self.path_gradient), len(at) * m)
            function.index_put_(
                (at, number[..., None].expand_as(at)), through[part], accumulate=True
            )
            solved = reduced.solve(function)
            # Of the solution those rows count that the landmark's own functions read.
            parts.append(through[part] @ solved[at[:, 0, :, None], number[:, None]])
        return spread @ by_landmark.mT + torch.cat(parts)

    def log_evidence(self) -> Float[Tensor, ""]:
        """Minus the logarithm of the model's integral over all unknowns, up to a constant of their number.

        Infinite where the matrix is not even semidefinite.
        """
        reduced = self._reduced(*self._floor())
        if reduced is None:
            return torch.full_like(self.cost[0], torch.inf)
        pull = self._reduced_gradient(reduced)
        bend = (self.own_gradient[:, None] @ reduced.inverse @ self.own_gradient[..., None]).sum()
        bend = bend + pull @ reduced.solve(pull[:, None])[:, 0]
        return self.cost[0] + (reduced.log_determinant - bend) / 2

    def _floor(self) -> tuple[Tensor, Tensor]:
        """What keeps landmarks that nothing holds any more from spoiling the others."""
        return (
            torch.full_like(self.own_gradient, UNHELD_FLOOR),
            torch.full_like(self.path_gradient, UNHELD_FLOOR),
        )

    def plus(
        self,
        path_alone: BandNormalEquations,
        factor: Float[Tensor, " d"],
        value: Float[Tensor, "p d"],
    ) -> BandNormalEquations:
        """The model with squares of the path's own added, each component of the blocks times its factor.

        `path_alone` has no landmarks, residuals that are linear in the path's `value`, and components that do not mix.
        """
        more = factor.repeat(len(value)) * path_alone.path_gradient
        return replace(
            self,
            cost=self.cost + more @ value.flatten() / 2,
            path=self.path + factor[:, None] * path_alone.path,
            path_gradient=self.path_gradient + more,
        )

    def columns(self) -> Int[Tensor, "n w"]:
        """Entries of the path's tangent that each landmark is bound to."""
        w = torch.arange(self.coupling.shape[-1], device=self.coupling.device)
        return self.where.first[:, None] * self.where.path_dim + w

    def _reduced_gradient(self, reduced: _Reduced) -> Float[Tensor, " q"]:
        own = (self.coupling.mT @ (reduced.inverse @ self.own_gradient[..., None]))[..., 0]
        return self.path_gradient.index_add(0, self.columns().flatten(), -own.flatten())

    def _reduced(self, own_added: Tensor, path_added: Tensor) -> _Reduced | None:
        """The factor of the path's band once landmarks are eliminated; None where there is none."""
        factor, failed = torch.linalg.cholesky_ex(self.own + torch.diag_embed(own_added))
        if bool(failed.any()):
            return None
        inverse = torch.cholesky_inverse(factor)
        d, width = self.where.path_dim, self.coupling.shape[-1]
        nodes, blocks = self.path.shape[:2]
        band = max(blocks * d, width)
        # Column by column, the diagonal first: LAPACK's lower band storage, transposed.
        lower = self.path_gradient.new_zeros(nodes * d * band)
        node, back, i, j = (
            torch.arange(k, device=lower.device).reshape(shape)
            for k, shape in (
                (nodes, (-1, 1, 1, 1)),
                (blocks, (-1, 1, 1)),
                (d, (-1, 1)),
                (d, (-1,)),
            )
        )
        below = back * d + i - j
        is_lower = (below >= 0).expand_as(self.path)
        at = ((node * d + j) * band + below).expand_as(self.path)
        lower[at[is_lower]] = self.path[is_lower]
        lower.view(nodes * d, band)[:, 0] += path_added
        schur = self.coupling.mT @ inverse @ self.coupling
        row, column = torch.tril_indices(width, width, device=lower.device)
        start = self.where.first[:, None] * d
        at = (start + column) * band + row - column
        lower.index_add_(0, at.flatten(), -schur[:, row, column].flatten())
        stored = lower.view(nodes * d, band).cpu().numpy().T
        try:
            ab = cholesky_banded(stored, lower=True, overwrite_ab=True, check_finite=False)
        except LinAlgError:
            return None
        own = factor.diagonal(dim1=-2, dim2=-1).log().sum()
        return _Reduced(inverse, ab, 2 * (own + float(np.log(ab[0]).sum())))

    def _failed(self) -> Step:
        where, zero = self.where, torch.zeros_like(self.own_gradient)
        delta = {where.path: torch.zeros_like(self.path_gradient).reshape(-1, where.path_dim)}
        for name, offset in where.offset.items():
            delta[name] = zero[:, offset : offset + where.tangent_dim[name]]
        nothing = torch.zeros_like(self.cost)
        return Step(delta, nothing, nothing.bool(), nothing)


@dataclass(frozen=True)
class _Reduced:
    """What is left of the damped matrix when its landmarks are eliminated."""

    inverse: Float[Tensor, "n k k"]
    """Of each landmark's own part."""
    factor: Float[np.ndarray, "w q"]
    log_determinant: Float[Tensor, ""]
    """Of the whole matrix."""

    def solve(self, right: Float[Tensor, "q c"]) -> Float[Tensor, "q c"]:
        x = cho_solve_banded((self.factor, True), right.cpu().numpy(), check_finite=False)
        return torch.from_numpy(x).to(right)


def _layout(problem: Problem, values: Values, path: str) -> PathLayout:
    names = [name for name in problem.variables if name != path]
    dims = {name: problem.variables[name].tangent_dim for name in names}
    ends = torch.tensor(list(dims.values())).cumsum(0).tolist()
    nodes, n = len(values[path]), len(values[names[0]])
    device = values[path].device
    first = torch.full((n,), nodes, device=device)
    last = torch.full((n,), -1, device=device)
    reach = 0
    for term in problem.terms.values():
        on_path = [block for slot, block in term.slots if slot == path]
        landmark = next((block for slot, block in term.slots if slot != path), None)
        if not on_path or not len(term):
            continue
        low, high = torch.stack(on_path).amin(0), torch.stack(on_path).amax(0)
        reach = max(reach, int((high - low).max()))
        if landmark is not None:
            first = first.scatter_reduce(0, landmark, low, "amin")
            last = last.scatter_reduce(0, landmark, high, "amax")
    width = max(int((last - first).max()) + 1, 1)
    return PathLayout(
        path=path,
        path_dim=problem.variables[path].tangent_dim,
        reach=reach,
        offset={name: end - dims[name] for name, end in zip(names, ends, strict=True)},
        tangent_dim=dims,
        landmark_dim=ends[-1],
        # Windows are equally wide, and inside the path.
        first=first.clamp_max(nodes - width),
        width=width,
    )


def _range(J: Float[Tensor, "m d k"]) -> Int[Tensor, "1 k"]:
    return torch.arange(J.shape[-1], device=J.device)[None]


def _add(
    total: Float[Tensor, " t"], at: Int[Tensor, "m k l"], block: Float[Tensor, "m k l"]
) -> None:
    total.index_add_(0, at.flatten(), block.flatten())
