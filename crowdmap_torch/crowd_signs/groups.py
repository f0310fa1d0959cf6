"""Which journeys signs tie together (V-B)."""

from __future__ import annotations

from jaxtyping import Int
from torch import Tensor

from crowdmap_torch.crowd_signs.align import connected_journeys, in_shared_clusters
from crowdmap_torch.crowd_signs.register import Crowd


def groups_of(crowd: Crowd) -> Int[Tensor, " j"]:
    """By journey the group that it is in: those of one group saw signs in common, by one or several steps.

    Bad drives tie nobody to anybody, and are groups of their own.
    """
    journey, label = crowd.members.journey, crowd.label
    label = label.masked_fill(crowd.journey_weight[journey] == 0, -1)
    used = in_shared_clusters(journey, label)
    return connected_journeys(journey[used], label[used], len(crowd.bias))
