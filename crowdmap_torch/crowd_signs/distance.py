"""How far two landmarks are from being one sign: in place, in units of what is uncertain, and in how they look."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.ranges import Cost, Degrees, Settings, Sigma
from crowdmap_torch.tables import Signs

NEVER = torch.inf
"""Distance of signs that cannot be one."""


@dataclass(frozen=True)
class SimilarityConfig(Settings):
    """What differences of appearance cost, in squared standard deviations."""

    shape_cost: Cost = 7.0
    """Different shapes: detectors take one for another in a few percent of the tracklets, `-2 log 0.03`."""
    type_cost: Cost = 7.0
    """Different traffic-sign codes, both known."""
    size_sigma: Sigma = 0.12
    """1-sigma of a measured width or height, relative."""
    size_cost_limit: Cost = 5.0
    """Most that a difference in size can cost; with a wrong shape the size means something else."""
    normal_sigma_deg: Sigma = 12.0
    """1-sigma of the direction a sign is measured to face."""
    normal_limit_deg: Degrees = 75.0
    """Signs that face directions further apart are never one: back to back, or one for each street of a crossing."""


def appearance_distance(a: Signs, b: Signs, config: SimilarityConfig) -> Float[Tensor, " p"]:
    """Squared distance between rows of `a` and `b` in shape, type, size and facing direction; infinite if never one."""
    cost = config.shape_cost * (a.shape != b.shape).to(a.size)
    both_known = (a.type >= 0) & (b.type >= 0)
    cost = cost + config.type_cost * (both_known & (a.type != b.type)).to(a.size)
    ratio = (a.size.clamp_min(1e-3) / b.size.clamp_min(1e-3)).log()
    size = ratio.square().sum(-1) / (2 * config.size_sigma**2)
    cost = cost + size.clamp_max(config.size_cost_limit)
    cosine = (a.normal_world * b.normal_world).sum(-1).clamp(-1, 1)
    angle = torch.rad2deg(torch.acos(cosine))
    # Both directions are measured, hence twice the variance.
    cost = cost + angle.square() / (2 * config.normal_sigma_deg**2)
    return torch.where(angle > config.normal_limit_deg, NEVER, cost)


def mahalanobis(
    offset: Float[Tensor, "*batch 3"], covariance: Float[Tensor, "*batch 3 3"]
) -> Float[Tensor, " *batch"]:
    """Squared length of `offset` in standard deviations."""
    factor = torch.linalg.cholesky(covariance)
    whitened = torch.linalg.solve_triangular(factor, offset[..., None], upper=False)
    return whitened[..., 0].square().sum(-1)


def sign_distance(
    a: Signs,
    b: Signs,
    pair: Int[Tensor, "p 2"],
    config: SimilarityConfig,
    sigma: Float[Tensor, " 3"],
) -> Float[Tensor, " p"]:
    """Squared distance, in place and appearance, of the rows of `a` and `b` that `pair` names.

    `sigma` [m] is what the covariances leave out, along east, north and up: the uncertainty of the journeys' shifts.
    """
    first, second = a[pair[:, 0]], b[pair[:, 1]]
    covariance = first.covariance + second.covariance + torch.diag(sigma.square())
    place = mahalanobis(first.center_world - second.center_world, covariance)
    return place + appearance_distance(first, second, config)
