"""What rows bind eliminated blocks and landmarks: which factors of B there are, term by term, and in which order."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Int
from torch import Tensor

from crowdmap_torch.optim.problem import CostTerm
from crowdmap_torch.optim.solvers.plan import EliminationPlan
from crowdmap_torch.optim.solvers.windows import LandmarkBlocks


@dataclass(frozen=True)
class Coupling:
    """A term between the eliminated blocks and the landmarks, its rows sorted by (part, block, landmarks)."""

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

    def placed(self, landmarks: LandmarkBlocks) -> Coupling:
        """The same with the columns that these landmarks have."""
        return replace(self, column=landmarks.columns(self.landmark, self.widths))


def couplings_of(
    terms: Mapping[str, CostTerm], plan: EliminationPlan, landmarks: LandmarkBlocks
) -> dict[str, Coupling]:
    """The terms between eliminated blocks and landmarks; terms that the plan has no place for are refused."""
    first_block, owner, couplings = plan.first_block, plan.owner, {}
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
            at = [i for i in range(len(term.slots)) if i not in border]
            term = replace(term, slots=tuple(term.slots[i] for i in at))
            found = _coupling(term, at.index(eliminated[0]), landmarks, first_block, rank)
            couplings[name] = replace(found, slot=eliminated[0])
    return couplings


def _coupling(
    term: CostTerm,
    slot: int,
    landmarks: LandmarkBlocks,
    first_block: dict[str, int],
    rank: Int[Tensor, " e"] | None,
) -> Coupling:
    name, block = term.slots[slot]
    block = block + first_block[name]
    others = [
        index + landmarks.first[other] for i, (other, index) in enumerate(term.slots) if i != slot
    ]
    # One number for the landmarks of a row: mixed radix, hashed down before it can overflow.
    key = block if rank is None else rank[block]
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


def coupled_landmarks(
    couplings: Mapping[str, Coupling], landmarks: LandmarkBlocks
) -> Int[Tensor, " keys"]:
    """Which block is coupled to which landmark: keys `block * count + landmark`, sorted and unique."""
    keys = [(c.block[:, None] * landmarks.count + c.landmark).flatten() for c in couplings.values()]
    none = torch.zeros(0, dtype=torch.long, device=landmarks.column.device)
    return torch.unique(torch.cat([none, *keys]))
