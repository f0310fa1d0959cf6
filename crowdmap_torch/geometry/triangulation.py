"""The point nearest to many rays (IV-B), for many points at once."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

_SINGULAR_BELOW = 1e-12


def midpoint_ragged(
    origin: Float[Tensor, "m 3"],
    ray: Float[Tensor, "m 3"],
    group: Int[Tensor, " m"],
    count: int,
    weight: Float[Tensor, " m"] | None = None,
) -> tuple[Float[Tensor, "count 3"], Float[Tensor, " count"]]:
    """Of each of `count` groups the point nearest to its rays, and how well the rays' directions differ.

    The point has the least weighted sum of squared distances to the rays (mid-point, IV-B), which need no
    normalisation. Where all rays are parallel, of the line of solutions the point nearest to the mean
    origin is returned. It may lie behind the cameras: that is for the caller to test.

    The second result is the smallest eigenvalue of the normal equations over the total weight, the
    mean of sin^2 of the angle to the most common direction: `sin(a / 2)^2` for two rays at angle a,
    0 for parallel rays and empty groups.
    """
    weight = torch.ones_like(ray[:, 0]) if weight is None else weight
    total = weight.new_zeros(count).index_add(0, group, weight)
    total = torch.where(total > 0, total, 1.0)
    centre = origin.new_zeros(count, 3).index_add(0, group, weight[:, None] * origin)
    centre = centre / total[:, None]
    direction = torch.nn.functional.normalize(ray, dim=-1)
    identity = torch.eye(3, dtype=ray.dtype, device=ray.device)
    A = weight[:, None, None] * (identity - direction[:, :, None] * direction[:, None, :])
    b = (A @ (origin - centre[group])[..., None])[..., 0]
    A_group = origin.new_zeros(count, 3, 3).index_add(0, group, A) / total[:, None, None]
    b_group = origin.new_zeros(count, 3).index_add(0, group, b) / total[:, None]
    eigenvalue, V = torch.linalg.eigh(A_group)
    # The solution of least norm: along the rays where all are parallel nothing is known.
    regular = eigenvalue > _SINGULAR_BELOW
    inverse = torch.where(regular, 1 / torch.where(regular, eigenvalue, 1.0), 0.0)
    along = (V.mT @ b_group[..., None])[..., 0]
    return centre + (V @ (inverse * along)[..., None])[..., 0], eigenvalue[:, 0].clamp_min(0)
