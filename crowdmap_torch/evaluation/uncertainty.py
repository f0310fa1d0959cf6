"""Whether a map's covariances are honest (METRICS.md, Uncertainty)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.evaluation.signs import SignComparison
from crowdmap_torch.evaluation.statistics import share
from crowdmap_torch.geometry.covariances import at_least
from crowdmap_torch.tables import Signs

_CHI2_3_95 = 7.814727903251179
"""95 % quantile of chi-squared with three degrees of freedom."""


_LEAST_SIGMA_M = 1e-6
"""No position is surer: a covariance may have lost its positive definiteness to rounding."""
_NEWTON_STEPS = 60


@dataclass(frozen=True)
class UncertaintyFigures:
    """Errors in units of their own covariance."""

    signs: int
    """Matched observable signs with a covariance."""
    coverage: float
    """Share whose centre, the mean shift taken off, lies in the 95 % ellipsoid that is right for what is left then. NaN
    for fewer than two: a single sign is its own mean."""
    mean_nees: float
    """Mean normalised squared error of those centres; 3 is right, however few they are. Of n signs it rests on 3 (n - 1)
    degrees of freedom. NaN for fewer than two."""
    shared_nees: float
    """Normalised squared error of the mean shift; chi-squared with three degrees of freedom if
    the map is honest: 0.22 to 9.35 in 95 % of data sets. NaN if the map has no shared part."""


def evaluate_uncertainty(
    comparison: SignComparison,
    signs: Signs,
    shared_covariance: Float[Tensor, "3 3"],
    survey_sigma: Float[Tensor, " n"] | None = None,
) -> UncertaintyFigures:
    """Figures of the matched observable signs' centre errors against their covariances.

    `survey_sigma` [m] of the survey's signs is added where the survey itself is not exact.
    """
    c = comparison
    row, true_row = c.map_row[c.counted], c.true_row[c.counted]
    error = c.center_error_world[c.counted, 0]
    shared = shared_covariance.to(signs.covariance)
    is_known = signs.covariance.isfinite().all(-1).all(-1)
    is_known &= signs.covariance.diagonal(dim1=-2, dim2=-1).gt(0).all(-1)
    has_shared = float(shared.diagonal().min()) > 0
    left = signs.covariance - shared
    common = _common_of_own(left[is_known]) if has_shared else torch.zeros_like(shared)
    own = at_least(left[row] + common, _LEAST_SIGMA_M)
    if survey_sigma is not None:
        eye = torch.eye(3, dtype=own.dtype, device=own.device)
        own = own + survey_sigma[true_row].square()[:, None, None] * eye
    known = is_known[row] & own.isfinite().all(-1).all(-1) & error.isfinite().all(-1)
    own, error = own[known], error[known]
    n = len(own)
    if n == 0:
        return UncertaintyFigures(0, math.nan, math.nan, math.nan)
    shift, of_mean = error.mean(0), own.sum(0) / n**2
    coverage = mean_nees = shared_nees = math.nan
    if n > 1:
        # Every error is a part of the mean that is taken off it.
        nees = _squared(error - shift, own * (1 - 2 / n) + of_mean)
        coverage, mean_nees = share(int((nees <= _CHI2_3_95).sum()), n), float(nees.mean())
    if has_shared:
        of_shift = at_least((shared - common + of_mean)[None], _LEAST_SIGMA_M)
        shared_nees = float(_squared(shift[None], of_shift))
    return UncertaintyFigures(n, coverage, mean_nees, shared_nees)


def _common_of_own(left: Float[Tensor, "n 3 3"]) -> Float[Tensor, "3 3"]:
    """How much of the shared part of a map is of what its signs have each for itself.

    The shared part is the covariance of the best mean of all positions; `left` is by how much each sign's own exceeds it.
    Errors of covariance D_i that signs have each for itself leave H = inverse(sum of inverse(D_i)) in that mean: little
    where signs are many, and nearly all of D_i for one that is much surer than the others. H is found by Newton's
    method such that D_i = left_i + H; it comes from above, since H - inverse(sum of inverse(left_i + H)) is convex.
    """
    if len(left) < 2:
        return left.new_zeros(3, 3)
    left = at_least(left, _LEAST_SIGMA_M)
    H, eye = left.mean(0) / (len(left) - 1), torch.eye(9, dtype=left.dtype, device=left.device)
    for _ in range(_NEWTON_STEPS):
        inverse = torch.linalg.inv(left + H)
        parallel = torch.linalg.inv(inverse.sum(0))
        if not bool((H - parallel).abs().max() > 1e-9 * H.diagonal().max()):
            break
        by_each = parallel @ inverse
        slope = torch.einsum("nij,nlk->ikjl", by_each, by_each.mT).reshape(9, 9)
        H = H - torch.linalg.solve(eye - slope, (H - parallel).reshape(9)).reshape(3, 3)
        H = (H + H.mT) / 2
    return H


def _squared(
    error: Float[Tensor, "n 3"], covariance: Float[Tensor, "n 3 3"]
) -> Float[Tensor, " n"]:
    solved = torch.linalg.solve(covariance, error[..., None])[..., 0]
    return (error * solved).sum(-1)
