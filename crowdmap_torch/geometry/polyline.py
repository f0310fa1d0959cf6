"""Polylines of a fixed number of points: robust lines and parabolas through ragged points, and how far polylines are apart."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

REWEIGHTINGS = 4


def sampled_curves(
    point: Float[Tensor, "m 2"],
    group: Int[Tensor, " m"],
    count: int,
    *,
    samples: int,
    degree: int,
    scale: float,
) -> tuple[Float[Tensor, "count samples 2"], Bool[Tensor, " count"]]:
    """Points along the robust curve through each group of points, and which groups have one (two points or more).

    The curve is a polynomial of the `degree` over the group's main axis; points more than a few `scale` off it lose their
    weight. The points run from the lower end of the second coordinate to the upper one, equally spaced along the axis.
    """
    weight = torch.ones_like(point[:, 0])
    for _ in range(2):
        # The axis of a line with an outlier at its end is turned: once more without it.
        mean, axis = _main_axis(point, weight, group, count)
        offset = point - mean[group]
        along = (offset * axis[group]).sum(-1)
        across = offset[:, 0] * -axis[group, 1] + offset[:, 1] * axis[group, 0]
        reach = _extreme(along.abs(), group, count, "amax").clamp_min(1e-9)
        unit = along / reach[group]
        basis = torch.stack([unit**k for k in range(degree + 1)], dim=-1)
        coefficients, weight = _robust_fit(basis, across, weight, group, count, scale)
    kept = weight > 0.1
    big = torch.finfo(point.dtype).max
    low = _extreme(torch.where(kept, unit, big), group, count, "amin")
    high = _extreme(torch.where(kept, unit, -big), group, count, "amax")
    number = torch.bincount(group[kept], minlength=count)
    usable = (number >= 2) & (high > low)
    low, high = (torch.where(usable, x, torch.zeros_like(x)) for x in (low, high))
    share = torch.linspace(0, 1, samples, dtype=point.dtype, device=point.device)
    at = low[:, None] + (high - low)[:, None] * share
    powers = torch.stack([at**k for k in range(degree + 1)], dim=-1)
    lateral = (powers * coefficients[:, None]).sum(-1)
    normal = torch.stack((-axis[:, 1], axis[:, 0]), dim=-1)
    curve = (
        mean[:, None]
        + (at * reach[:, None])[..., None] * axis[:, None]
        + lateral[..., None] * normal[:, None]
    )
    return curve, usable


def distance_to_polyline(
    point: Float[Tensor, "b n 2"], line: Float[Tensor, "b m 2"]
) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b n"]]:
    """Distance of points to polylines whose first and last pieces run on, and how far beyond an end the foot lies."""
    start, step = line[:, :-1], line[:, 1:] - line[:, :-1]
    length_sq = step.square().sum(-1).clamp_min(1e-12)
    offset = point[:, :, None] - start[:, None]
    along = (offset * step[:, None]).sum(-1) / length_sq[:, None]
    low = torch.zeros_like(length_sq)
    high = torch.ones_like(length_sq)
    low[:, 0], high[:, -1] = -torch.inf, torch.inf
    foot = torch.minimum(torch.maximum(along, low[:, None]), high[:, None])
    distance_sq = (offset - foot[..., None] * step[:, None]).square().sum(-1)
    nearest = distance_sq.argmin(-1, keepdim=True)
    distance = distance_sq.gather(-1, nearest)[..., 0].sqrt()
    at = foot.gather(-1, nearest)[..., 0]
    length = length_sq.sqrt()[:, None].expand_as(foot).gather(-1, nearest)[..., 0]
    beyond = torch.maximum(-at, at - 1).clamp_min(0) * length
    return distance, beyond


def _main_axis(
    point: Float[Tensor, "m 2"], weight: Float[Tensor, " m"], group: Int[Tensor, " m"], count: int
) -> tuple[Float[Tensor, "count 2"], Float[Tensor, "count 2"]]:
    """Weighted mean, and the unit direction of largest spread, its second coordinate not negative."""
    total = weight.new_zeros(count).index_add(0, group, weight).clamp_min(1e-9)
    mean = point.new_zeros(count, 2).index_add(0, group, weight[:, None] * point) / total[:, None]
    x, y = (point - mean[group]).unbind(-1)
    moments = torch.stack((x * x - y * y, 2 * x * y), dim=-1) * weight[:, None]
    c, s = point.new_zeros(count, 2).index_add(0, group, moments).unbind(-1)
    angle = torch.atan2(s, c) / 2
    axis = torch.stack((angle.cos(), angle.sin()), dim=-1)
    return mean, torch.where(axis[:, 1:] < 0, -axis, axis)


def _robust_fit(
    basis: Float[Tensor, "m k"],
    value: Float[Tensor, " m"],
    weight: Float[Tensor, " m"],
    group: Int[Tensor, " m"],
    count: int,
    scale: float,
) -> tuple[Float[Tensor, "count k"], Float[Tensor, " m"]]:
    """Least squares of each group by Cauchy weights, ridged where the points are too few; and the last weights."""
    k = basis.shape[-1]
    ridge = 1e-6 * torch.eye(k, dtype=basis.dtype, device=basis.device)
    # Higher powers need more points to be trusted.
    ridge = ridge + torch.diag(torch.tensor([0.0, 0.0, 0.05][:k]).to(basis))
    coefficients = basis.new_zeros(count, k)
    for _ in range(REWEIGHTINGS):
        weighted = weight[:, None] * basis
        A = basis.new_zeros(count, k, k).index_add(
            0, group, weighted[:, :, None] * basis[:, None, :]
        )
        b = basis.new_zeros(count, k).index_add(0, group, weighted * value[:, None])
        coefficients = torch.linalg.solve(A + ridge, b)
        error = value - (basis * coefficients[group]).sum(-1)
        weight = 1 / (1 + (error / scale).square())
    return coefficients, weight


def _extreme(
    value: Float[Tensor, " m"], group: Int[Tensor, " m"], count: int, reduce: str
) -> Float[Tensor, " count"]:
    return value.new_zeros(count).scatter_reduce(0, group, value, reduce, include_self=False)
