"""The back end for landmarks along a path: each landmark is eliminated by itself, what is left is one band.

A journey's signs are bound to the stretch of the path that they were seen from, and to nothing else. Without them
the path's blocks are bound to those within the longest such stretch: a banded matrix, factored in a time that grows
with the length of the path. With D in A and C already,

    [ A  B   ] [ x ]     [ a ]        A: `own`, a block per landmark    B: `coupling`    C: `path`, a band
    [ B^T  C ] [ y ] = - [ b ]        a: `own_gradient`                                  b: `path_gradient`

    S = C - B^T A^-1 B        S y = -(b - B^T A^-1 a)        x = -A^-1 (a + B y)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.band_cholesky import BandFactor, BandInverse, cholesky_banded
from crowdmap_torch.optim.linearize import row_blocks
from crowdmap_torch.optim.problem import Problem, Values
from crowdmap_torch.optim.solvers.assembly import Costs, TermRows, add_blocks, assemble
from crowdmap_torch.optim.solvers.normal_equations import (
    DIAGONAL_FLOOR,
    LinearFunctions,
    Step,
    StepPart,
    failed_step,
    solved_step,
)
from crowdmap_torch.processes.sums import add_at

UNHELD_FLOOR = 1e-6
"""Information added to every unknown before its covariance is read: none is less sure than 1000 units."""
_LANDMARKS_AT_ONCE = 32
"""Landmarks whose products are taken off the path at once."""


@dataclass(frozen=True)
class BandBackend:
    """Normal equations of one problem: a variable `path` whose blocks are in order, and landmarks bound to parts of it.

    Every other variable has one block per landmark. A row may touch one landmark, and blocks of the path.
    """

    path: str
    chunk_rows: int | None = None

    def assemble(self, problem: Problem, values: Values) -> BandNormalEquations:
        """Normal equations at `values`."""
        if problem.group_count != 1:
            raise ValueError("a path is solved as one problem, not in a batch")
        sums = _PathSums(_layout(problem, values, self.path), values[self.path])
        costs = assemble(problem, values, row_blocks, sums.add, chunk_rows=self.chunk_rows)
        return sums.equations(costs)


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


class _PathSums:
    """Where the blocks of rows go: A, B, C, a, b as flat arrays."""

    def __init__(self, where: PathLayout, like: Tensor) -> None:
        n, k, d = len(where.first), where.landmark_dim, where.path_dim
        self.where, self.nodes = where, len(like)
        self.own = like.new_zeros(n * k * k)
        self.own_gradient = like.new_zeros(n * k)
        self.coupling = like.new_zeros(n * k * where.width * d)
        self.path = like.new_zeros(self.nodes * (where.reach + 1) * d * d)
        self.path_gradient = like.new_zeros(self.nodes * d)

    def add(self, chunk: TermRows) -> None:
        """Adds a chunk of rows."""
        where = self.where
        k, d = where.landmark_dim, where.path_dim
        offset = [where.offset.get(name, 0) for name, _ in chunk.slots]
        for i, (name, block) in enumerate(chunk.slots):
            on_path = name == where.path
            target = self.path_gradient if on_path else self.own_gradient
            at = block * (d if on_path else k) + offset[i]
            add_blocks(target, at, torch.zeros_like(at), 1, chunk.blocks.gradient[i][:, None])
        for (i, j), square in chunk.blocks.hessian.items():
            (name, a), (other, b) = chunk.slots[i], chunk.slots[j]
            if name == where.path and other == where.path:
                self._add_to_path(a, b, square)
                if i != j:
                    self._add_to_path(b, a, square.transpose(0, 1))
            elif name == where.path:
                self._add_coupling(b, offset[j], a, square.transpose(0, 1))
            elif other == where.path:
                self._add_coupling(a, offset[i], b, square)
            else:
                row, column = a * k + offset[i], torch.full_like(a, offset[j])
                add_blocks(self.own, row, column, k, square)
                if i != j:
                    row, column = a * k + offset[j], torch.full_like(a, offset[i])
                    add_blocks(self.own, row, column, k, square.transpose(0, 1))

    def _add_to_path(
        self, a: Int[Tensor, " m"], b: Int[Tensor, " m"], block: Float[Tensor, "d d m"]
    ) -> None:
        """Of the two halves of C the one below the diagonal is kept, and of it the blocks next to it."""
        d = self.where.path_dim
        lower = torch.nonzero(a >= b)[:, 0]
        a, b = a[lower], b[lower]
        row = (b * (self.where.reach + 1) + a - b) * d
        add_blocks(self.path, row, torch.zeros_like(row), d, block[..., lower])

    def _add_coupling(
        self,
        landmark: Int[Tensor, " m"],
        offset: int,
        block: Int[Tensor, " m"],
        product: Float[Tensor, "_ d m"],
    ) -> None:
        where, columns = self.where, self.where.width * self.where.path_dim
        row = landmark * where.landmark_dim + offset
        column = (block - where.first[landmark]) * where.path_dim
        add_blocks(self.coupling, row, column, columns, product)

    def equations(self, costs: Costs) -> BandNormalEquations:
        """The normal equations of all rows."""
        where = self.where
        n, k, d = len(where.first), where.landmark_dim, where.path_dim
        return BandNormalEquations(
            cost=costs.total,
            term_cost=costs.by_term,
            own=self.own.reshape(n, k, k),
            own_gradient=self.own_gradient.reshape(n, k),
            coupling=self.coupling.reshape(n, k, where.width * d),
            path=self.path.reshape(self.nodes, where.reach + 1, d, d),
            path_gradient=self.path_gradient,
            where=where,
        )


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
            return failed_step(self._unpack(self.own_gradient, self.path_gradient), self.cost)
        gradient = self._reduced_gradient(reduced)
        path_step = -reduced.path.solve(gradient[:, None])[:, 0]
        bound = (self.coupling @ path_step[self.columns()][..., None])[..., 0]
        own_step = -(reduced.inverse @ (self.own_gradient + bound)[..., None])[..., 0]
        return solved_step(
            self._unpack(own_step, path_step),
            StepPart(own_step[None], self.own_gradient[None], own_added[None]),
            StepPart(path_step[None], self.path_gradient[None], path_added[None]),
            last=(StepPart.alone(path_step, gradient),),
        )

    def covariance(self) -> BandCovariance:
        """The inverse of the Hessian; NaN where that is not even semidefinite."""
        return BandCovariance(self, self._reduced(*self._floor()))

    def log_evidence(self) -> Float[Tensor, ""]:
        """Minus the logarithm of the model's integral over all unknowns, up to a constant of their number.

        Infinite where the matrix is not even semidefinite.
        """
        reduced = self._reduced(*self._floor())
        if reduced is None:
            return torch.full_like(self.cost[0], torch.inf)
        right_side = self._reduced_gradient(reduced)
        along = (self.own_gradient[:, None] @ reduced.inverse @ self.own_gradient[..., None]).sum()
        along = along + right_side @ reduced.path.solve(right_side[:, None])[:, 0]
        return self.cost[0] + (reduced.log_determinant - along) / 2

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
        return add_at(self.path_gradient.clone(), 0, self.columns().flatten(), -own.flatten())

    def _reduced(self, own_added: Tensor, path_added: Tensor) -> _Reduced | None:
        """The factor of the path's band once landmarks are eliminated; None where there is none."""
        factor, failed = torch.linalg.cholesky_ex(self.own + torch.diag_embed(own_added))
        if bool(failed.any()):
            return None
        inverse = torch.cholesky_inverse(factor)
        d, width = self.where.path_dim, self.coupling.shape[-1]
        nodes, blocks = self.path.shape[:2]
        band = max(blocks * d, width)
        lower = self.path_gradient.new_zeros(nodes * d, band)
        for j in range(d):
            lower[j::d, : blocks * d - j] = self.path[..., j].flatten(1)[:, j:]
        lower[:, 0] += path_added
        start = (self.where.first * d).tolist()
        for some in torch.arange(len(inverse), device=lower.device).split(_LANDMARKS_AT_ONCE):
            # All at once would not stay in a processor's cache.
            coupling = self.coupling[some]
            schur = (coupling.mT @ inverse[some] @ coupling).tril_()
            for i, own in zip(some.tolist(), schur, strict=True):
                # A square of the matrix in its storage by diagonals; its last row ends where its first column begins.
                square = lower.as_strided((width, width), (1, band - 1), start[i] * band)
                square[:-1] -= own[:-1]
                square[-1] -= own[-1]
        of_path = cholesky_banded(lower)
        if of_path is None:
            return None
        own = factor.diagonal(dim1=-2, dim2=-1).log().sum()
        return _Reduced(inverse, of_path, 2 * own + of_path.log_determinant)

    def _unpack(
        self, own: Float[Tensor, "n k"], path: Float[Tensor, " q"]
    ) -> dict[str, Float[Tensor, "_ _"]]:
        """Tangents by variable."""
        where = self.where
        by_name = {
            name: own[:, offset : offset + where.tangent_dim[name]]
            for name, offset in where.offset.items()
        }
        return {where.path: path.reshape(-1, where.path_dim), **by_name}


