"""The order in which chains of blocks are eliminated, worked out once per problem.

Eliminated are the blocks of A in the normal equations, the landmarks' stay:

    [ A  B^T ] [ x ]     [ a ]        A: leaves and chains, block tridiagonal but for the leaves
    [ B  C   ] [ y ] = - [ b ]        B: coupling of the landmarks with them, C: landmarks

The chains' blocks are those of one variable (the slow drifts of journeys). `parts` has the order of those that see the same
roads, part follows part.

Eliminating block j with the diagonal D_j and the links E_j to its neighbours leaves fill-in behind: -E_j^T D_j^-1 E_j among
the neighbours, and -B_j D_j^-1 E_j in their coupling, in the columns of the landmarks that j is coupled to by then. Where
that is kept, `windows` says.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.problem import Problem, Values
from crowdmap_torch.optim.solvers.couplings import Couplings, couplings_of
from crowdmap_torch.optim.solvers.dissection import dissected, incidence, near_each_other
from crowdmap_torch.optim.solvers.layout import Layout, layout
from crowdmap_torch.optim.solvers.parts import Part, PartBuilder, in_pieces, parts_of_chains
from crowdmap_torch.optim.solvers.plan import EliminationPlan
from crowdmap_torch.optim.solvers.sparse_tiles import TilePattern, tile_width
from crowdmap_torch.optim.solvers.tile_patterns import (
    binds,
    border_beside,
    direct_pattern,
    pairs_that_stay,
    reduced_pattern,
    tiles_of_factor,
)
from crowdmap_torch.optim.solvers.windows import LandmarkBlocks, WindowBuilder
from crowdmap_torch.processes.amounts import at_once

_BATCH_BYTES = 1 << 22
"""Size of what is eliminated at once on a CPU: about what its cache holds."""
_LITTLE = 1 << 22
"""Numbers of a reduced system of which there may be two."""
_FEW_ROWS = 1 << 21
"""Rows of two stores that may be there at one time: 100 MB of blocks of six."""
_SPARSER = 0.8
"""Share of the tiles of an order by dissection that a band is to have less than, if it is taken."""


@dataclass(frozen=True)
class ChainStructure:
    """Everything about the elimination that does not depend on values."""

    plan: EliminationPlan
    width: Mapping[str, int]
    """Tangents of a leaf and of a chain's block, by variable; leaves may be narrower, and are padded to the chains'."""
    where: Layout
    """The reduced system: all variables but those that the plan eliminates, those of the border last."""
    couplings: Couplings
    parts: tuple[Part, ...]
    """Chains that are eliminated together, part after part."""
    number: Int[Tensor, " e"]
    """Every block's number in its part."""
    direct: TilePattern
    """Tiles of C."""
    reduced: TilePattern
    """Tiles of S and of its factor."""
    owner: Int[Tensor, " e"]
    """Chain that each block belongs to, counted over leaves and chains."""
    border: Int[Tensor, "chains b"]
    """Columns of what each chain has of the border's variables, one behind the other."""
    keys: Int[Tensor, " keys"] = field(repr=False)
    """What the order has room for: keys `block * count + landmark`, sorted."""
    landmarks: LandmarkBlocks = field(repr=False)
    stays: LandmarkBlocks = field(repr=False)
    """The landmarks, and behind them the blocks of the border."""
    seen_with: frozenset[str]
    """Variables of the border that rows of an eliminated block and landmarks touch as well."""

    @cached_property
    def lanes(self) -> tuple[tuple[int, ...], ...]:
        """Parts that are eliminated one after the other, beside those of the other lane; each has a reduced system.

        There is one lane on a GPU, and where another would take much memory. How many cores there are is of no account:
        sums are taken in this order anywhere.
        """
        rows = [part.store_rows for part in self.parts]
        every = tuple(range(len(rows)))
        if len(every) < 2 or self.owner.device.type != "cpu" or self.reduced.size > _LITTLE:
            return (every,)
        lanes: tuple[list[int], list[int]] = ([], [])
        for i in sorted(every, key=lambda i: -rows[i]):
            min(lanes, key=lambda lane: sum(rows[j] for j in lane)).append(i)
        if sum(max(rows[i] for i in lane) for lane in lanes) > _FEW_ROWS:
            return (every,)
        return tuple(tuple(sorted(lane)) for lane in lanes)

    @property
    def border_begin(self) -> int:
        """First column of the border."""
        return min([self.where.dim, *self.stays.column[len(self.landmarks.column) :].tolist()])

    def with_couplings(self, couplings: Couplings) -> ChainStructure:
        """The same order for other rows, for whose couplings it has room."""
        couplings = couplings.placed(self.landmarks)
        parts = _with_couplings(self.parts, couplings, self.plan, self.number)
        return replace(self, couplings=couplings, parts=parts)

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
    batch_bytes: int | None,
    before: ChainStructure | None = None,
) -> ChainStructure:
    """The elimination of a plan's leaves and chains in a problem; that of `before` where it is the same.

    It depends on the plan and on what the rows touch now, not on what they touched before.

    Every row may touch one eliminated block and any landmarks; or one or two eliminated blocks, neighbours of a chain or a
    leaf and the block that carries it. Beside them it may touch the chain's blocks of the border.
    """
    plan = in_pieces(plan)
    stays, landmarks, couplings, keys = _touched(problem, values, plan)
    if plan.room is not None:
        fits = bool(torch.isin(keys, plan.room, assume_unique=True).all())
        keys = plan.room if fits else torch.unique(torch.cat((plan.room, keys)))
    pairs, seen_with = pairs_that_stay(problem, stays, plan.first_block), _seen_with(problem, plan)
    if before is not None and torch.equal(keys, before.keys) and seen_with == before.seen_with:
        if binds(before.direct, before.stays, pairs):
            return before.with_couplings(couplings)
    where = _in_order(_stays(problem, values, plan), plan, keys, pairs, landmarks)
    landmarks, stays = _blocks(where, plan)
    k = problem.variables[plan.chains].tangent_dim
    if plan.leaves is not None and problem.variables[plan.leaves].tangent_dim > k:
        raise ValueError(f"{plan.leaves!r}: expected leaves of at most {k} tangents, the chains'")
    owner = plan.owner
    size = group_size or min(64, max(4, _beside_each_other(keys, owner, landmarks.count)))
    batch_bytes = batch_bytes or at_once(_BATCH_BYTES, owner.device)
    builders, number = _builders(plan, keys, landmarks, size, k, batch_bytes)
    beside = border_beside(keys, landmarks.count, owner, plan.border)
    by_rows = [of for of in beside if of.variable in seen_with]
    direct = direct_pattern(stays, landmarks, keys, pairs, by_rows)
    bound = _bound(builders, owner.device)
    reduced = reduced_pattern(direct, stays, *bound, beside, is_factored=plan.is_whole)
    couplings = couplings.placed(landmarks)
    parts = [builder.part(reduced) for builder in builders]
    none = [plan.chain.new_zeros(plan.chain_count, 0)]
    return ChainStructure(
        plan=plan,
        width={name: problem.variables[name].tangent_dim for name in plan.first_block},
        where=where,
        couplings=couplings,
        parts=_with_couplings(parts, couplings, plan, number),
        number=number,
        direct=direct,
        reduced=reduced,
        owner=owner,
        border=torch.cat(none + [where.entries(*of) for of in plan.border.items()], dim=1),
        keys=keys,
        landmarks=landmarks,
        stays=stays,
        seen_with=seen_with,
    )


