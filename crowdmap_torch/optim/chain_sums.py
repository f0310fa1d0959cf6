"""Blocks of the rows of a problem summed for the chain's normal equations: gradients, diagonals, links, couplings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.chain_structure import ChainStructure, Coupling
from crowdmap_torch.optim.linearize import RowBlocks, RowGradients
from crowdmap_torch.optim.parallel import in_order
from crowdmap_torch.optim.problem import CostTerm, Problem, Values, Variable

_Blocks = TypeVar("_Blocks", bound=RowGradients)


def same_rows(problem: Problem, other: Problem | None) -> bool:
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


def computed(
    function: Callable[[CostTerm, dict[str, Variable], Values], _Blocks],
    term: CostTerm,
    pieces: list[CostTerm],
    kinds: dict[str, Variable],
    values: Values,
) -> Iterator[_Blocks]:
    """`function` of every piece of a term, in order, on all cores where the term brings its own blocks."""
    device = term.slots[0][1].device
    if term.normal is None:
        # Forward-mode autograd is of one thread at a time.
        return map(lambda piece: function(piece, kinds, values), pieces)
    return in_order(lambda piece: function(piece, kinds, values), pieces, device)


def add_mixed(mixed: Tensor, coupling: Coupling, at: slice, part: RowBlocks) -> None:
    """Adds the blocks between the eliminated slot and the others, [f, l, k], in place."""
    slot, start = coupling.slot, 0
    for other in range(len(part.gradient)):
        if other == slot:
            continue
        cross = part.hessian[min(slot, other), max(slot, other)]
        cross = cross.permute(2, 1, 0) if slot < other else cross.permute(2, 0, 1)
        here = slice(start, start + cross.shape[1])
        start = here.stop
        if coupling.factor_of_row is None:
            mixed[at, here] = cross
        else:
            mixed[:, here].index_add_(0, coupling.factor_of_row[at], cross)


class BlockSums:
    """Gradient and Hessian, summed by block, rows last, before the landmarks' go into one matrix."""

    def __init__(
        self, structure: ChainStructure, chain_gradient: Tensor, *, hessian: Tensor | None
    ) -> None:
        where = structure.where
        self.base, self.offset, self.dim = structure.base, where.offset, where.dim
        like = chain_gradient
        self.chain_gradient = torch.zeros_like(like.mT, memory_format=torch.contiguous_format)
        self.diagonal = hessian
        sizes = {name: (where.tangent_dim[name], len(at)) for name, at in self.offset.items()}
        self.gradients = {name: like.new_zeros(k, n) for name, (k, n) in sizes.items()}
        if hessian is not None:
            self.squares = {name: like.new_zeros(k * k, n) for name, (k, n) in sizes.items()}
            self.matrix = like.new_zeros(self.dim, self.dim)

    def add_gradient(self, piece: CostTerm, part: RowGradients) -> None:
        """Adds the rows' gradients."""
        for (name, index), gradient in zip(piece.slots, part.gradient, strict=True):
            if name in self.base:
                self.chain_gradient.index_add_(1, index + self.base[name], gradient)
            else:
                self.gradients[name].index_add_(1, index, gradient)

    def add_hessian(self, piece: CostTerm, part: RowBlocks) -> None:
        """Adds the rows' blocks but those with one or two eliminated slots."""
        assert self.diagonal is not None
        stays = []
        for i, (name, index) in enumerate(piece.slots):
            square = part.hessian[i, i].flatten(0, 1)
            if name in self.base:
                self.diagonal.index_add_(1, index + self.base[name], square)
                continue
            self.squares[name].index_add_(1, index, square)
            for j in stays:
                other, index_j = piece.slots[j]
                at, at_j = self.offset[name][index], self.offset[other][index_j]
                self._scatter(at_j, at, part.hessian[j, i])
                self._scatter(at, at_j, part.hessian[j, i].transpose(0, 1))
            stays.append(i)

    def hessian(self) -> Tensor:
        """The landmarks' Hessian [dim, dim]."""
        for name, square in self.squares.items():
            k = len(self.gradients[name])
            self._scatter(self.offset[name], self.offset[name], square.view(k, k, -1))
        return self.matrix

    def gradient(self) -> Tensor:
        """The landmarks' gradient [dim]."""
        packed = self.chain_gradient.new_zeros(self.dim)
        for name, gradient in self.gradients.items():
            at = self.offset[name] + torch.arange(len(gradient), device=packed.device)[:, None]
            packed[at] = gradient
        return packed

    def _scatter(self, row: Tensor, column: Tensor, block: Tensor) -> None:
        rows, columns, _ = block.shape
        steps = torch.arange(max(rows, columns), device=row.device)[:, None]
        at = (row + steps[:rows])[:, None] * self.dim + (column + steps[:columns])
        self.matrix.view(-1).index_add_(0, at.flatten(), block.flatten())


def add_link(
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
