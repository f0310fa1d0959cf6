"""What each round of registration changed (V-A.1), for reports."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Int
from torch import Tensor

from crowdmap_torch.clustering.groups import distinct_pairs


@dataclass(frozen=True)
class CrowdRound:
    """One alternation of clustering and alignment."""

    shift_sigma: float
    """Uncertainty of the journeys' shifts that it assumed [m]; 0 with `paper2017`."""
    clusters: int
    singles: int
    """Signs in no cluster."""
    changed: int
    """Signs that left the cluster most of their companions are in, or came to it."""


def crowd_round(
    shift_sigma: float, before: Int[Tensor, " n"], after: Int[Tensor, " n"]
) -> CrowdRound:
    """From the labels of signs before and after it."""
    now, then, size = distinct_pairs(after, before)
    clusters = int(after.max()) + 1 if len(after) else 0
    # Of the members of each cluster, those that were together before; a label of -1 was no company.
    together = (now >= 0) == (then >= 0)
    main = size.new_zeros(clusters + 1)
    main = main.scatter_reduce(0, now[together] + 1, size[together], "amax")
    return CrowdRound(
        shift_sigma=shift_sigma,
        clusters=clusters,
        singles=int((after < 0).sum()),
        changed=len(after) - int(main.sum()),
    )