def _in_order(
    where: Layout,
    plan: EliminationPlan,
    keys: Int[Tensor, " keys"],
    pairs: Int[Tensor, "n 2"],
    landmarks: LandmarkBlocks,
) -> Layout:
    """The reduced system with the landmarks in the order of the plan, or one that is found, and the border behind them."""
    rank, section = plan.rank, plan.section
    if rank is None:
        rank, section = _rank(keys, pairs, plan.owner, landmarks)
    count = len(landmarks.column)
    order = torch.argsort(rank[:count], stable=True)
    grid = tile_width(where.dim, order.device)
    last = torch.arange(count, sum(map(len, where.offset.values())), device=order.device)
    if grid == where.dim:
        return where.in_order(torch.cat((order, last)))
    # The border is a section of its own.
    section = torch.zeros_like(order) if section is None else section[order]
    section = torch.cat((section, torch.full_like(last, 1 + max(section.tolist(), default=0))))
    return where.in_order(torch.cat((order, last)), section, grid)


def _seen_with(problem: Problem, plan: EliminationPlan) -> frozenset[str]:
    """Variables of the border that rows touch together with an eliminated block and a landmark."""
    found = set()
    for term in problem.terms.values():
        names = {name for name, _ in term.slots}
        if names & set(plan.first_block) and names - set(plan.first_block) - set(plan.border):
            found |= names & set(plan.border)
    return frozenset(found)


