"""Where the blocks of rows go in the normal equations of chains: the sums A, B, C of `elimination`, and the border's."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.linearize import RowBlocks
from crowdmap_torch.optim.problem import Problem, Values
from crowdmap_torch.optim.solvers.assembly import BlockDiagonal, TermRows, add_blocks, pairs
from crowdmap_torch.optim.solvers.elimination import ChainStructure, Coupling, padded
from crowdmap_torch.optim.solvers.sparse_tiles import TileMatrix


class ChainSums:
    """The blocks of leaves and chains, between these and the border, and every variable's diagonal."""

    def __init__(self, structure: ChainStructure, problem: Problem, values: Values) -> None:
        plan = structure.plan
        like, k = values[plan.chains], problem.variables[plan.chains].tangent_dim
        self.structure, self._k = structure, k
        self.by_variable = BlockDiagonal(problem, values)
        self.link = like.new_zeros(len(structure.owner), k, k)
        """Block of A of each chain's block with its successor, of each leaf with the block that carries it."""
        self.border = {
            name: like.new_zeros(len(structure.owner), k, problem.variables[name].tangent_dim)
            for name in plan.border
        }
        """Block of each with its chain's block of every variable of the border."""

    def add(self, chunk: TermRows[RowBlocks]) -> None:
        """Adds a chunk of rows."""
        self.by_variable.add(chunk)
        first = self.structure.plan.first_block
        for i, j in pairs(len(chunk.slots)):
            (name, block), (other, block_of_other) = chunk.slots[i], chunk.slots[j]
            if name in first and other in first:
                here, there = block + first[name], block_of_other + first[other]
                square = padded(chunk.blocks.hessian[i, j].permute(2, 0, 1), 1, self._k)
                self._add_link(here, there, padded(square, 2, self._k))
            elif name in first and other in self.border:
                beside = padded(chunk.blocks.hessian[i, j].permute(2, 0, 1), 1, self._k)
                self.border[other].index_add_(0, block + first[name], beside)
            elif name in self.border and other in first:
                beside = padded(chunk.blocks.hessian[i, j].permute(2, 1, 0), 1, self._k)
                self.border[name].index_add_(0, block_of_other + first[other], beside)

    def diagonal(self) -> Float[Tensor, "e k k"]:
        """Diagonal blocks of A, counted over leaves and chains."""
        parts = []
        for name in self.structure.plan.first_block:
            square = self.by_variable.hessian(name)
            width = square.shape[1]
            square = padded(padded(square, 1, self._k), 2, self._k)
            # What is padded stands for itself.
            square.diagonal(dim1=1, dim2=2)[:, width:] = 1
            parts.append(square)
        return parts[0] if len(parts) == 1 else torch.cat(parts)

    def gradient(self) -> Float[Tensor, "e k"]:
        """The gradient a, likewise."""
        names = self.structure.plan.first_block
        return self.structure.stack({name: self.by_variable.gradient(name) for name in names})

    def _add_link(
        self, here: Int[Tensor, " m"], there: Int[Tensor, " m"], block: Float[Tensor, "m k k"]
    ) -> None:
        low, high = torch.minimum(here, there), torch.maximum(here, there)
        plan, owner = self.structure.plan, self.structure.owner
        leaves = plan.leaf_count
        linked = (high == low + 1) & (owner[low] == owner[high]) & (low >= leaves)
        if plan.carrier is not None:
            of_leaf = (low < leaves) & (high >= leaves)
            linked[of_leaf] = plan.carrier[low[of_leaf]] == high[of_leaf] - leaves
        if not bool(linked.all()):
            raise ValueError(
                "a term links two eliminated blocks that are neither neighbours in their chain "
                "nor a leaf and the block that carries it"
            )
        self.link.index_add_(0, low, torch.where((here < there)[:, None, None], block, block.mT))


