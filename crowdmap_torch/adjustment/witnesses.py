"""Whom an adjusted map has its signs from: drives whose detections fit it (V-B)."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.clustering.groups import distinct_pairs, group_count
from crowdmap_torch.optim.linearize import residuals

_FITS = 0.5
"""Least weight of a detection that says where its sign is."""


@torch.no_grad()
def witnesses(bundle: Bundle, trusted: Bool[Tensor, " j"]) -> Int[Tensor, " n"]:
    """Of every sign how many journeys that are `trusted` have a detection of it that keeps most of its weight.

    What is given up, too far off or drawn as another shape places no sign.
    """
    rows, signs = bundle.corners, len(bundle.values()["sign"])
    term = bundle.problem().terms.get("sign_reprojection")
    if term is None:
        return torch.zeros(signs, dtype=torch.long, device=trusted.device)
    squared = residuals(term, bundle.values()).square().sum(-1)
    fits = (term.loss.weight(squared) >= _FITS) & trusted[rows.journey]
    sign, _, _ = distinct_pairs(rows.sign[fits], rows.journey[fits])
    return group_count(sign, signs)