def _builders(
    plan: EliminationPlan,
    keys: Int[Tensor, " keys"],
    landmarks: LandmarkBlocks,
    group_size: int,
    k: int,
    batch_bytes: int,
) -> tuple[list[PartBuilder], Int[Tensor, " e"]]:
    """The parts' orders of elimination as far as they do not hang on each other, and every block's number in its part."""
    part = plan.part_of_blocks
    if not len(part):
        return [], part
    count = torch.bincount(part)
    blocks = torch.argsort(part, stable=True).split(count.tolist())
    number = torch.empty_like(part)
    for block in blocks:
        number[block] = torch.arange(len(block), device=part.device)
    of_key = part[keys // landmarks.count]
    by_part = keys[torch.argsort(of_key, stable=True)]
    each = by_part.split(torch.bincount(of_key, minlength=len(count)).tolist())
    builders = [
        PartBuilder(
            *(plan, block, number, own),
            WindowBuilder(landmarks, len(block), group_size, k, batch_bytes),
        )
        for block, own in zip(blocks, each, strict=True)
    ]
    return builders, number


def _bound(
    builders: Sequence[PartBuilder], device: torch.device
) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
    """Groups of all parts, and the places of the landmarks in their windows, in the order of columns."""
    none = torch.zeros(0, dtype=torch.long, device=device)
    groups, places, first = [none], [none], 0
    for builder in builders:
        group, place = builder.windows.bound()
        groups.append(group + first)
        places.append(place)
        first += builder.windows.groups
    return torch.cat(groups), torch.cat(places)


def _with_couplings(
    parts: Sequence[Part], couplings: Couplings, plan: EliminationPlan, number: Int[Tensor, " e"]
) -> tuple[Part, ...]:
    """The parts with the factors of the couplings, which follow each other part by part."""
    part, bound = plan.part_of_blocks, torch.arange(len(parts) + 1, device=number.device)
    ends = {
        name: torch.searchsorted(part[c.block].contiguous(), bound).tolist()
        for name, c in couplings.factors.items()
    }
    return tuple(
        one.with_couplings(
            couplings.factors,
            {name: slice(end[i], end[i + 1]) for name, end in ends.items()},
            number,
        )
        for i, one in enumerate(parts)
    )


def _beside_each_other(keys: Int[Tensor, " keys"], owner: Int[Tensor, " e"], count: int) -> int:
    """About how many chains are coupled to one landmark: those that see one stretch of road at the same step."""
    own = torch.unique(owner[keys // count] * count + keys % count) % count
    return round(len(own) / max(len(torch.unique(own)), 1))


def planned_ahead(
    problem: Problem,
    values: Values,
    plan: EliminationPlan,
    *,
    sliding: Mapping[str, Int[Tensor, " n"]] | None = None,
) -> EliminationPlan:
    """The plan with what the rows show of the landmarks, which serves them still when they have changed a little.

    Landmarks are ranked such that those coupled to one block are near each other, chains parted by what they see (both
    worked out on the CPU), and there is room for rows that go over to the next landmark, by number, of the `sliding`
    variables: along a row of landmarks, of which each block's number is given, and not from one row to another.
    """
    stays, landmarks, _, keys = _touched(problem, values, plan)
    pairs = pairs_that_stay(problem, stays, plan.first_block)
    room, count = [keys], landmarks.count
    for name, of in (sliding or {}).items():
        at = keys % count - landmarks.first[name]
        own = torch.nonzero((at >= 0) & (at < len(of)))[:, 0]
        for step in (-1, 1):
            here, there = at[own], at[own] + step
            goes = (there >= 0) & (there < len(of))
            goes &= of[there.clamp(0, len(of) - 1)] == of[here]
            room.append(keys[own[goes]] + step)
    every = torch.unique(torch.cat(room))
    rank, section = _rank(every, pairs, plan.owner, landmarks)
    return replace(
        plan, rank=rank, section=section, room=every, part=parts_of_chains(keys, plan, count)
    )


def _touched(
    problem: Problem, values: Values, plan: EliminationPlan
) -> tuple[LandmarkBlocks, LandmarkBlocks, Couplings, Int[Tensor, " keys"]]:
    """What stays, the landmarks of it, and which of these the eliminated blocks are coupled to, by term and as keys."""
    landmarks, stays = _blocks(_stays(problem, values, plan), plan)
    couplings = couplings_of(problem.terms, plan, landmarks)
    return stays, landmarks, couplings, couplings.touched(landmarks)


def _stays(problem: Problem, values: Values, plan: EliminationPlan) -> Layout:
    """The reduced system in no particular order, but for the border, which is last."""
    return layout(problem, values, skip=plan.first_block, last=plan.border)


def _blocks(where: Layout, plan: EliminationPlan) -> tuple[LandmarkBlocks, LandmarkBlocks]:
    """The landmarks of a reduced system, and all that stays; the landmarks have the same numbers in both."""
    device = plan.chain.device
    return LandmarkBlocks.of(where, device, skip=plan.border), LandmarkBlocks.of(where, device)


def _rank(
    keys: Int[Tensor, " keys"],
    pairs: Int[Tensor, "n 2"],
    owner: Int[Tensor, " e"],
    landmarks: LandmarkBlocks,
) -> tuple[Float[Tensor, " q"], Int[Tensor, " q"] | None]:
    """A position of every landmark on a line, by couplings as keys and pairs that are bound without an eliminated block.

    With the section of the line that each is in, where it is worth to begin sections with tiles.
    """
    count = landmarks.count
    # What is bound to the border alone is nowhere near anything.
    pairs = pairs[(pairs < len(landmarks.column)).all(1)]
    block, landmark = keys // count, torch.cat((keys % count, pairs.flatten()))
    # Blocks of a chain are coupled to nearly what their neighbours are: a few of them together tell the same.
    by_few = incidence((block // 8).cpu().numpy(), (keys % count).cpu().numpy(), count)
    if not len(landmarks.width):
        return torch.zeros(count, dtype=torch.double, device=keys.device), None
    # Once it is eliminated, a chain has bound all that it was coupled to.
    first = int(owner.max()) + 1 if len(owner) else 0
    apart = torch.arange(first, first + len(pairs), device=keys.device).repeat_interleave(2)
    by = torch.cat((owner[block], apart))
    bound = incidence(by.cpu().numpy(), landmark.cpu().numpy(), count)
    # In a city by dissection; along one road a band may be sparser, though its windows have more runs.
    nested, section, banded = (
        torch.from_numpy(found).to(keys.device)
        for found in (
            *dissected(bound, landmarks.width.cpu().numpy(), near_each_other(by_few)),
            near_each_other(bound),
        )
    )
    # Tiles of a GPU are too wide to begin them anew.
    begun = section if keys.device.type == "cpu" else None
    of_nested = tiles_of_factor(by, landmark, landmarks, nested, begun)
    of_banded = tiles_of_factor(by, landmark, landmarks, banded)
    if of_banded < _SPARSER * of_nested:
        return banded.double(), None
    return nested.double(), begun
