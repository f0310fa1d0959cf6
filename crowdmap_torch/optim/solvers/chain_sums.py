"""Where the blocks of rows go in the normal equations of chains: the sums A, B, C and F of `chain_schur`."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import accumulate, pairwise

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.optim.problem import Problem, Values
from crowdmap_torch.optim.solvers.assembly import BlockDiagonal, TermRows, pairs
from crowdmap_torch.optim.solvers.couplings import TermFactors
from crowdmap_torch.optim.solvers.elimination import ChainStructure, padded
from crowdmap_torch.optim.solvers.staying_blocks import Between, StayingBlocks
from crowdmap_torch.processes.sums import add_at, lasting


class ChainSums:
    """The blocks of leaves and chains, between these and the border, and every variable's diagonal."""

    def __init__(self, structure: ChainStructure, problem: Problem, values: Values) -> None:
        plan = structure.plan
        like, k = values[plan.chains], problem.variables[plan.chains].tangent_dim
        self.structure, self._k = structure, k
        self.by_variable = BlockDiagonal(problem, values)
        self.link = like.new_zeros(len(structure.owner), k, k)
        """Block of A of each chain's block with its successor, of each leaf with the block that carries it."""
        widths = [problem.variables[name].tangent_dim for name in plan.border]
        self.border_link = like.new_zeros(len(structure.owner), k, sum(widths))
        """Block of each with its chain's blocks of the border's variables, one behind the other."""
        ends = list(accumulate(widths, initial=0))
        self.border = {
            name: self.border_link[..., begin:end]
            for name, (begin, end) in zip(plan.border, pairwise(ends), strict=True)
        }
        """The same by variable."""

    def add(self, chunk: TermRows) -> None:
        """Adds a chunk of rows."""
        self.by_variable.add(chunk)
        first = self.structure.plan.first_block
        for i, j in pairs(len(chunk.slots)):
            (name, block), (other, block_of_other) = chunk.slots[i], chunk.slots[j]
            if name in first and other in first:
                begins = first[name], first[other]
                square = padded(chunk.blocks.hessian[i, j].permute(2, 0, 1), 1, self._k)
                self._add_link(block, block_of_other, begins, padded(square, 2, self._k))
            elif name in first and other in self.border:
                beside = padded(chunk.blocks.hessian[i, j].permute(2, 0, 1), 1, self._k)
                add_at(self.border[other], 0, block + first[name], beside)
            elif name in self.border and other in first:
                beside = padded(chunk.blocks.hessian[i, j].permute(2, 1, 0), 1, self._k)
                add_at(self.border[name], 0, block_of_other + first[other], beside)

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
        self,
        here: Int[Tensor, " m"],
        there: Int[Tensor, " m"],
        begins: tuple[int, int],
        block: Float[Tensor, "m k k"],
    ) -> None:
        """Adds blocks between eliminated ones of two variables, which begin there among all that are eliminated."""

        def linked() -> tuple[Int[Tensor, " m"], Bool[Tensor, " m"], bool]:
            return self._linked(here + begins[0], there + begins[1])

        low, ahead, in_order = lasting(("linked", *begins), linked, here, there)
        if not in_order:
            block = torch.where(ahead[:, None, None], block, block.mT)
        add_at(self.link, 0, low, block)

    def _linked(
        self, here: Int[Tensor, " m"], there: Int[Tensor, " m"]
    ) -> tuple[Int[Tensor, " m"], Bool[Tensor, " m"], bool]:
        """The first of each two, whether that is `here`, and whether it always is; ValueError for what cannot be linked."""
        low, high = torch.minimum(here, there), torch.maximum(here, there)
        plan, owner = self.structure.plan, self.structure.owner
        leaves = plan.leaf_count
        linked = (high == low + 1) & (owner[low] == owner[high]) & (low >= leaves)
        if plan.carrier is not None:
            of_leaf = (low < leaves) & (high >= leaves)
            linked[of_leaf] = plan.carrier[low[of_leaf]] == high[of_leaf] - leaves
        ahead = here < there
        is_linked, in_order = torch.stack((linked.all(), ahead.all())).tolist()
        if not is_linked:
            raise ValueError(
                "a term links two eliminated blocks that are neither neighbours in their chain "
                "nor a leaf and the block that carries it"
            )
        return low, ahead, in_order


