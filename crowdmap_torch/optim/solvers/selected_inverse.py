"""Selected blocks of the inverse of A: the covariances of eliminated blocks, all that stays held.

With W_j, V_j of `block_elimination` and P_j = W_j^T V_j the block of an eliminated j follows from those of its neighbours n:

    (A^-1)_jj = D_j^-1 + P_j (A^-1)_nn P_j^T        (A^-1)_jn = P_j (A^-1)_nn

From the last round to the first; what two neighbours have in common is known once the later one is (Takahashi, Fagan and
Chen 1973).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.optim.solvers.block_elimination import KeptLead
from crowdmap_torch.optim.solvers.parts import Part
from crowdmap_torch.processes.amounts import at_once

_AT_ONCE = 1 << 12
"""Blocks of a round whose inverses are found together on a CPU."""


def diagonal_of_inverse(
    part: Part, leads: Sequence[KeptLead], *, leaves: bool = True
) -> Float[Tensor, "n k k"]:
    """Diagonal blocks of the inverse of A, those of a part, by what its rounds leave behind.

    Without `leaves` those of its chains alone.
    """
    # Leaves are the first round, if there are any.
    begun = int(not leaves and part.leaf_count > 0)
    place = part.place[part.leaf_count if begun else 0 :]
    k = len(leads[0].whiten)
    found = leads[0].whiten.new_zeros(len(part.at_place), k, k)
    # With the block that follows, of those known so far.
    crossed = torch.zeros_like(found)
    lot = at_once(_AT_ONCE, found.device)
    for of_round, kept in zip(reversed(part.rounds[begun:]), reversed(leads[begun:]), strict=True):
        first = of_round.place.start
        # Blocks of one round have nothing to do with each other.
        for begin in range(0, len(of_round.neighbour), lot):
            neighbour = of_round.neighbour[begin : begin + lot]
            here = slice(first + begin, first + begin + len(neighbour))
            lead = kept.blocks(slice(begin, begin + lot))
            inverse, towards = lead.whiten.mT @ lead.whiten, lead.whiten.mT @ lead.towards
            around = found[neighbour]
            if neighbour.shape[1] == 2:
                before = neighbour[:, 0]
                both = crossed[before]
                upper = torch.cat((around[:, 0], both), dim=-1)
                beside = torch.cat((upper, torch.cat((both.mT, around[:, 1]), dim=-1)), dim=1)
                with_neighbours = towards @ beside
                crossed[before] = with_neighbours[..., :k].mT
                crossed[here] = with_neighbours[..., k:]
            else:
                with_neighbours = towards @ around[:, 0]
            found[here] = inverse + with_neighbours @ towards.mT
    return found[place]
