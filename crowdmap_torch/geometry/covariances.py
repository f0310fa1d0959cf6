"""Covariances that rounding, or a difference of two, has left with less than nothing along some axis."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def at_least(covariance: Float[Tensor, "n 3 3"], sigma_m: float) -> Float[Tensor, "n 3 3"]:
    """Symmetric matrices with a 1-sigma of at least `sigma_m` metres along every axis, their axes kept [m^2]."""
    value, vector = torch.linalg.eigh((covariance + covariance.mT) / 2)
    return (vector * value.clamp_min(sigma_m**2)[..., None, :]) @ vector.mT