class ReducibleSums(ChainSums):
    """The same with the landmarks' matrix C and, term by term, their coupling B."""

    def __init__(
        self,
        structure: ChainStructure,
        problem: Problem,
        values: Values,
        coupling: Mapping[str, Float[Tensor, "f w _"]],
    ) -> None:
        """`coupling` is memory for B, by term, as wide as its eliminated block; what is in it is of no account."""
        super().__init__(structure, problem, values)
        dim, like = structure.where.dim, values[structure.plan.chains]
        self.coupling = coupling
        self._matrix = TileMatrix.zeros(structure.direct, like)
        self.beside = like.new_zeros(dim, structure.border.dim)
        """Blocks between landmarks and the border."""
        self._among = like.new_zeros(structure.border.dim, structure.border.dim)
        for name, blocks in coupling.items():
            if structure.couplings[name].factor_of_row is not None:
                blocks.zero_()

    def add(self, chunk: TermRows[RowBlocks]) -> None:
        """Adds a chunk of rows."""
        super().add(chunk)
        where, border = self.structure.where, self.structure.border
        for i, j in pairs(len(chunk.slots)):
            (name, block), (other, block_of_other) = chunk.slots[i], chunk.slots[j]
            square = chunk.blocks.hessian[i, j]
            if name in where.offset and other in where.offset:
                row, column = where.offset[name][block], where.offset[other][block_of_other]
                self._matrix.add(row, column, square)
                self._matrix.add(column, row, square.transpose(0, 1))
            elif name in where.offset and other in border.offset:
                row, column = where.offset[name][block], border.offset[other][block_of_other]
                add_blocks(self.beside.view(-1), row, column, border.dim, square)
            elif name in border.offset and other in where.offset:
                row, column = where.offset[other][block_of_other], border.offset[name][block]
                square = square.transpose(0, 1)
                add_blocks(self.beside.view(-1), row, column, border.dim, square)
            elif name in border.offset and other in border.offset:
                row, column = border.offset[name][block], border.offset[other][block_of_other]
                add_blocks(self._among.view(-1), row, column, border.dim, square)
                add_blocks(self._among.view(-1), column, row, border.dim, square.transpose(0, 1))
        if chunk.term in self.coupling:
            coupling = self.structure.couplings[chunk.term]
            _add_coupling(self.coupling[chunk.term], coupling, chunk, set(border.offset))

    def landmark_hessian(self) -> TileMatrix:
        """The matrix C."""
        where = self.structure.where
        for name, offset in where.offset.items():
            square = self.by_variable.hessian(name).permute(1, 2, 0)
            self._matrix.add(offset, offset, square)
        return self._matrix

    def border_hessian(self) -> Float[Tensor, "z z"]:
        """The matrix of the border, its variables behind each other."""
        border = self.structure.border
        for name, offset in border.offset.items():
            square = self.by_variable.hessian(name).permute(1, 2, 0)
            add_blocks(self._among.view(-1), offset, offset, border.dim, square)
        return self._among

    def border_gradient(self) -> Float[Tensor, " z"]:
        """The gradient by the border."""
        border = self.structure.border
        return border.pack({n: self.by_variable.gradient(n) for n in border.offset})[0]

    def landmark_gradient(self) -> Float[Tensor, " r"]:
        """The gradient b."""
        names = (*self.structure.plan.first_block, *self.structure.where.offset)
        return self.structure.where.pack({n: self.by_variable.gradient(n) for n in names})[0]


def _add_coupling(
    total: Float[Tensor, "f w _"], coupling: Coupling, chunk: TermRows[RowBlocks], border: set[str]
) -> None:
    """Adds the blocks between the rows' eliminated slot and those of landmarks, in place."""
    slot, start = coupling.slot, 0
    for other in range(len(chunk.slots)):
        if other == slot or chunk.slots[other][0] in border:
            continue
        block = chunk.blocks.hessian[min(slot, other), max(slot, other)]
        block = block.permute(2, 1, 0) if slot < other else block.permute(2, 0, 1)
        here = slice(start, start + block.shape[1])
        start = here.stop
        if coupling.factor_of_row is None:
            total[chunk.at, here] = block
        else:
            total[:, here].index_add_(0, coupling.factor_of_row[chunk.at], block)
