"""How far the variances of journeys are from those that they are given: each by itself, drawn to what the fleet shows."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

LEAST_SCALE, MOST_SCALE = 0.1, 10.0
"""Sigmas are never taken for further from those that are given."""
_SCALES_SQUARED = (LEAST_SCALE**2, MOST_SCALE**2)
_LEAST_STRENGTH = 3.0
"""With fewer degrees of freedom a variance has no mean worth the name."""
_STRENGTH_SPREAD = 1.0
"""1-sigma of the logarithm of the journeys' degrees of freedom about the usual ones."""


def pooled(
    likely: Float[Tensor, ""],
    squares: Float[Tensor, "j 3"],
    count: Float[Tensor, "j 3"],
    variance: Float[Tensor, "j 3"],
    usual_strength: float,
    trust: float,
) -> tuple[Float[Tensor, " j"], Float[Tensor, ""], Float[Tensor, " j"]]:
    """Variance scales of journeys from sums of squares in units of the given sigmas, the medians of what they may be.

    With them the fleet's `likely` one, anew, and the mean of each journey's over its median. `usual_strength` and
    `trust` are degrees of freedom: those that the fleet's scale counts in a journey's, and the given sigmas in the fleet's.
    """
    weight = (count > 0) / variance
    of_common = weight / weight.sum(0).clamp_min(1e-300)
    freedom = (count * (1 - of_common)).sum(1)
    found, total = squares.sum(1), freedom.sum()
    seen = freedom > 0
    # Inverse chi-squared variances, their median the fleet's. Of it each journey tells by the mean of its inverse:
    # one that is far too bad does not move it.
    strength = _strength(found / likely, freedom, usual_strength)
    centre = strength - 2 / 3
    inverse = (strength + freedom) / (centre * likely + found) * seen
    likely = strength / centre * seen.sum() / inverse.sum().clamp_min(1e-300)
    likely = torch.where(total > 0, likely.clamp(*_SCALES_SQUARED), 1.0)
    fleet = likely ** (total / (total + trust))
    own = (centre * fleet + found) / (centre + freedom)
    wider = _mean_over_median(strength, freedom) * _mean_over_median(trust, total)
    return own.clamp(*_SCALES_SQUARED), likely, wider


def _strength(
    found: Float[Tensor, " j"], freedom: Float[Tensor, " j"], usual: float
) -> Float[Tensor, ""]:
    """Degrees of freedom of the inverse chi-squared variances that journeys have, as their spread shows.

    `found` are sums of so many squares in units of the fleet's median variance. Each, over `nu - 2/3`, is beta-prime with
    half of its own degrees of freedom and half of the `nu` that are asked for (empirical Bayes; Gelman et al., Bayesian
    Data Analysis, 5); those are about the `usual` ones.
    """
    seen = freedom > 0
    n = torch.where(seen, freedom, 1.0) / 2
    log = torch.linspace(-3, 1, 9, dtype=found.dtype, device=found.device) * math.log(2)
    nu = (usual * log.exp())[:, None].clamp_min(_LEAST_STRENGTH)
    x = (torch.where(seen, found, 1.0) / (nu - 2 / 3)).clamp_min(1e-12)
    evidence = (n - 1) * x.log() - (n + nu / 2) * torch.log1p(x) - (nu - 2 / 3).log()
    evidence = evidence + torch.lgamma(n + nu / 2) - torch.lgamma(n) - torch.lgamma(nu / 2)
    total = (evidence * seen).sum(1) - (log / _STRENGTH_SPREAD).square() / 2
    return (torch.softmax(total, 0) * nu[:, 0].log()).sum().exp()


def _mean_over_median(given: float | Tensor, found: Tensor) -> Tensor:
    """Of an inverse chi-squared variance with so many degrees of freedom; 1 where none were found: it is as given."""
    freedom = (given + found).clamp_min(3)
    return torch.where(found > 0, (freedom - 2 / 3) / (freedom - 2), 1.0)
