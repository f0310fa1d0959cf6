"""What rows bind eliminated blocks and landmarks: which factors of B there are, term by term, and in which order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Int
from torch import Tensor

from crowdmap_torch.optim.problem import CostTerm
from crowdmap_torch.optim.solvers.assembly import RowGroups
from crowdmap_torch.optim.solvers.plan import EliminationPlan
from crowdmap_torch.optim.solvers.windows import LandmarkBlocks

_LARGEST = 1 << 62
"""What a number is to stay below."""


@dataclass(frozen=True)
class Coupling:
    """Factors of B between eliminated blocks and landmarks, sorted by (part, block, landmarks)."""

    block: Int[Tensor, " f"]
    """Eliminated block of each factor, counted over leaves and chains."""
    column: Int[Tensor, "f w"]
    """Columns of the reduced system that the factor touches."""
    landmark: Int[Tensor, "f q"]
    """The same as landmark blocks."""
    widths: tuple[int, ...]
    """Columns of each of them."""
    variable: str
    """The eliminated variable."""

    def placed(self, landmarks: LandmarkBlocks) -> Coupling:
        """The same with the columns that these landmarks have."""
        return replace(self, column=landmarks.columns(self.landmark, self.widths))

    def is_like(self, other: Coupling) -> bool:
        """Whether it is between the same blocks."""
        if (self.variable, self.widths) != (other.variable, other.widths):
            return False
        return torch.equal(self.block, other.block) and torch.equal(self.landmark, other.landmark)


@dataclass(frozen=True)
class TermFactors:
    """How the rows of a term add up to factors."""

    rows: RowGroups
    """Rows of one eliminated block and the same landmarks add up to one factor."""
    coupling: str
    """Name of the coupling whose factors they are; terms of which each row touches the same blocks have one."""
    slot: int
    """Slot of the eliminated block."""
    lot: Int[Tensor, " f"]
    """By factor, the lot of those that touch the same landmarks and the same of the border."""
    slots: tuple[tuple[str, Int[Tensor, " g"]], ...]
    """The term's slots, of one row of every lot."""


@dataclass(frozen=True)
class Couplings:
    """All couplings, by name, and the terms that make them up, by name."""

    factors: Mapping[str, Coupling]
    terms: Mapping[str, TermFactors]

    def placed(self, landmarks: LandmarkBlocks) -> Couplings:
        """The same with the columns that these landmarks have."""
        return replace(self, factors={n: c.placed(landmarks) for n, c in self.factors.items()})

    def touched(self, landmarks: LandmarkBlocks) -> Int[Tensor, " keys"]:
        """Which block is coupled to which landmark: keys `block * count + landmark`, sorted and unique."""
        count = landmarks.count
        keys = [(c.block[:, None] * count + c.landmark).flatten() for c in self.factors.values()]
        none = torch.zeros(0, dtype=torch.long, device=landmarks.column.device)
        return torch.unique(torch.cat([none, *keys]))


def couplings_of(
    terms: Mapping[str, CostTerm], plan: EliminationPlan, landmarks: LandmarkBlocks
) -> Couplings:
    """Those of terms between eliminated blocks and landmarks; terms that the plan has no place for are refused."""
    first_block, owner = plan.first_block, plan.owner
    factors: dict[str, Coupling] = {}
    by_term: dict[str, TermFactors] = {}
    rank = plan.rank_of_blocks
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
            own, found = _coupling(term, eliminated[0], landmarks, first_block, rank)
            alike = [other for other, of_other in factors.items() if of_other.is_like(own)]
            factors.setdefault(alike[0] if alike else name, own)
            by_term[name] = replace(found, coupling=alike[0] if alike else name)
    return Couplings(factors, by_term)


def _coupling(
    term: CostTerm,
    slot: int,
    landmarks: LandmarkBlocks,
    first_block: dict[str, int],
    rank: Int[Tensor, " e"] | None,
) -> tuple[Coupling, TermFactors]:
    """The factors of a term, and how its rows make them up."""
    variable, block = term.slots[slot]
    block = block + first_block[variable]
    stays = [(name, index) for name, index in term.slots if name in landmarks.first]
    others = [index + landmarks.first[name] for name, index in stays]
    key = _numbered((block if rank is None else rank[block], *others), landmarks.count)
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
    widths = tuple(landmarks.width_of[name] for name, _ in stays)
    column = landmarks.columns(landmark, widths)
    kept = [index[first] for i, (_, index) in enumerate(term.slots) if i != slot]
    lots, lot = torch.unique(_numbered(kept, landmarks.count), return_inverse=True)
    row = torch.empty_like(lots)
    row[lot] = first
    slots = tuple((name, index[row]) for name, index in term.slots)
    return (
        Coupling(block[first], column, landmark, widths, variable),
        TermFactors(RowGroups(order, factor_of_row), "", slot, lot, slots),
    )


def _numbered(indices: Sequence[Int[Tensor, " m"]], count: int) -> Int[Tensor, " m"]:
    """One number for each row's indices, in their order: mixed radix, of which all but the first are below `count`."""
    key = indices[0]
    bound = int(key.max()) + 1 if len(key) else 1
    for index in indices[1:]:
        if bound * count > _LARGEST:
            found, key = torch.unique(key, return_inverse=True)
            bound = len(found)
        key, bound = key * count + index, bound * count
    return key
