"""Labels compared as what they put together."""

from __future__ import annotations

from jaxtyping import Int
from torch import Tensor

from crowdmap_torch.clustering.spectral import renumber


def same_partition(a: Int[Tensor, " n"], b: Int[Tensor, " n"]) -> bool:
    """True if two labellings group the rows alike, whatever the names of the groups."""
    return bool((renumber(a) == renumber(b)).all())
