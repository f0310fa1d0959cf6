"""Selected blocks of the inverse of A: the covariances of eliminated blocks, all that stays held.

With W_j, V_j of `block_elimination` and P_j = W_j^T V_j the block of an eliminated j follows from those of its neighbours n:

    (A^-1)_jj = D_j^-1 + P_j (A^-1)_nn P_j^T        (A^-1)_jn = P_j (A^-1)_nn

From the last round to the first; what two neighbours have in common is known once the later one is (Takahashi, Fagan and
Chen 1973).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.optim.solvers.block_elimination import leads_of
from crowdmap_torch.optim.solvers.elimination import ChainStructure
from crowdmap_torch.optim.solvers.parts import Part


def diagonal_of_inverse(
    structure: ChainStructure, diagonal: Float[Tensor, "e k k"], link: Float[Tensor, "e k k"]
) -> Float[Tensor, "e k k"]:
    """Diagonal blocks of the inverse of A."""
    found = torch.empty_like(diagonal)
    for part in structure.parts:
        found[part.block] = _of_part(part, *part.by_place(diagonal, link))
    return found


def _of_part(
    part: Part, diagonal: Float[Tensor, "p k k"], link: Float[Tensor, "p k k"]
) -> Float[Tensor, "n k k"]:
    """The same of a part's blocks, by their blocks by place, which are changed."""
    k = diagonal.shape[-1]
    leads = leads_of(part.rounds, diagonal, link)
    found = torch.zeros_like(diagonal)
    # With the block that follows, of those known so far.
    crossed = torch.zeros_like(found)
    for of_round, lead in zip(reversed(part.rounds), reversed(leads), strict=True):
        inverse, towards = lead.whiten.mT @ lead.whiten, lead.whiten.mT @ lead.towards
        around = found[of_round.neighbour]
        if of_round.neighbour.shape[1] == 2:
            before = of_round.neighbour[:, 0]
            both = crossed[before]
            upper = torch.cat((around[:, 0], both), dim=-1)
            beside = torch.cat((upper, torch.cat((both.mT, around[:, 1]), dim=-1)), dim=1)
            with_neighbours = towards @ beside
            crossed[before] = with_neighbours[..., :k].mT
            crossed[of_round.place] = with_neighbours[..., k:]
        else:
            with_neighbours = towards @ around[:, 0]
        found[of_round.place] = inverse + with_neighbours @ towards.mT
    return found[part.place]
