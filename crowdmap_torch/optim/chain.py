"""The back end for chains: one variable's blocks are eliminated level by level, the rest is one small dense system.

Bundle adjustment of a map has frames by the ten thousand, each bound to the next, and landmarks by the hundred: what is
eliminated are the frames, the reverse of the usual habit. `chain_structure` says in which order; here is the
arithmetic.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.chain_structure import ChainStructure, Group, analyse
from crowdmap_torch.optim.linear import DIAGONAL_FLOOR, Step, outer, unpack
from crowdmap_torch.optim.linearize import CHUNK_ROWS, chunks, linearize, rows
from crowdmap_torch.optim.problem import Problem, Values


@dataclass
class ChainBackend:
    """Normal equations of one problem, the blocks of `eliminate` eliminated along their chains.

    The structure is worked out when a problem is first seen, and kept for problems whose terms touch the same blocks
    (the same index tensors): weights, constants and losses may change from step to step.
    """

    eliminate: str
    chain: Int[Tensor, " n"]
    """Chain of every block of the eliminated variable; the blocks of a chain are adjacent and in order."""
    leaves: str | None = None
    """Variable whose blocks are bound to one block of the chain each, and go first; None: there is none."""
    carrier: Int[Tensor, " m"] | None = None
    """Block of the chain that carries each leaf."""
    tile_size: int = 8
    """Interior blocks of a tile."""
    group_tiles: int = 128
    """Tiles that share one window of columns."""
    chunk_rows: int = CHUNK_ROWS
    _problem: Problem | None = field(default=None, repr=False)
    _structure: ChainStructure | None = field(default=None, repr=False)

    def assemble(self, problem: Problem, values: Values) -> ChainNormalEquations:
        """Normal equations at `values`; memory beyond them is bounded by the chunk."""
        if self._structure is None or not _same_rows(problem, self._problem):
            if problem.group_count != 1:
                raise ValueError("chains are eliminated in one problem at a time, not in a batch")
            self._structure = analyse(
                problem,
                values,
                self.eliminate,
                self.chain,
                leaves=self.leaves,
                carrier=self.carrier,
                tile_size=self.tile_size,
                group_tiles=self.group_tiles,
            )
            self._problem = problem
        return _assemble(problem, values, self._structure, self.chunk_rows)


def _same_rows(problem: Problem, other: Problem | None) -> bool:
    """Whether the terms of two problems touch the same blocks, by identity of their index tensors."""
    if other is None or list(problem.terms) != list(other.terms):
        return False
    return all(
        name == name_other and block is block_other
        for term, term_other in zip(problem.terms.values(), other.terms.values(), strict=True)
        for (name, block), (name_other, block_other) in zip(
            term.slots, term_other.slots, strict=False
        )
    )


@dataclass(frozen=True)
class _Eliminated:
    """What back-substitution needs of one group: its factor and the eliminated rows."""

    inverse_factor: Float[Tensor, "t d d"]
    boundary: Float[Tensor, "t d b"]
    """`L^-1 [left, right, window]`."""
    gradient: Float[Tensor, "t d"]


@dataclass(frozen=True)
class ChainNormalEquations:
    """The quadratic model, by blocks: chain diagonal and links, couplings, and the dense landmark part."""

    cost: Float[Tensor, " 1"]
    term_cost: Mapping[str, Float[Tensor, " 1"]]
    structure: ChainStructure
    diagonal: Float[Tensor, "n k k"]
    link: Float[Tensor, "n k k"]
    """Block of each node with its successor, of each leaf with the block that carries it."""
    chain_gradient: Float[Tensor, "n k"]
    coupling: Mapping[str, Float[Tensor, "f k l"]]
    hessian: Float[Tensor, "r r"]
    gradient: Float[Tensor, " r"]

    def solve(self, damping: Float[Tensor, " 1"]) -> Step:
        """The damped step: eliminate level by level, solve what is left, substitute back."""
        scale = damping[0]
        added_chain = scale * self.diagonal.diagonal(dim1=-2, dim2=-1).clamp_min(DIAGONAL_FLOOR)
        added = scale * self.hessian.diagonal().clamp_min(DIAGONAL_FLOOR)
        reduced = self._reduce(added_chain, added)
        if reduced is None:
            return self._failed()
        matrix, right_side, levels = reduced
        factor, failed = torch.linalg.cholesky_ex(matrix)
        if bool(failed):
            return self._failed()
        packed = -torch.cholesky_solve(right_side[:, None], factor)[:, 0]
        chain_step = self._substitute(packed, levels)
        along = (self.chain_gradient * chain_step).sum() + self.gradient @ packed
        damped = (added_chain * chain_step.square()).sum() + added @ packed.square()
        delta = unpack(packed[None], self.structure.where)
        delta.update(self._unstack(chain_step))
        norm = (chain_step.square().sum() + packed.square().sum()).sqrt()
        solved = norm.isfinite()
        return Step(delta, ((damped - along) / 2)[None], solved[None], norm[None])

    def marginal_covariance(self, *, floor: float = 1e-9) -> Float[Tensor, "r r"]:
        """Covariance of all variables but the eliminated one, jointly, the eliminated one marginalised."""
        nothing = torch.zeros_like(self.diagonal[..., 0])
        # The floor keeps a landmark that nothing observes invertible; its variance says so.
        reduced = self._reduce(nothing, torch.full_like(self.gradient, floor))
        if reduced is None:
            raise ValueError("the chain's blocks are not positive definite without damping")
        return torch.cholesky_inverse(torch.linalg.cholesky(reduced[0]))

    def _unstack(self, stacked: Tensor) -> dict[str, Tensor]:
        """Rows of the leaves and of the chain, by variable."""
        base = self.structure.base
        bounds = [*base.values(), len(stacked)]
        return {name: stacked[a:b] for name, a, b in zip(base, bounds, bounds[1:], strict=False)}

    def _failed(self) -> Step:
        delta = unpack(torch.zeros_like(self.gradient)[None], self.structure.where)
        delta.update(self._unstack(torch.zeros_like(self.chain_gradient)))
        zero = torch.zeros_like(self.cost)
        return Step(delta, zero, torch.zeros_like(zero, dtype=torch.bool), zero)

    def _reduce(
        self, added_chain: Tensor, added: Tensor
    ) -> tuple[Tensor, Tensor, list[list[_Eliminated]]] | None:
        """The Schur complement on the landmarks, its right-hand side, and the eliminated rows."""
        matrix = self.hessian + torch.diag(added)
        right_side = self.gradient.clone()
        diagonal = self.diagonal + torch.diag_embed(added_chain)
        link, gradient = self.link, self.chain_gradient
        fills: list[list[tuple[Tensor, Tensor]]] = []
        levels: list[list[_Eliminated]] = []
        for level in self.structure.levels:
            next_diagonal = diagonal[level.kept]
            next_link = link[level.kept] if level.keeps_links else torch.zeros_like(next_diagonal)
            next_gradient = gradient[level.kept]
            done, next_fills = [], []
            for group in level.groups:
                part = self._eliminate(group, diagonal, link, gradient, level.kept, fills)
                if part is None:
                    return None
                k = diagonal.shape[-1]
                both, window = part.boundary[..., : 2 * k], part.boundary[..., 2 * k :]
                rows = window.flatten(0, 1)
                matrix[group.columns[:, None], group.columns] -= rows.mT @ rows
                right_side[group.columns] -= rows.mT @ part.gradient.flatten()
                square = both.mT @ both
                shift = (both.mT @ part.gradient[..., None])[..., 0]
                cross = both.mT @ window
                for side, at in ((group.left, slice(0, k)), (group.right, slice(k, 2 * k))):
                    has = side >= 0
                    next_diagonal.index_add_(0, side[has], -square[has, at, at])
                    next_gradient.index_add_(0, side[has], -shift[has, at])
                has = (group.left >= 0) & (group.right >= 0)
                next_link[group.left[has]] = -square[has, :k, k:]
                next_fills.append((-cross[:, :k], -cross[:, k:]))
                done.append(part)
            levels.append(done)
            fills.append(next_fills)
            diagonal, link, gradient = next_diagonal, next_link, next_gradient
        return matrix, right_side, levels

    def _eliminate(
        self,
        group: Group,
        diagonal: Tensor,
        link: Tensor,
        gradient: Tensor,
        kept: Tensor,
        fills: list[list[tuple[Tensor, Tensor]]],
    ) -> _Eliminated | None:
        tiles, slots = group.node.shape
        k, width = diagonal.shape[-1], len(group.columns)
        present = group.node >= 0
        node = group.node.clamp_min(0)
        eye = torch.eye(k, dtype=diagonal.dtype, device=diagonal.device)
        blocks = diagonal.new_zeros(tiles, slots, k, slots, k)
        steps = torch.arange(slots, device=node.device)
        blocks[:, steps, :, steps] = torch.where(
            present[..., None, None], diagonal[node], eye
        ).transpose(0, 1)
        if slots > 1:
            both = (present[:, :-1] & present[:, 1:])[..., None, None]
            inner = torch.where(both, link[node[:, :-1]], 0.0).transpose(0, 1)
            blocks[:, steps[:-1], :, steps[1:]] = inner
            blocks[:, steps[1:], :, steps[:-1]] = inner.mT
        boundary = diagonal.new_zeros(tiles, slots, k, 2 * k + width)
        has = torch.nonzero(group.left >= 0)[:, 0]
        boundary[has, 0, :, :k] = link[kept[group.left[has]]].mT
        has = torch.nonzero(group.right >= 0)[:, 0]
        boundary[has, slots - 1, :, k : 2 * k] = link[node[has, slots - 1]]
        _scatter(boundary, group, self.coupling, fills)
        factor, failed = torch.linalg.cholesky_ex(blocks.reshape(tiles, slots * k, slots * k))
        if bool((failed != 0).any()):
            return None
        unit = torch.eye(slots * k, dtype=factor.dtype, device=factor.device).expand_as(factor)
        inverse = torch.linalg.solve_triangular(factor, unit, upper=False)
        right_side = torch.where(present[..., None], gradient[node], 0.0).reshape(tiles, -1, 1)
        return _Eliminated(
            inverse,
            inverse @ boundary.reshape(tiles, slots * k, -1),
            (inverse @ right_side)[..., 0],
        )

    def _substitute(self, packed: Tensor, levels: list[list[_Eliminated]]) -> Tensor:
        """Steps of the eliminated blocks, from the last level to the first."""
        k = self.diagonal.shape[-1]
        below = packed.new_zeros(0, k)
        for level, parts in zip(reversed(self.structure.levels), reversed(levels), strict=True):
            here = packed.new_zeros(len(level.block_of_node), k)
            here[level.kept] = below
            padded = torch.cat((below, below.new_zeros(1, k)))
            for group, part in zip(level.groups, parts, strict=True):
                tiles, slots = group.node.shape
                window = packed[group.columns].expand(tiles, -1)
                known = torch.cat((padded[group.left], padded[group.right], window), dim=-1)
                rest = part.gradient + (part.boundary @ known[..., None])[..., 0]
                solved = -(part.inverse_factor.mT @ rest[..., None])[..., 0]
                present = group.node >= 0
                here[group.node[present]] = solved.reshape(tiles, slots, k)[present]
            below = here
        return below


def _scatter(
    boundary: Float[Tensor, "t s k b"],
    group: Group,
    coupling: Mapping[str, Tensor],
    fills: list[list[tuple[Tensor, Tensor]]],
) -> None:
    """Adds a group's factors and the fill-in from below into its window, in place."""
    _, _, k, width = boundary.shape
    flat = boundary.view(-1)
    entries = torch.arange(k, device=boundary.device)[:, None] * width + 2 * k
    for part in group.factors:
        at = part.row[:, None, None] * (k * width) + entries + part.position[:, None, :]
        flat.index_add_(0, at.flatten(), coupling[part.coupling][part.factor].flatten())
    for part in group.fills:
        at = part.row[:, None, None] * (k * width) + entries + part.position
        flat.index_add_(
            0, at.flatten(), fills[part.level][part.group][int(part.right)][part.tile].flatten()
        )


