"""What drives have to themselves or share, eliminated last: what their chains say of it, in the reduced system.

With F between the chains and the border, the last columns of C and S of `chain_schur` are the border's; its own part and
that beside the landmarks become

    G - F^T A^-1 F        E - B A^-1 F        g - F^T A^-1 a

where C has G and E. Chains touch each other through what stays alone, so one column of right-hand sides serves all of them.
The factor's tiles take the border as they take landmarks: one that no drive past a place has to do with has none there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.linearize import CHUNK_ROWS
from crowdmap_torch.optim.solvers.block_elimination import KeptLead
from crowdmap_torch.optim.solvers.elimination import ChainStructure
from crowdmap_torch.optim.solvers.normal_equations import BorderInformation, ChainChanges
from crowdmap_torch.optim.solvers.parts import Part
from crowdmap_torch.optim.solvers.sparse_tiles import TileMatrix
from crowdmap_torch.optim.solvers.tiled_cholesky import TiledCholesky
from crowdmap_torch.processes.amounts import at_once
from crowdmap_torch.processes.sums import add_at
from crowdmap_torch.processes.threads import in_order

_NUMBERS = 1 << 20
"""Numbers of right-hand sides that are solved for at once on a CPU."""
COLUMNS_AT_ONCE = 256
"""Functions of what stays that are solved for at once; bounds the memory."""
PartWeights = Callable[[int, Part], Tensor]
"""What the blocks of a part, by its number, count in sums over chains: [n, k, m], in their order, leaves first."""


@dataclass(frozen=True)
class Through:
    """What right-hand sides of a part's blocks are to what stays, by way of A^-1."""

    row: Int[Tensor, " r"]
    """Columns of the reduced system of the landmarks that the part is coupled to."""
    by_landmark: Float[Tensor, "r columns c"]
    """B x, those of one column added up, where x is A^-1 of them."""
    chain: Int[Tensor, " h"]
    """The part's chains."""
    by_chain: Float[Tensor, "h b c"]
    """F^T x, chain by chain."""
    own: Float[Tensor, "h c d"]
    """x^T times what else is asked for, chain by chain."""


