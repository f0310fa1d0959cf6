"""The point nearest to many rays (IV-B), for many points at once."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

_SINGULAR_BELOW = 1e-12


def midpoint(
    origin: Float[Tensor, "*batch n 3"],
    ray: Float[Tensor, "*batch n 3"],
    weight: Float[Tensor, "*batch n"] | None = None,
) -> Float[Tensor, "*batch 3"]:
    """The point with the least weighted sum of squared distances to rays (mid-point, IV-B).

    Rays need no normalisation. Rows that are padding have weight 0. Where all rays are parallel, of
    the line of solutions the point nearest to the mean origin is returned. It may lie behind the
    cameras: that is for the caller to test.
    """
    weight = torch.ones_like(ray[..., 0]) if weight is None else weight
    total = _positive(weight.sum(-1))
    centre = (weight[..., None] * origin).sum(-2) / total[..., None]
    A, b = _normal_equations(origin - centre[..., None, :], ray, weight)
    point, _ = _solve(A.sum(-3), b.sum(-2), total)
    return centre + point


def midpoint_ragged(
    origin: Float[Tensor, "m 3"],
    ray: Float[Tensor, "m 3"],
    group: Int[Tensor, " m"],
    count: int,
    weight: Float[Tensor, " m"] | None = None,
) -> tuple[Float[Tensor, "count 3"], Float[Tensor, " count"]]:
    """`midpoint` of each of `count` groups of rays, and how well the rays' directions differ.

    The second result is the smallest eigenvalue of the normal equations over the total weight, the
    mean of sin^2 of the angle to the most common direction: `sin(a / 2)^2` for two rays at angle a,
    0 for parallel rays and empty groups.
    """
    weight = torch.ones_like(ray[:, 0]) if weight is None else weight
    total = _positive(weight.new_zeros(count).index_add(0, group, weight))
    centre = origin.new_zeros(count, 3).index_add(0, group, weight[:, None] * origin)
    centre = centre / total[:, None]
    A, b = _normal_equations(origin - centre[group], ray, weight)
    A_group = origin.new_zeros(count, 3, 3).index_add(0, group, A)
    b_group = origin.new_zeros(count, 3).index_add(0, group, b)
    point, smallest = _solve(A_group, b_group, total)
    return centre + point, smallest


def _positive(total: Tensor) -> Tensor:
    return torch.where(total > 0, total, torch.ones_like(total))


def _normal_equations(origin: Tensor, ray: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    direction = torch.nn.functional.normalize(ray, dim=-1)
    identity = torch.eye(3, dtype=ray.dtype, device=ray.device)
    across = identity - direction[..., :, None] * direction[..., None, :]
    A = weight[..., None, None] * across
    return A, (A @ origin[..., None])[..., 0]


def _solve(A: Tensor, b: Tensor, total: Tensor) -> tuple[Tensor, Tensor]:
    """Least-norm solution and smallest eigenvalue of systems that are divided by `total` first."""
    eigenvalue, V = torch.linalg.eigh(A / total[..., None, None])
    regular = eigenvalue > _SINGULAR_BELOW
    inverse = torch.where(regular, 1 / torch.where(regular, eigenvalue, 1.0), 0.0)
    along = (V.mT @ (b / total[..., None])[..., None])[..., 0]
    return (V @ (inverse * along)[..., None])[..., 0], eigenvalue[..., 0].clamp_min(0)
