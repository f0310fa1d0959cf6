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
    likely: Float[Tensor, " n"],
    squares: Float[Tensor, "n j 3"],
    count: Float[Tensor, "n j 3"],
    variance: Float[Tensor, "n j 3"],
    usual_strength: float,
    trust: float,
) -> tuple[Float[Tensor, "n j"], Float[Tensor, " n"], Float[Tensor, "n j"]]:
    """Variance scales of journeys from sums of squares in units of the given sigmas, the medians of what they may be.

    With them the fleet's `likely` one, anew, and the mean of each journey's over its median; each of `n` kinds of errors
    has scales of its own. `usual_strength` and `trust` are degrees of freedom: those that the fleet's scale counts in a
    journey's, and the given sigmas in the fleet's.
    """
    weight = (count > 0) / variance
    of_common = weight / weight.sum(1, keepdim=True).clamp_min(1e-300)
    freedom = (count * (1 - of_common)).sum(2)
    found, total = squares.sum(2), freedom.sum(1, keepdim=True)
    seen = freedom > 0
    # Inverse chi-squared variances, their median the fleet's. Of it each journey tells by the mean of its inverse:
    # one that is far too bad does not move it.
    likely = likely[:, None]
    strength = _strength(found / likely, freedom, usual_strength)
    centre = strength - 2 / 3
    inverse = (strength + freedom) / (centre * likely + found) * seen
    of_seen = seen.sum(1, keepdim=True) / inverse.sum(1, keepdim=True).clamp_min(1e-300)
    likely = torch.where(total > 0, (strength / centre * of_seen).clamp(*_SCALES_SQUARED), 1.0)
    fleet = likely ** (total / (total + trust))
    own = (centre * fleet + found) / (centre + freedom)
    wider = _mean_over_median(strength, freedom) * _mean_over_median(trust, total)
    return own.clamp(*_SCALES_SQUARED), likely[:, 0], wider


def _strength(
    found: Float[Tensor, "n j"], freedom: Float[Tensor, "n j"], usual: float
) -> Float[Tensor, "n 1"]:
    """Degrees of freedom of the inverse chi-squared variances that journeys have, as their spread shows.

    `found` are sums of so many squares in units of the fleet's median variance. Each, over `nu - 2/3`, is beta-prime with
    half of its own degrees of freedom and half of the `nu` that are asked for (empirical Bayes; Gelman et al., Bayesian
    Data Analysis, 5); those are about the `usual` ones.
    """
    seen = (freedom > 0)[:, None]
    n = torch.where(seen, freedom[:, None], 1.0) / 2
    log = torch.linspace(-3, 1, 9, dtype=found.dtype, device=found.device) * math.log(2)
    nu = (usual * log.exp())[:, None].clamp_min(_LEAST_STRENGTH)
    x = (torch.where(seen, found[:, None], 1.0) / (nu - 2 / 3)).clamp_min(1e-12)
    evidence = (n - 1) * x.log() - (n + nu / 2) * torch.log1p(x) - (nu - 2 / 3).log()
    evidence = evidence + torch.lgamma(n + nu / 2) - torch.lgamma(n) - torch.lgamma(nu / 2)
    total = (evidence * seen).sum(2) - (log / _STRENGTH_SPREAD).square() / 2
    return (torch.softmax(total, 1) * nu[:, 0].log()).sum(1, keepdim=True).exp()


def _mean_over_median(given: float | Tensor, found: Tensor) -> Tensor:
    """Of an inverse chi-squared variance with so many degrees of freedom; 1 where none were found: it is as given."""
    freedom = (given + found).clamp_min(3)
    return torch.where(found > 0, (freedom - 2 / 3) / (freedom - 2), 1.0)