@dataclass(frozen=True)
class ChainBorder:
    """The chains, once they are eliminated, and what binds them to what stays."""

    structure: ChainStructure
    coupling: Mapping[str, Float[Tensor, "f w _"]]
    """Blocks of B."""
    link: Float[Tensor, "e k b"]
    """Blocks of F."""
    leads: Sequence[Sequence[KeptLead]]
    """What the rounds of every part leave behind of A."""

    def add(self, system: TileMatrix, gradient: Float[Tensor, "e k"]) -> None:
        """Adds what chains say of the border to the reduced system and its right-hand side; `gradient` is a.

        Part by part: A^-1 F of all of them is larger than what is solved.
        """
        structure, pattern = self.structure, system.pattern
        if not structure.border.shape[1]:
            return
        forgotten = pattern.at(*torch.full((2, 1), pattern.dim + 1, device=gradient.device))

        def of_part(of: tuple[Part, Sequence[KeptLead]]) -> Through:
            part, leads = of
            chain, column = torch.unique(structure.owner[part.block], return_inverse=True)
            own = self.link[part.block], gradient[part.block][..., None]
            return self.through(part, leads, *own, column, len(chain))

        every = list(zip(structure.parts, self.leads, strict=True))
        for found in in_order(of_part, every, gradient.device, worth=1):
            entry = structure.border[found.chain]
            at = pattern.at(found.row[:, None, None], entry)
            # Not all that a part is coupled to has to do with all of its chains.
            at = torch.where(at < 0, forgotten, at)
            add_at(system.flat, 0, at.flatten(), found.by_landmark.flatten(), alpha=-1)
            at = pattern.at(entry[:, :, None], entry[:, None])
            add_at(system.flat, 0, at.flatten(), found.by_chain.flatten(), alpha=-1)
            add_at(system.right_side, 0, entry.flatten(), found.own.flatten(), alpha=-1)

    def through(
        self,
        part: Part,
        leads: Sequence[KeptLead],
        right_side: Float[Tensor, "n k c"],
        beside: Float[Tensor, "n k d"],
        column: Int[Tensor, " n"],
        columns: int,
    ) -> Through:
        """What A^-1 of right-hand sides of a part's blocks is to what stays.

        A few right-hand sides at a time: solved they are larger than all that is told of them. `column` is that of each
        of the part's blocks in the landmarks' sums; the products with what stands `beside` are summed up as well.
        """
        chain, of = torch.unique(self.structure.owner[part.block], return_inverse=True)
        most = at_once(_NUMBERS, of.device, each=len(of) * right_side.shape[1])
        row, found = self._coupled(part), []
        for some in right_side.split(most, dim=-1):
            x = part.solved(leads, some)
            by_landmark = self._couple(part, x, row, column, columns)
            found.append((by_landmark, *self._by_chain(part, x, of, len(chain), beside)))
        of_landmarks, of_chains, own = zip(*found, strict=True)
        by_landmark, by_chain = (torch.cat(parts, dim=-1) for parts in (of_landmarks, of_chains))
        return Through(row, by_landmark, chain, by_chain, torch.cat(own, dim=1))

    def _by_chain(
        self,
        part: Part,
        x: Float[Tensor, "places k c"],
        of: Int[Tensor, " n"],
        chains: int,
        beside: Float[Tensor, "n k d"],
    ) -> tuple[Float[Tensor, "h b c"], Float[Tensor, "h c d"]]:
        """F^T x of a part, and x^T times what stands `beside`, chain by chain."""
        c = x.shape[-1]
        by_chain = x.new_zeros(chains, self.link.shape[-1], c)
        own = x.new_zeros(chains, c, beside.shape[-1])
        lot = at_once(CHUNK_ROWS, of.device)
        for some in torch.arange(len(of), device=of.device).split(lot):
            of_some = x[part.place[some]]
            add_at(by_chain, 0, of[some], self.link[part.block[some]].mT @ of_some)
            add_at(own, 0, of[some], of_some.mT @ beside[some])
        return by_chain, own

    def _coupled(self, part: Part) -> Int[Tensor, " r"]:
        """The columns of the reduced system that a part is coupled to."""
        factors = self.structure.couplings.factors
        each = [factors[name].column[own].flatten() for name, own in part.factors.items()]
        return torch.unique(torch.cat([self.structure.owner.new_zeros(0), *each]))

    def _couple(
        self,
        part: Part,
        x: Float[Tensor, "places k c"],
        row: Int[Tensor, " r"],
        column: Int[Tensor, " n"],
        columns: int,
    ) -> Float[Tensor, "r columns c"]:
        """B x of a part, in the columns `row` of the reduced system."""
        structure = self.structure
        total = x.new_zeros(len(row) * columns, x.shape[-1])
        lot = at_once(CHUNK_ROWS, x.device)
        for name, own in part.factors.items():
            of_term = structure.couplings.factors[name]
            block, factors, at = self.coupling[name][own], of_term.block[own], of_term.column[own]
            for begin in range(0, len(at), lot):
                some = slice(begin, begin + lot)
                of = structure.number[factors[some]]
                entry = torch.searchsorted(row, at[some]) * columns + column[of][:, None]
                product = block[some] @ x[part.place[of], : block.shape[2]]
                add_at(total, 0, entry.flatten(), product.flatten(0, 1))
        return total.view(-1, columns, x.shape[-1])


