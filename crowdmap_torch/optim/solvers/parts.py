"""Chains that see the same roads, and the order in which their blocks are eliminated: odd-even reduction.

Each chain's block may carry leaves, blocks of a second variable that are bound to it alone: leaves go first. Then every
other block of each chain is eliminated, all chains at once; those between are the chain of the next round, half as long,
until no block is left (cyclic or nested reduction; Golub and Van Loan, Matrix Computations, 4.5.4).

Chains that see other roads have little in common. They are eliminated one part after the other, so that memory is that of
the largest part, and each leaves what it knows of its landmarks: the sum over parts is the reduced system. Large parts are
cut into pieces, which two cores eliminate beside each other where that is little memory (`ChainStructure.lanes`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.solvers.block_elimination import KeptLead, leads_of, solve_rounds
from crowdmap_torch.optim.solvers.couplings import Coupling
from crowdmap_torch.optim.solvers.dissection import incidence
from crowdmap_torch.optim.solvers.plan import EliminationPlan
from crowdmap_torch.optim.solvers.sparse_tiles import TilePattern
from crowdmap_torch.optim.solvers.windows import Round, WindowBuilder
from crowdmap_torch.processes.sums import add_at

_IN_COMMON = 0.5
"""Share of a chain's landmarks that it has in common with the first of a part, at least."""
_LEAST_BLOCKS = 4096
"""Blocks of chains up to which parts are put together: small ones are all overhead."""
_PIECE = 1 << 14
"""Blocks that each piece of a part is to have, at least."""


@dataclass(frozen=True)
class Part:
    """Chains that are eliminated together."""

    block: Int[Tensor, " n"]
    """Their blocks, counted over all leaves and chains, the leaves first."""
    leaf_count: int
    """How many of them are leaves."""
    rounds: tuple[Round, ...]
    place: Int[Tensor, " n"]
    """Place of every block in the order of elimination."""
    at_place: Int[Tensor, " places"]
    """The block at every place, counted over all; anyone where there is none."""
    empty: Int[Tensor, " _"]
    """The places without a block, the last of all among them."""
    right_side_row: Int[Tensor, " n"]
    """Row of the store of every block's right-hand side."""
    store_rows: int
    """Rows of the store; one more takes what is to be forgotten."""
    factors: Mapping[str, slice]
    """By term, the factors of its coupling that are the part's."""
    factor_rows: Mapping[str, Int[Tensor, " fw"]]
    """Row of the store of every column of them."""
    alone: frozenset[str]
    """Terms of whose factors none has a row of the store in common with another's, and that come first."""
    windows: WindowBuilder = field(repr=False)

    def by_place(
        self,
        diagonal: Float[Tensor, "e k k"],
        link: Float[Tensor, "e k k"],
        added: Float[Tensor, "e k"] | None = None,
    ) -> tuple[Float[Tensor, "p k k"], Float[Tensor, "p k k"]]:
        """Diagonal blocks and links of A at the places of the order, with what is `added` to the diagonal.

        A place without a block has no links, and a diagonal that does no harm.
        """
        here, links = diagonal[self.at_place], link[self.at_place]
        if added is not None:
            here.diagonal(dim1=-2, dim2=-1).add_(added[self.at_place])
        here[self.empty] = torch.eye(here.shape[-1], dtype=here.dtype, device=here.device)
        links[self.empty] = 0
        return here, links

    def leads(
        self, diagonal: Float[Tensor, "e k k"], link: Float[Tensor, "e k k"]
    ) -> tuple[KeptLead, ...]:
        """What all rounds leave behind of A alone."""
        return leads_of(self.rounds, *self.by_place(diagonal, link))

    def solve(
        self, leads: Sequence[KeptLead], right_side: Float[Tensor, "n k c"]
    ) -> Float[Tensor, "n k c"]:
        """A^-1 of right-hand sides of the part's blocks."""
        return self.solved(leads, right_side)[self.place]

    def solved(
        self, leads: Sequence[KeptLead], right_side: Float[Tensor, "n k c"]
    ) -> Float[Tensor, "places k c"]:
        """The same by place."""
        rest = right_side.new_zeros(len(self.at_place), *right_side.shape[1:])
        rest[self.place] = right_side
        return solve_rounds(self.rounds, leads, rest)

    def with_couplings(
        self,
        couplings: Mapping[str, Coupling],
        factors: Mapping[str, slice],
        number: Int[Tensor, " e"],
    ) -> Part:
        """The same order for the rows of other couplings, of which these `factors` are its own.

        `number` has every block's number in its part.
        """
        rows = {
            name: self.windows.rows(
                number[couplings[name].block[own]],
                couplings[name].landmark[own],
                couplings[name].widths,
            )
            for name, own in factors.items()
        }
        alone = _alone(rows, self.store_rows)
        return replace(self, factors=factors, factor_rows=rows, alone=alone)


