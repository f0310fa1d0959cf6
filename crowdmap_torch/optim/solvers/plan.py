"""Which unknowns a back end eliminates, and in what order: said once, where the problem is built."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class EliminationPlan:
    """Leaves go first, then the chains they hang on; what is not named are landmarks, solved for together; the border last.

    A frame's pose is a leaf on the drift of its journey, the drift of a journey, or of a stretch of it, is a chain, and the
    journey's bias and the calibration of its car are its blocks of the border. Chains touch each other through
    landmarks and through what they share, and through nothing else.
    """

    chains: str
    """Variable whose blocks form the chains."""
    chain: Int[Tensor, " n"]
    """Chain of each of them; the blocks of a chain are adjacent and in order."""
    leaves: str | None = None
    """Variable whose blocks are bound to one block of a chain each; None: there is none."""
    carrier: Int[Tensor, " m"] | None = None
    """Block of the chains that each leaf hangs on."""
    border: Mapping[str, Int[Tensor, " chains"]] = field(default_factory=dict)
    """Variables of which each chain has one block, to itself or in common with others, by name: the block of each chain."""
    joints: str | None = None
    """Variable of the landmarks at whose blocks chains of one drive are joined, in their order; None: there is none."""
    joint: Int[Tensor, "chains 2"] | None = None
    """The block that each chain begins at and the one that it ends at; -1: it does not."""
    rank: Float[Tensor, " q"] | None = None
    """A position of every landmark on a line (`planned_ahead`); None: found whenever rows touch other landmarks."""
    section: Int[Tensor, " q"] | None = None
    """Section of that line that each landmark is in, one behind the other: the landmarks' matrix has tiles that begin with
    them (`planned_ahead`). None: there is one."""
    room: Int[Tensor, " keys"] | None = None
    """What eliminated blocks may be coupled to (`planned_ahead`): the order of elimination is kept while they are coupled to
    nothing else. None: it is found whenever they are coupled to others."""
    is_whole: bool = True
    """Whether these are all chains: then the reduced system is factored, else it is a part of a sum (`journey_system`)."""
    part: Int[Tensor, " chains"] | None = None
    """Which of several parts each chain is of (`planned_ahead`): parts are eliminated by themselves, and those that see
    other roads have little in common. None: one part, unless it is large (`parts.in_pieces`)."""

    def __post_init__(self) -> None:
        """Refuses chains in pieces, and leaves that hang on nothing."""
        pieces = 1 + int((self.chain[1:] != self.chain[:-1]).sum()) if len(self.chain) else 0
        if pieces != self.chain_count:
            raise ValueError(
                f"chain: expected the blocks of a chain of {self.chains!r} behind each other, found "
                f"{self.chain_count} chains in {pieces} pieces; sort the blocks by chain"
            )
        if (self.leaves is None) != (self.carrier is None):
            raise ValueError("leaves and carrier: expected both or neither")
        if self.carrier is not None and not bool(
            ((self.carrier >= 0) & (self.carrier < len(self.chain))).all()
        ):
            raise ValueError(f"carrier: expected blocks of {self.chains!r}, 0 to {len(self.chain)}")

    @property
    def chain_count(self) -> int:
        """Number of chains."""
        return len(torch.unique(self.chain))

    @property
    def leaf_count(self) -> int:
        """Number of leaves."""
        return 0 if self.carrier is None else len(self.carrier)

    @property
    def first_block(self) -> dict[str, int]:
        """First block of each eliminated variable, counted over leaves and chains."""
        if self.leaves is None:
            return {self.chains: 0}
        return {self.leaves: 0, self.chains: self.leaf_count}

    @property
    def owner(self) -> Int[Tensor, " e"]:
        """Chain that each eliminated block belongs to, counted over leaves and chains."""
        if self.carrier is None:
            return self.chain
        return torch.cat((self.chain[self.carrier], self.chain))

    @property
    def part_of_blocks(self) -> Int[Tensor, " e"]:
        """Part that each eliminated block belongs to, counted over leaves and chains."""
        owner = self.owner
        return torch.zeros_like(owner) if self.part is None else self.part[owner]

    @property
    def rank_of_blocks(self) -> Int[Tensor, " e"] | None:
        """Where each stands when parts follow each other; None: where it stands anyhow."""
        if self.part is None:
            return None
        order = torch.argsort(self.part_of_blocks, stable=True)
        rank = torch.empty_like(order)
        rank[order] = torch.arange(len(order), device=order.device)
        return rank
