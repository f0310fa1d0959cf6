"""Planes: the best fit, how flat points are, and where rays meet the road (IV-B, IV-C)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.geometry import se3


def fit_plane(
    points: Float[Tensor, "*batch n 3"], weight: Float[Tensor, "*batch n"] | None = None
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"], Float[Tensor, "*batch"]]:
    """Centroid, unit normal and smallest singular value of the best plane (IV-B, and J in IV-C).

    The singular value is that of the scatter matrix: the weighted sum of squared distances from the
    plane. The sign of the normal is free, and so is its direction where the points lie on a line.
    Rows that are padding have weight 0.
    """
    centroid, S = scatter(points, weight)
    eigenvalue, V = torch.linalg.eigh(S)
    return centroid, V[..., :, 0], eigenvalue[..., 0].clamp_min(0)


def scatter(
    points: Float[Tensor, "*batch n 3"], weight: Float[Tensor, "*batch n"] | None = None
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3 3"]]:
    """Weighted mean mu and scatter matrix, the sum of w (p - mu)(p - mu)^T (IV-C)."""
    weight = torch.ones_like(points[..., 0]) if weight is None else weight
    total = weight.sum(-1)[..., None]
    mu = (weight[..., None] * points).sum(-2) / torch.where(total > 0, total, 1.0)
    centred = points - mu[..., None, :]
    return mu, (weight[..., None] * centred).mT @ centred


def smallest_singular_value(S: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """The paper's J: the sum of squared distances from the best plane (IV-C, eq:rne)."""
    return torch.linalg.eigvalsh(S)[..., 0]


def harmonic_mean_singular_value(S: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch"]:
    """The paper's cheaper surrogate, the harmonic mean of the three singular values (IV-C)."""
    a, b, c, _, d, e, _, _, f = S.flatten(-2).unbind(-1)
    minors = (a * d - b * b) + (a * f - c * c) + (d * f - e * e)
    det = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    regular = minors > torch.finfo(S.dtype).tiny
    return torch.where(regular, 3 * det / torch.where(regular, minors, 1.0), 0.0)


def ground_points(
    ray_camera: Float[Tensor, "*#batch 3"],
    h_camera: Float[Tensor, "*#batch 3"],
    T_world_camera: Float[Tensor, "*#batch 4 4"],
) -> Float[Tensor, "*#batch 3"]:
    """World points where rays meet the road plane (IV-C, eq:ipm).

    `h_camera` points from the camera to the road along its normal; its length is the camera height
    [m]. Rays need no normalisation but must look below the horizon: `h_camera . ray_camera > 0`.
    """
    depth = h_camera.square().sum(-1) / (h_camera * ray_camera).sum(-1)
    return se3.transform(T_world_camera, ray_camera * depth[..., None])
