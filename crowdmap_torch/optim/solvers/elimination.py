"""The order in which chains of blocks are eliminated: odd-even reduction, worked out once per problem.

Eliminated are the blocks of A in the normal equations, the landmarks' stay:

    [ A  B^T ] [ x ]     [ a ]        A: leaves and chains, block tridiagonal but for the leaves
    [ B  C   ] [ y ] = - [ b ]        B: coupling of the landmarks with them, C: landmarks

The chains' blocks are those of one variable (the slow drifts of journeys). Each may carry leaves, blocks of a second
variable that are bound to it alone (the poses of frames): leaves go first. Then every other block of each chain is
eliminated, all chains at once; those between are the chain of the next round, half as long, until no block is left (cyclic
or nested reduction; Golub and Van Loan, Matrix Computations, 4.5.4).

Eliminating block j with the diagonal D_j and the links E_j to its neighbours leaves fill-in behind: -E_j^T D_j^-1 E_j among
the neighbours, and -B_j D_j^-1 E_j in their coupling, in the columns of the landmarks that j is coupled to by then. Where
that is kept, `windows` says.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.problem import CostTerm, Problem, Values
from crowdmap_torch.optim.solvers.dissection import dissected, incidence, near_each_other
from crowdmap_torch.optim.solvers.layout import Layout, layout
from crowdmap_torch.optim.solvers.plan import EliminationPlan
from crowdmap_torch.optim.solvers.sparse_tiles import TilePattern
from crowdmap_torch.optim.solvers.tile_patterns import (
    binds,
    direct_pattern,
    landmark_pairs,
    reduced_pattern,
)
from crowdmap_torch.optim.solvers.windows import LandmarkBlocks, Round, WindowBuilder


@dataclass(frozen=True)
class Coupling:
    """A term between the eliminated blocks and the landmarks, its rows sorted by (block, landmarks)."""

    order: Int[Tensor, " m"] | None
    """Rows of the term, in the order of their factors; None where they are in that order already."""
    factor_of_row: Int[Tensor, " m"] | None
    """Rows of one eliminated block and the same landmarks add up to one factor; None: every row is its own."""
    block: Int[Tensor, " f"]
    """Eliminated block of each factor, counted over leaves and chains."""
    column: Int[Tensor, "f w"]
    """Columns of the reduced system that the factor touches."""
    landmark: Int[Tensor, "f q"]
    """The same as landmark blocks."""
    widths: tuple[int, ...]
    """Columns of each of them."""
    slot: int
    """Slot of the eliminated block."""
    variable: str
    """Its variable."""


@dataclass(frozen=True)
class ChainStructure:
    """Everything about the elimination that does not depend on values."""

    plan: EliminationPlan
    width: Mapping[str, int]
    """Tangents of a leaf and of a chain's block, by variable; leaves may be narrower, and are padded to the chains'."""
    where: Layout
    """The reduced system: all variables but those that the plan names."""
    couplings: dict[str, Coupling]
    factor_rows: dict[str, Int[Tensor, " fw"]]
    """Row of the store of every column of a coupling's factors."""
    alone: frozenset[str]
    """Terms of whose factors none has a row of the store in common with another's, and that come first."""
    order: Int[Tensor, " places"]
    """Block at every place of the order of elimination; the number of blocks where a group has fewer, and last."""
    place: Int[Tensor, " e"]
    """Place of every block."""
    right_side_row: Int[Tensor, " e"]
    """Row of the store of every block's right-hand side."""
    store_rows: int
    """Rows of the store; one more takes what is to be forgotten."""
    rounds: tuple[Round, ...]
    direct: TilePattern
    """Tiles of C."""
    reduced: TilePattern
    """Tiles of S and of its factor."""
    direct_tiles: Int[Tensor, " count"]
    """The numbers of C's tiles among those of S."""
    owner: Int[Tensor, " e"]
    """Chain that each block belongs to, counted over leaves and chains."""
    border: Layout
    """The border's variables, one behind the other."""
    keys: Int[Tensor, " keys"] = field(repr=False)
    """What the order has room for: keys `block * count + landmark`, sorted."""
    landmarks: LandmarkBlocks = field(repr=False)
    windows: WindowBuilder = field(repr=False)

    def with_couplings(self, couplings: Mapping[str, Coupling]) -> ChainStructure:
        """The same order for other rows, for whose couplings it has room."""
        placed, rows = _placed(couplings, self.landmarks, self.windows)
        alone = _alone(rows, self.store_rows)
        return replace(self, couplings=placed, factor_rows=rows, alone=alone)

    def by_place(
        self, diagonal: Float[Tensor, "e k k"], link: Float[Tensor, "e k k"]
    ) -> tuple[Float[Tensor, "p k k"], Float[Tensor, "p k k"]]:
        """Diagonal blocks and links of A at the places of the order of elimination.

        A place without a block has no links, and a diagonal that does no harm.
        """
        none = torch.eye(diagonal.shape[-1], dtype=diagonal.dtype, device=diagonal.device)[None]
        links = torch.cat((link, torch.zeros_like(none)))
        return torch.cat((diagonal, none))[self.order], links[self.order]

    def stack(self, tangents: Mapping[str, Tensor]) -> Float[Tensor, "e k ..."]:
        """Tangents of the leaves and of the chains, one behind the other; narrower ones are padded with zeros."""
        k = self.width[self.plan.chains]
        parts = [padded(tangents[name], 1, k) for name in self.plan.first_block]
        return parts[0] if len(parts) == 1 else torch.cat(parts)

    def unstack(self, stacked: Float[Tensor, "e k ..."]) -> dict[str, Tensor]:
        """Rows of the leaves and of the chains, by variable, without what they were padded with."""
        first = self.plan.first_block
        bounds = [*first.values(), len(stacked)]
        return {
            name: stacked[a:b, : self.width[name]]
            for name, a, b in zip(first, bounds, bounds[1:], strict=False)
        }