@dataclass(frozen=True)
class WeightedSums:
    """Weighted sums over chains' blocks as functions of what stays, entry by entry."""

    row: Int[Tensor, " n"]
    """Column of the reduced system."""
    of: Int[Tensor, " n"]
    """Which sums."""
    value: Float[Tensor, "n m"]

    def functions(self, begin: int, end: int, dim: int) -> Float[Tensor, "dim sums m"]:
        """Those of the sums from `begin` to `end`."""
        here = torch.nonzero((self.of >= begin) & (self.of < end))[:, 0]
        total = self.value.new_zeros(dim * (end - begin), self.value.shape[1])
        at = self.row[here] * (end - begin) + self.of[here] - begin
        return add_at(total, 0, at, self.value[here]).view(dim, end - begin, -1)

    def variance(self, factor: TiledCholesky, count: int) -> Float[Tensor, "sums m m"]:
        """What they vary by as what stays does, by the factors of its system."""
        m, dim = self.value.shape[1], factor.upper.pattern.dim
        found, each = self.value.new_zeros(count, m, m), max(COLUMNS_AT_ONCE // max(m, 1), 1)
        for begin in range(0, count, each):
            end = min(begin + each, count)
            functions = self.functions(begin, end, dim).flatten(1)
            through = factor.whitened(functions).unflatten(1, (-1, m))
            found[begin:end] = torch.einsum("rjm,rjn->jmn", through, through)
        return found


Sums = tuple[Tensor, WeightedSums]
"""Covariance of sums over chains, what stays known [j, m, m], and how they go with what stays."""


def weighted_sums(
    chains: ChainBorder, weight: Float[Tensor, "n k m"], of: Int[Tensor, " chains"], count: int
) -> Sums:
    """Weighted sums over chains' blocks, leaves left out; `of` says of which of the sums each chain is."""
    leaves = chains.structure.plan.leaf_count

    def of_part(_: int, part: Part) -> Float[Tensor, "n k m"]:
        own = weight.new_zeros(len(part.block), *weight.shape[1:])
        own[part.leaf_count :] = weight[part.block[part.leaf_count :] - leaves]
        return own

    return _sums(chains, of_part, weight.shape[-1], of, count)


def sums_of_changes(chains: ChainBorder, changes: ChainChanges) -> Sums:
    """The changes along each drive as sums over its chains' blocks, column by column."""
    structure, (k, m) = chains.structure, changes.of.shape
    block = changes.pair + structure.plan.leaf_count
    part_of, number = structure.plan.part_of_blocks[block], structure.number[block]

    def of_part(own: int, part: Part) -> Float[Tensor, "n k c"]:
        weight = changes.of.new_zeros(len(part.block), k, changes.columns, m)
        for end, of in enumerate((-changes.of, changes.of)):
            here = torch.nonzero(part_of[:, end] == own)[:, 0]
            weight[number[here, end], :, changes.column[here]] += of
        return weight.flatten(2)

    return _sums(chains, of_part, changes.columns * m, changes.drive, changes.drives)


def _sums(
    chains: ChainBorder, weights: PartWeights, m: int, of: Int[Tensor, " chains"], count: int
) -> Sums:
    """Of `m` weighted sums each."""
    structure, link = chains.structure, chains.link
    own = link.new_zeros(count, m, m)
    every = list(enumerate(zip(structure.parts, chains.leads, strict=True)))

    def of_part(one: tuple[int, tuple[Part, Sequence[KeptLead]]]) -> tuple[Through, Tensor]:
        number, (part, leads) = one
        seen, column = torch.unique(of[structure.owner[part.block]], return_inverse=True)
        weight = weights(number, part)
        return chains.through(part, leads, weight, weight, column, len(seen)), seen

    row, of_sum, value = [], [], []
    for found, seen in in_order(of_part, every, link.device, worth=1):
        add_at(own, 0, of[found.chain], found.own)
        entry = structure.border[found.chain]
        for rows, columns, of_each in (
            (found.row[:, None], seen, found.by_landmark),
            (entry, of[found.chain, None], found.by_chain),
        ):
            rows, columns = torch.broadcast_tensors(rows, columns)
            row.append(rows.flatten())
            of_sum.append(columns.flatten())
            value.append(of_each.flatten(0, 1))
    none = torch.zeros(0, dtype=torch.long, device=link.device)
    return own, WeightedSums(
        torch.cat([none, *row]),
        torch.cat([none, *of_sum]),
        torch.cat([link.new_zeros(0, m), *value]),
    )


def border_information(
    structure: ChainStructure, reduced: TiledCholesky, added: Float[Tensor, " r"]
) -> BorderInformation:
    """That on the border of a reduced system, by its factors, to whose diagonal so much was `added`."""
    where, begin = structure.where, structure.border_begin
    upper = reduced.trailing(begin)
    matrix = upper.mT @ upper - torch.diag(added[begin:])
    entries = {name: where.entries(name, slice(None)) - begin for name in structure.plan.border}
    return BorderInformation(matrix, entries)