@dataclass(frozen=True)
class BandCovariance:
    """The inverse of the Hessian, solved for what is asked."""

    _equations: BandNormalEquations
    _reduced: _Reduced | None

    def of(self, functions: LinearFunctions) -> Float[Tensor, "n m m"]:
        """Covariance of each row's functions, of at most one landmark and of blocks of the path."""
        equations, reduced, where = self._equations, self._reduced, self._equations.where
        n, m, _ = functions.jacobians[0].shape
        like = equations.path_gradient
        if reduced is None:
            return like.new_full((n, m, m), torch.nan)
        by_landmark = like.new_zeros(n, m, where.landmark_dim)
        landmark = torch.zeros(n, dtype=torch.long, device=like.device)
        by_path, entries = [], []
        for (name, block), J in zip(functions.slots, functions.jacobians, strict=True):
            if name == where.path:
                d = torch.arange(where.path_dim, device=block.device)
                by_path.append(J)
                entries.append(block[:, None] * where.path_dim + d)
            else:
                landmark = block
                by_landmark[..., where.offset[name] :][..., : where.tangent_dim[name]] = J
        spread = by_landmark @ reduced.inverse[landmark]
        through = torch.cat((-spread @ equations.coupling[landmark], *by_path), dim=-1)
        entry = torch.cat((equations.columns()[landmark], *entries), dim=-1)
        of_path = self._of_path(through, entry[:, None].expand_as(through), reduced)
        return spread @ by_landmark.mT + of_path

    def _of_path(
        self, through: Float[Tensor, "n m w"], entry: Int[Tensor, "n m w"], reduced: _Reduced
    ) -> Float[Tensor, "n m m"]:
        """The part that comes through the path: functions of its entries, the same ones in a row."""
        at, m = entry[:, 0], through.shape[1]
        reach = int((at.amax(1) - at.amin(1)).max()) if len(at) else 0
        inverse = BandInverse.of(reduced.path, reach)
        parts = [through.new_zeros(0, m, m)]
        for some in torch.arange(len(at), device=at.device).split(_LANDMARKS_AT_ONCE):
            own = inverse.read(at[some][:, :, None], at[some][:, None])
            parts.append(through[some] @ own @ through[some].mT)
        return torch.cat(parts)


@dataclass(frozen=True)
class _Reduced:
    """What is left of the damped matrix when its landmarks are eliminated."""

    inverse: Float[Tensor, "n k k"]
    """Of each landmark's own part."""
    path: BandFactor
    """What is left of the path."""
    log_determinant: Float[Tensor, ""]
    """Of the whole matrix."""


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