def padded(block: Float[Tensor, ...], dim: int, size: int) -> Float[Tensor, ...]:
    """The block with zeros behind it along an axis; itself where it is as long as that."""
    missing = size - block.shape[dim]
    if not missing:
        return block
    shape = [*block.shape[:dim], missing, *block.shape[dim + 1 :]]
    return torch.cat((block, block.new_zeros(shape)), dim=dim)


def analyse(
    problem: Problem,
    values: Values,
    plan: EliminationPlan,
    *,
    group_size: int | None,
    batch_bytes: int,
    before: ChainStructure | None = None,
) -> ChainStructure:
    """The elimination of a plan's leaves and chains in a problem; that of `before` where it is the same.

    It depends on the plan and on what the rows touch now, not on what they touched before.

    Every row may touch one eliminated block and any landmarks; or one or two eliminated blocks, neighbours of a chain or a
    leaf and the block that carries it. Beside them it may touch the chain's blocks of the border.
    """
    where, landmarks, couplings, keys = _touched(problem, values, plan)
    if plan.room is not None:
        fits = bool(torch.isin(keys, plan.room, assume_unique=True).all())
        keys = plan.room if fits else torch.unique(torch.cat((plan.room, keys)))
    if before is not None and torch.equal(keys, before.keys):
        pairs = landmark_pairs(problem, before.landmarks, plan.first_block)
        if binds(before.direct, before.landmarks, pairs):
            return before.with_couplings(couplings)
    pairs, rank = landmark_pairs(problem, landmarks, plan.first_block), plan.rank
    if rank is None:
        rank = _rank(keys, pairs, plan.owner, landmarks)
    where = where.in_order(torch.argsort(rank[: len(landmarks.column)], stable=True))
    landmarks = LandmarkBlocks.of(where, plan.chain.device)
    owner = plan.owner
    k = problem.variables[plan.chains].tangent_dim
    if plan.leaves is not None and problem.variables[plan.leaves].tangent_dim > k:
        raise ValueError(f"{plan.leaves!r}: expected leaves of at most {k} tangents, the chains'")
    size = group_size or min(64, max(4, _beside_each_other(keys, owner, landmarks.count)))
    builder = WindowBuilder(landmarks, len(owner), size, k, batch_bytes)
    windows = [
        builder.windows(node, neighbour, coupled)
        for node, neighbour, coupled in _rounds(keys, plan, landmarks.count)
    ]
    direct = direct_pattern(landmarks, keys, pairs)
    reduced = reduced_pattern(direct, landmarks, *builder.bound())
    places = [table.flatten() for _, _, batches in windows for table, *_ in batches]
    order = torch.cat((*places, owner.new_full((1,), len(owner))))
    place = torch.full((len(owner) + 1,), len(order) - 1, device=owner.device)
    place[order] = torch.arange(len(order), device=owner.device)
    place[-1] = len(order) - 1
    couplings, factor_rows = _placed(couplings, landmarks, builder)
    return ChainStructure(
        plan=plan,
        width={name: problem.variables[name].tangent_dim for name in plan.first_block},
        where=where,
        couplings=couplings,
        rounds=tuple(builder.round(*of_round, place, reduced) for of_round in windows),
        factor_rows=factor_rows,
        alone=_alone(factor_rows, builder.store_rows),
        order=order,
        place=place[:-1],
        right_side_row=builder.first_row[:-1],
        store_rows=builder.store_rows,
        direct=direct,
        reduced=reduced,
        direct_tiles=reduced.numbers_of(direct),
        owner=owner,
        border=layout(problem, values, skip=_all_but(problem, plan.border)),
        keys=keys,
        landmarks=landmarks,
        windows=builder,
    )