def _assemble(
    problem: Problem, values: Values, structure: ChainStructure, chunk_rows: int
) -> ChainNormalEquations:
    base = structure.base
    n, blocks = len(structure.chain), values[next(iter(base))]
    k = problem.variables[next(iter(base))].tangent_dim
    dim = structure.where.dim
    diagonal = blocks.new_zeros(n, k, k)
    link = blocks.new_zeros(n, k, k)
    chain_gradient = blocks.new_zeros(n, k)
    hessian = blocks.new_zeros(dim, dim)
    gradient = blocks.new_zeros(dim)
    term_cost, couplings = {}, {}
    kinds = dict(problem.variables)

    for name in structure.chain_terms:
        cost = blocks.new_zeros(1)
        for _, piece in chunks(problem.terms[name], chunk_rows):
            linear = linearize(piece, kinds, values)
            cost += linear.rho.sum() / 2
            weighted = [J * linear.robust_weight[:, None, None] for J in linear.jacobians]
            index = [block + base[slot] for slot, block in piece.slots]
            for block, J, JW in zip(index, linear.jacobians, weighted, strict=True):
                diagonal.index_add_(0, block, outer(JW, J))
                chain_gradient.index_add_(0, block, (JW * linear.residual[..., None]).sum(1))
            if len(index) == 2:
                _add_link(
                    link, structure, index[0], index[1], outer(weighted[0], linear.jacobians[1])
                )
        term_cost[name] = cost

    for name, coupling in structure.couplings.items():
        cost = blocks.new_zeros(1)
        width = coupling.column.shape[1]
        mixed = blocks.new_zeros(len(coupling.block), k, width)
        square = blocks.new_zeros(len(coupling.block), width, width)
        for piece, term in chunks(rows(problem.terms[name], coupling.order), chunk_rows):
            linear = linearize(term, kinds, values)
            cost += linear.rho.sum() / 2
            slot = coupling.eliminated_slot
            own = linear.jacobians[slot] * linear.robust_weight[:, None, None]
            others = [J for i, J in enumerate(linear.jacobians) if i != slot]
            J = torch.cat(others, dim=-1)
            block = term.slots[slot][1] + base[term.slots[slot][0]]
            factor = coupling.factor_of_row[piece]
            diagonal.index_add_(0, block, outer(own, linear.jacobians[slot]))
            chain_gradient.index_add_(0, block, (own * linear.residual[..., None]).sum(1))
            mixed.index_add_(0, factor, outer(own, J))
            weighted = J * linear.robust_weight[:, None, None]
            gradient.index_add_(
                0,
                coupling.column[factor].flatten(),
                (weighted * linear.residual[..., None]).sum(1).flatten(),
            )
            square.index_add_(0, factor, outer(weighted, J))
        at = coupling.column[:, :, None] * dim + coupling.column[:, None, :]
        hessian.view(-1).index_add_(0, at.flatten(), square.flatten())
        couplings[name] = mixed
        term_cost[name] = cost

    for name in structure.landmark_terms:
        cost = blocks.new_zeros(1)
        for _, term in chunks(problem.terms[name], chunk_rows):
            linear = linearize(term, kinds, values)
            cost += linear.rho.sum() / 2
            J = torch.cat(linear.jacobians, dim=-1)
            column = torch.cat(
                [
                    structure.where.offset[slot][block][:, None]
                    + torch.arange(problem.variables[slot].tangent_dim, device=block.device)
                    for slot, block in term.slots
                ],
                dim=-1,
            )
            weighted = J * linear.robust_weight[:, None, None]
            gradient.index_add_(
                0, column.flatten(), (weighted * linear.residual[..., None]).sum(1).flatten()
            )
            at = column[:, :, None] * dim + column[:, None, :]
            hessian.view(-1).index_add_(0, at.flatten(), outer(weighted, J).flatten())
        term_cost[name] = cost

    total = torch.stack([term_cost[name] for name in problem.terms]).sum(0)
    ordered = {name: term_cost[name] for name in problem.terms}
    return ChainNormalEquations(
        total, ordered, structure, diagonal, link, chain_gradient, couplings, hessian, gradient
    )


def _add_link(
    link: Tensor,
    structure: ChainStructure,
    first: Int[Tensor, " m"],
    second: Int[Tensor, " m"],
    block: Float[Tensor, "m k k"],
) -> None:
    """Adds the blocks between two eliminated blocks, whichever the row names first, in place."""
    low, high = torch.minimum(first, second), torch.maximum(first, second)
    chain = structure.chain
    leaves = len(structure.carrier)
    neighbours = (high == low + 1) & (chain[low] == chain[high]) & (low >= leaves)
    carried = torch.zeros_like(neighbours)
    of_leaf = (low < leaves) & (high >= leaves)
    carried[of_leaf] = structure.carrier[low[of_leaf]] == high[of_leaf] - leaves
    if not bool((neighbours | carried).all()):
        raise ValueError(
            "a term links two eliminated blocks that are neither neighbours in their chain "
            "nor a leaf and the block that carries it"
        )
    link.index_add_(0, low, torch.where((first < second)[:, None, None], block, block.mT))