class PartBuilder:
    """Finds the order of a part: first its windows, and once those of all parts are known the part."""

    def __init__(
        self,
        plan: EliminationPlan,
        block: Int[Tensor, " n"],
        number: Int[Tensor, " e"],
        keys: Int[Tensor, " keys"],
        windows: WindowBuilder,
    ) -> None:
        """`number` has every block's number in its part; `keys` are those of the part's blocks."""
        count, leaves = windows.landmarks.count, plan.leaf_count
        self._block, self.windows = block, windows
        self._leaf_count = int((block < leaves).sum())
        chain = plan.chain[block[self._leaf_count :] - leaves]
        carrier = None
        if plan.carrier is not None:
            carrier = number[plan.carrier[block[: self._leaf_count]] + leaves]
        own = number[keys // count] * count + keys % count
        self._rounds = [windows.windows(*of) for of in _rounds(own, chain, carrier, count)]

    def part(self, pattern: TilePattern) -> Part:
        """The part, once the pattern of the reduced system is known; without the rows of its couplings."""
        n, windows = len(self._block), self.windows
        places = [table.flatten() for _, _, batches in self._rounds for table, *_ in batches]
        order = torch.cat((*places, self._block.new_full((1,), n)))
        place = torch.full((n + 1,), len(order) - 1, device=order.device)
        place[order] = torch.arange(len(order), device=order.device)
        place[-1] = len(order) - 1
        empty = order == n
        return Part(
            block=self._block,
            leaf_count=self._leaf_count,
            rounds=tuple(windows.round(*of_round, place, pattern) for of_round in self._rounds),
            place=place[:-1],
            at_place=self._block[torch.where(empty, 0, order)],
            empty=torch.nonzero(empty)[:, 0],
            right_side_row=windows.first_row[:-1],
            store_rows=windows.store_rows,
            factors={},
            factor_rows={},
            alone=frozenset(),
            windows=windows,
        )


def parts_of_chains(
    keys: Int[Tensor, " keys"], plan: EliminationPlan, count: int
) -> Int[Tensor, " chains"] | None:
    """Part of every chain, by the landmarks that its blocks are coupled to as keys; None: one part (on the CPU).

    The chain that sees most begins a part, and takes those that see about the same; then the next of those left.
    """
    chains = len(torch.unique(plan.chain))
    own = torch.unique(plan.owner[keys // count] * count + keys % count).cpu().numpy()
    sees = incidence(own // count, own % count, count)
    # The last chains may see nothing.
    rows, seen = len(sees.indptr) - 1, np.zeros(chains)
    seen[:rows] = np.diff(sees.indptr)
    blocks = torch.bincount(plan.chain, minlength=chains).cpu().numpy()
    part = np.full(chains, -1)
    last, size = 0, 0
    for chain in np.argsort(-seen, kind="stable"):
        if part[chain] >= 0:
            continue
        common = np.zeros(chains)
        if chain < rows:
            common[:rows] = (sees @ sees[[chain]].T).toarray()[:, 0]
        taken = (part < 0) & (common >= _IN_COMMON * seen)
        taken[chain] = True
        if size >= _LEAST_BLOCKS:
            last, size = last + 1, 0
        part[taken] = last
        size += blocks[taken].sum()
    if last and size < _LEAST_BLOCKS:
        last -= 1
        part = part.clip(max=last)
    if not last:
        return None
    return torch.from_numpy(part).to(keys.device)


def in_pieces(plan: EliminationPlan) -> EliminationPlan:
    """The plan with large parts cut into pieces, chain by chain, on a CPU: an even number, for two cores."""
    owner = plan.owner
    if owner.device.type != "cpu" or len(owner) < 2 * _PIECE:
        return plan
    blocks = torch.bincount(owner)
    part = torch.zeros_like(blocks) if plan.part is None else plan.part
    order = torch.argsort(part, stable=True)
    count = add_at(torch.zeros_like(blocks), 0, part, blocks)
    before = torch.empty_like(blocks)
    before[order] = blocks[order].cumsum(0) - blocks[order]
    before -= (count.cumsum(0) - count)[part]
    pieces = (count // (2 * _PIECE) * 2).clamp_min(1)
    number = (pieces.cumsum(0) - pieces)[part] + before * pieces[part] // count[part]
    _, number = torch.unique(number, return_inverse=True)
    return replace(plan, part=number)


def _alone(rows: Mapping[str, Int[Tensor, " fw"]], size: int) -> frozenset[str]:
    """The terms that may be copied into a store of this size, as no row of theirs is taken by then."""
    alone, taken = set(), None
    for name, of_term in rows.items():
        if taken is None:
            taken = torch.zeros(size, dtype=torch.long, device=of_term.device)
        add_at(taken, 0, of_term, torch.ones_like(of_term))
        if bool((taken[of_term] == 1).all()):
            alone.add(name)
    return frozenset(alone)


def _rounds(
    keys: Int[Tensor, " keys"],
    chain: Int[Tensor, " m"],
    carrier: Int[Tensor, " l"] | None,
    count: int,
) -> Iterator[tuple[Int[Tensor, " g"], Int[Tensor, "g s"], Int[Tensor, " keys_g"]]]:
    """Per round the blocks that go, their neighbours, and the landmarks they are coupled to by then, as keys."""
    leaves = 0 if carrier is None else len(carrier)
    n = leaves + len(chain)
    index = torch.arange(n, device=chain.device)
    if carrier is not None and leaves:
        neighbour = carrier[:, None]
        yield index[:leaves], neighbour, keys[keys < leaves * count]
        keys = _filled_in(keys, index[:leaves], neighbour, n, count)
    node = index[leaves:]
    while len(node):
        of = chain[node - leaves]
        first = torch.ones_like(of, dtype=torch.bool)
        first[1:] = of[1:] != of[:-1]
        at = torch.arange(len(node), device=node.device)
        goes = (at - at[first][first.cumsum(0) - 1]) % 2 == 0
        last = torch.cat((first[1:], first.new_ones(1)))
        before = torch.where(first, n, torch.cat((node[:1], node[:-1])))
        behind = torch.where(last, n, torch.cat((node[1:], node[-1:])))
        neighbour = torch.stack((before, behind), dim=-1)[goes]
        gone = torch.zeros(n, dtype=torch.bool, device=node.device)
        gone[node[goes]] = True
        yield node[goes], neighbour, keys[gone[keys // count]]
        keys = _filled_in(keys, node[goes], neighbour, n, count)
        node = node[~goes]


def _filled_in(
    keys: Int[Tensor, " keys"], node: Tensor, neighbour: Tensor, n: int, count: int
) -> Int[Tensor, " keys_after"]:
    """The couplings of the blocks that stay once `node` are gone: their own, and the fill-in from their neighbours."""
    receiver = torch.arange(n + 1, device=keys.device)[:, None].repeat(1, neighbour.shape[1])
    receiver[node] = neighbour
    block, landmark = keys // count, keys % count
    receivers = receiver[block]
    return torch.unique((receivers * count + landmark[:, None])[receivers < n])
