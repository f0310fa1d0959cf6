"""Whether a map's covariances are honest (METRICS.md, Uncertainty)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.evaluation.signs import SignComparison
from crowdmap_torch.evaluation.statistics import share
from crowdmap_torch.tables import Signs

_CHI2_3_95 = 7.814727903251179
"""95 % quantile of chi-squared with three degrees of freedom."""


@dataclass(frozen=True)
class UncertaintyFigures:
    """Errors in units of their own covariance."""

    signs: int
    """Matched observable signs with a covariance."""
    coverage: float
    """Share whose centre, the mean shift taken off, lies in the 95 % ellipsoid without the
    shared part."""
    mean_nees: float
    """Mean normalised squared error of those centres; 3 is right."""
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
    own = signs.covariance[row] - shared_covariance.to(signs.covariance)
    if survey_sigma is not None:
        eye = torch.eye(3, dtype=own.dtype, device=own.device)
        own = own + survey_sigma[true_row].square()[:, None, None] * eye
    known = own.isfinite().all(-1).all(-1) & error.isfinite().all(-1)
    known &= signs.covariance[row].diagonal(dim1=-2, dim2=-1).gt(0).all(-1)
    own, error = own[known], error[known]
    if len(own) == 0:
        return UncertaintyFigures(0, math.nan, math.nan, math.nan)
    shift = error.mean(0)
    # The mean of n independent errors has 1/n of their mean covariance beside the part they share.
    of_shift = shared_covariance.to(own) + own.mean(0) / len(own)
    # A covariance that lost its positive definiteness to rounding would otherwise count as inside
    # by a negative square.
    own = _at_least(own, 1e-6)
    nees = _squared(error - shift, own)
    has_shared = float(shared_covariance.diagonal().min()) > 0
    return UncertaintyFigures(
        signs=len(own),
        coverage=share(int((nees <= _CHI2_3_95).sum()), len(own)),
        mean_nees=float(nees.mean()),
        shared_nees=float(_squared(shift[None], _at_least(of_shift[None], 1e-6)))
        if has_shared
        else math.nan,
    )


def _squared(
    error: Float[Tensor, "n 3"], covariance: Float[Tensor, "n 3 3"]
) -> Float[Tensor, " n"]:
    solved = torch.linalg.solve(covariance, error[..., None])[..., 0]
    return (error * solved).sum(-1)


def _at_least(covariance: Float[Tensor, "n 3 3"], sigma_m: float) -> Float[Tensor, "n 3 3"]:
    value, vector = torch.linalg.eigh((covariance + covariance.mT) / 2)
    return (vector * value.clamp_min(sigma_m**2)[..., None, :]) @ vector.mT