def _beside_each_other(keys: Int[Tensor, " keys"], owner: Int[Tensor, " e"], count: int) -> int:
    """About how many chains are coupled to one landmark: those that see one stretch of road at the same step."""
    own = torch.unique(owner[keys // count] * count + keys % count) % count
    return round(len(own) / max(len(torch.unique(own)), 1))


def _placed(
    couplings: Mapping[str, Coupling], landmarks: LandmarkBlocks, windows: WindowBuilder
) -> tuple[dict[str, Coupling], dict[str, Int[Tensor, " fw"]]]:
    """Couplings with their columns of the reduced system, and the rows of the store that these are."""
    rows = {name: windows.rows(c.block, c.landmark, c.widths) for name, c in couplings.items()}
    placed = {
        name: replace(c, column=landmarks.columns(c.landmark, c.widths))
        for name, c in couplings.items()
    }
    return placed, rows


def _alone(rows: Mapping[str, Int[Tensor, " fw"]], size: int) -> frozenset[str]:
    """The terms that may be copied into a store of this size, as no row of theirs is taken by then."""
    alone, taken = set(), None
    for name, of_term in rows.items():
        if taken is None:
            taken = torch.zeros(size, dtype=torch.long, device=of_term.device)
        taken.index_add_(0, of_term, torch.ones_like(of_term))
        if bool((taken[of_term] == 1).all()):
            alone.add(name)
    return frozenset(alone)


def planned_ahead(
    problem: Problem, values: Values, plan: EliminationPlan, *, sliding: Collection[str] = ()
) -> EliminationPlan:
    """The plan with what the rows show of the landmarks, which serves them still when they have changed a little.

    Landmarks are ranked such that those coupled to one block are near each other (worked out on the CPU), and there is room
    for rows that go over to the next landmark, by number, of the `sliding` variables.
    """
    _, landmarks, _, keys = _touched(problem, values, plan)
    pairs = landmark_pairs(problem, landmarks, plan.first_block)
    room, count = [keys], landmarks.count
    for name in sliding:
        first, number = landmarks.first[name], len(values[name])
        at = keys % count - first
        for step in (-1, 1):
            goes = (at >= 0) & (at < number) & (at + step >= 0) & (at + step < number)
            room.append(keys[goes] + step)
    return replace(
        plan, rank=_rank(keys, pairs, plan.owner, landmarks), room=torch.unique(torch.cat(room))
    )


def _touched(
    problem: Problem, values: Values, plan: EliminationPlan
) -> tuple[Layout, LandmarkBlocks, dict[str, Coupling], Int[Tensor, " keys"]]:
    """The reduced system, its blocks, and what of it the eliminated blocks are coupled to, by term and as keys."""
    where = layout(problem, values, skip=(*plan.first_block, *plan.border))
    landmarks = LandmarkBlocks.of(where, plan.chain.device)
    couplings = _couplings(problem.terms, plan, plan.owner, landmarks)
    return where, landmarks, couplings, _coupled_landmarks(couplings, landmarks)


def _all_but(problem: Problem, names: Collection[str]) -> tuple[str, ...]:
    return tuple(name for name in problem.variables if name not in names)


def _couplings(
    terms: Mapping[str, CostTerm], plan: EliminationPlan, owner: Tensor, landmarks: LandmarkBlocks
) -> dict[str, Coupling]:
    """The terms between eliminated blocks and landmarks; terms that the plan has no place for are refused."""
    first_block, couplings = plan.first_block, {}
    for name, term in terms.items():
        eliminated = [i for i, (slot, _) in enumerate(term.slots) if slot in first_block]
        border = [i for i, (slot, _) in enumerate(term.slots) if slot in plan.border]
        others = len(term.slots) - len(eliminated) - len(border)
        if len(eliminated) > 2 or (others and len(eliminated) > 1):
            raise ValueError(
                f"term {name!r} couples {len(eliminated)} eliminated blocks and {others} others; "
                "at most two eliminated blocks are supported, and one with landmarks"
            )
        for i in eliminated:
            slot, block = term.slots[i]
            chain = owner[block + first_block[slot]]
            for beside, its_block in (term.slots[k] for k in border):
                if not torch.equal(plan.border[beside][chain], its_block):
                    raise ValueError(
                        f"term {name!r} couples blocks of {slot!r} with the {beside!r} of another chain"
                    )
        if others and eliminated:
            at = [i for i in range(len(term.slots)) if i not in border]
            term = replace(term, slots=tuple(term.slots[i] for i in at))
            found = _coupling(term, at.index(eliminated[0]), landmarks, first_block)
            couplings[name] = replace(found, slot=eliminated[0])
    return couplings


def _coupling(
    term: CostTerm, slot: int, landmarks: LandmarkBlocks, first_block: dict[str, int]
) -> Coupling:
    name, block = term.slots[slot]
    block = block + first_block[name]
    others = [
        index + landmarks.first[other] for i, (other, index) in enumerate(term.slots) if i != slot
    ]
    # One number for the landmarks of a row: mixed radix, hashed down before it can overflow.
    key = block
    for at, index in enumerate(others):
        if at:
            _, key = torch.unique(key, return_inverse=True)
        key = key * landmarks.count + index
    order = None
    if not bool((key[1:] >= key[:-1]).all()):
        order = torch.argsort(key, stable=True)
        key = key[order]
    begins = torch.ones_like(key, dtype=torch.bool)
    begins[1:] = key[1:] != key[:-1]
    factor_of_row = None if bool(begins.all()) else begins.cumsum(0) - 1
    first = torch.nonzero(begins)[:, 0]
    first = first if order is None else order[first]
    landmark = torch.stack([index[first] for index in others], dim=-1)
    widths = tuple(
        landmarks.width_of[other] for i, (other, _) in enumerate(term.slots) if i != slot
    )
    column = landmarks.columns(landmark, widths)
    return Coupling(order, factor_of_row, block[first], column, landmark, widths, slot, name)


def _coupled_landmarks(
    couplings: dict[str, Coupling], landmarks: LandmarkBlocks
) -> Int[Tensor, " keys"]:
    """Which block is coupled to which landmark: keys `block * count + landmark`, sorted and unique."""
    keys = [(c.block[:, None] * landmarks.count + c.landmark).flatten() for c in couplings.values()]
    none = torch.zeros(0, dtype=torch.long, device=landmarks.column.device)
    return torch.unique(torch.cat([none, *keys]))


def _rank(
    keys: Int[Tensor, " keys"],
    pairs: Int[Tensor, "n 2"],
    owner: Int[Tensor, " e"],
    landmarks: LandmarkBlocks,
) -> Float[Tensor, " q"]:
    """A position of every landmark on a line, by couplings as keys and pairs that are bound without an eliminated block."""
    count = landmarks.count
    block, column = keys // count, (keys % count).cpu().numpy()
    # Blocks of a chain are coupled to nearly what their neighbours are: a few of them together tell the same.
    position = near_each_other(incidence((block // 8).cpu().numpy(), column, count))
    # Once it is eliminated, a chain has bound all that it was coupled to.
    first = int(owner.max()) + 1 if len(owner) else 0
    apart = torch.arange(first, first + len(pairs)).repeat_interleave(2)
    row = torch.cat((owner[block].cpu(), apart)).numpy()
    bound = incidence(row, np.concatenate((column, pairs.flatten().cpu().numpy())), count)
    width = landmarks.width.cpu().numpy()
    if not len(width):
        return torch.zeros(count, dtype=torch.double, device=keys.device)
    return torch.from_numpy(dissected(bound, width, position)).double().to(keys.device)


def _rounds(
    keys: Int[Tensor, " keys"], plan: EliminationPlan, count: int
) -> Iterator[tuple[Int[Tensor, " g"], Int[Tensor, "g s"], Int[Tensor, " keys_g"]]]:
    """Per round the blocks that go, their neighbours, and the landmarks they are coupled to by then, as keys."""
    leaves, n = plan.leaf_count, plan.leaf_count + len(plan.chain)
    index = torch.arange(n, device=plan.chain.device)
    if plan.carrier is not None and leaves:
        neighbour = (plan.carrier + leaves)[:, None]
        yield index[:leaves], neighbour, keys[keys < leaves * count]
        keys = _filled_in(keys, index[:leaves], neighbour, n, count)
    node = index[leaves:]
    while len(node):
        of = plan.chain[node - leaves]
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