class ReducibleSums(ChainSums):
    """The same with the matrix C of landmarks and border and, term by term, the landmarks' coupling B."""

    def __init__(
        self,
        structure: ChainStructure,
        problem: Problem,
        values: Values,
        coupling: Mapping[str, Float[Tensor, "f w _"]],
    ) -> None:
        """`coupling` is memory for B, by term, as wide as its eliminated block; what is in it is of no account."""
        super().__init__(structure, problem, values)
        self.coupling = coupling
        self._between: list[Between] = []
        self._lots: dict[tuple[str, int, int], Tensor] = {}
        """By term and two of its slots that stay, their blocks by lot."""
        for blocks in coupling.values():
            blocks.zero_()

    def add(self, chunk: TermRows) -> None:
        """Adds a chunk of rows."""
        super().add(chunk)
        first = self.structure.plan.first_block
        term = self.structure.couplings.terms.get(chunk.term)
        for i, j in pairs(len(chunk.slots)):
            one, other = chunk.slots[i], chunk.slots[j]
            square = chunk.blocks.hessian[i, j]
            if one[0] in first or other[0] in first:
                continue
            if term is None:
                self._add_between(one, other, square)
                continue
            # Many frames see the same stretch of a lane.
            key = chunk.term, i, j
            if key not in self._lots:
                size = (*square.shape[:2], len(term.slots[0][1]))
                self._lots[key] = square.new_zeros(size)
            into = self._lots[key].flatten(0, 1)
            add_at(into, 1, term.lot[chunk.at], square.flatten(0, 1))
        if term is not None:
            into = self.coupling[term.coupling]
            _add_coupling(into, term, chunk, self.structure.landmarks.first)

    def _add_between(
        self,
        one: tuple[str, Int[Tensor, " m"]],
        other: tuple[str, Int[Tensor, " m"]],
        square: Float[Tensor, "k l m"],
    ) -> None:
        """Adds the blocks between two variables that stay."""
        where, (name, block), (name_of_other, block_of_other) = self.structure.where, one, other
        row, column = where.offset[name][block], where.offset[name_of_other][block_of_other]
        self._between.append(Between(row, column, square).joined(where.dim))

    def add_lots(self) -> None:
        """Adds what was summed by lot, once all rows are there."""
        for (name, i, j), square in self._lots.items():
            slots = self.structure.couplings.terms[name].slots
            self._add_between(slots[i], slots[j], square)
        self._lots = {}

    def hessian_of_stays(self) -> StayingBlocks:
        """The matrix C."""
        where = self.structure.where
        own = {name: self.by_variable.hessian(name) for name in where.offset}
        return StayingBlocks(where, own, tuple(self._between))

    def gradient_of_stays(self) -> Float[Tensor, " r"]:
        """The gradient b."""
        names = (*self.structure.plan.first_block, *self.structure.where.offset)
        return self.structure.where.pack({n: self.by_variable.gradient(n) for n in names})[0]


def _add_coupling(
    total: Float[Tensor, "f w _"], term: TermFactors, chunk: TermRows, landmarks: Collection[str]
) -> None:
    """Adds the blocks between the rows' eliminated slot and those of landmarks, in place."""
    slot, start = term.slot, 0
    for other, (name, _) in enumerate(chunk.slots):
        if name not in landmarks:
            continue
        block = chunk.blocks.hessian[min(slot, other), max(slot, other)]
        block = block.permute(2, 1, 0) if slot < other else block.permute(2, 0, 1)
        here = slice(start, start + block.shape[1])
        start = here.stop
        total[chunk.at, here] += block
