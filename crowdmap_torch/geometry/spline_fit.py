"""Least-squares fits of natural cubic splines, and their points nearest to given ones (IV-D)."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.geometry.spline_basis import (
    evaluate_flat,
    from_coefficients_flat,
    rows,
    starts,
    to_coefficients_flat,
    window_flat,
    window_with_curvature,
)

_LEAST_BENDING = 1e-9
"""Price of bending that is always charged, per point: it decides where no point does."""
_TRACE = 1e-13
"""Of the normal equations' size, added to their diagonal."""
_SAMPLES_PER_KNOT, _NEWTON_STEPS = 4, 6
"""Where the search for the nearest point starts, and how far it goes."""
_CHUNK_POINTS = 1 << 22
"""Samples compared at once when the nearest point is searched for."""


def fit_flat(
    points: Float[Tensor, "m k"],
    spline: Int[Tensor, " m"],
    t: Float[Tensor, " m"],
    count: Int[Tensor, " n"],
) -> Float[Tensor, "c k"]:
    """Packed control points of n splines fitted to points at known parameters.

    `spline` says whose each point is.
    A spline without points, or with all of them at one parameter, is determined only as far as
    least bending goes; the caller prunes.
    """
    if not len(count):
        return points.new_zeros(0, points.shape[-1])
    n, longest = len(count), int(count.max())
    spline_of_row, rank = rows(count)
    # Relative to the mean, the trace pulls nothing and kilometres from the origin cost no digits.
    number = torch.bincount(spline, minlength=n).clamp_min(1).to(points)
    mean = points.new_zeros(n, points.shape[-1]).index_add(0, spline, points) / number[:, None]

    zero = torch.zeros_like(count[spline])
    index, w, _ = window_flat(t, zero, count[spline])
    square = w[:, :, None] * w[:, None, :]
    cell = (spline[:, None, None] * longest + index[:, :, None]) * longest + index[:, None, :]
    normal = points.new_zeros(n * longest * longest).index_add(0, cell.flatten(), square.flatten())
    rhs_cell = (spline[:, None] * longest + index).flatten()
    pull = w[..., None] * (points - mean[spline])[:, None]
    rhs = points.new_zeros(n * longest, points.shape[-1]).index_add(0, rhs_cell, pull.flatten(0, 1))

    normal = normal.reshape(n, longest, longest)
    price = _LEAST_BENDING * number
    normal = normal + price[:, None, None] * bending(count, longest, points)
    # Ones in the slots past a spline's end; elsewhere a trace against rounding, where points do not
    # even fix a line.
    slot = torch.arange(longest, device=count.device)
    trace = _TRACE * (number + price)[:, None]
    normal = normal + torch.diag_embed(torch.where(slot < count[:, None], trace, 1.0))
    factor, _ = torch.linalg.cholesky_ex(normal)
    coefficient = torch.cholesky_solve(rhs.reshape(n, longest, -1), factor)
    coefficient = coefficient[spline_of_row, rank] + mean[spline_of_row]
    return from_coefficients_flat(coefficient, count)


def refine_flat(
    points: Float[Tensor, "m k"],
    spline: Int[Tensor, " m"],
    control: Float[Tensor, "c k"],
    count: Int[Tensor, " n"],
    *,
    refinements: int = 3,
) -> Float[Tensor, "c k"]:
    """Control points fitted again, each point moved to the parameter nearest to it."""
    for _ in range(refinements):
        t = closest_parameter_flat(control, count, points, spline)
        control = fit_flat(points, spline, t, count)
    return control


def principal_parameter(
    points: Float[Tensor, "m k"], spline: Int[Tensor, " m"], count: Int[Tensor, " n"]
) -> Float[Tensor, " m"]:
    """Parameters in 0 .. C - 1 that are linear along the principal axis of each spline's points.

    The axis points towards increasing first coordinate, or second, or third where those before
    vanish.
    """
    n = len(count)
    along = along_principal_axis(points, spline, n)
    low = _reduce(along, spline, n, "amin")[spline]
    high = _reduce(along, spline, n, "amax")[spline]
    length = torch.where(high > low, high - low, 1.0)
    return (along - low) / length * (count[spline] - 1)


def along_principal_axis(
    points: Float[Tensor, "m k"], group: Int[Tensor, " m"], n: int
) -> Float[Tensor, " m"]:
    """How far points are along the principal axis of their group, from its mean, in the points' unit.

    The axis points as in `principal_parameter`.
    """
    k = points.shape[-1]
    number = torch.bincount(group, minlength=n).clamp_min(1).to(points)
    mean = points.new_zeros(n, k).index_add(0, group, points) / number[:, None]
    centred = points - mean[group]
    outer = centred[:, :, None] * centred[:, None, :]
    scatter = points.new_zeros(n, k, k).index_add(0, group, outer)
    axis = torch.linalg.eigh(scatter)[1][..., -1]
    # eigenvectors are free in sign
    leading = (axis.abs() > 1e-6).to(torch.uint8).argmax(-1, keepdim=True)
    axis = axis * torch.where(axis.gather(-1, leading) < 0, -1.0, 1.0)
    return (centred * axis[group]).sum(-1)


def bending(
    count: Int[Tensor, " n"], longest: int, like: Tensor
) -> Float[Tensor, "n longest longest"]:
    """The matrices E with `c^T E c` = the integral over t of the squared second derivative.

    c are B-spline coefficients, padded to `longest`; the second derivative at an inner knot is
    their second difference, 0 at the ends, and linear between.
    """
    knot = torch.arange(longest, device=count.device)
    identity = torch.eye(longest, dtype=like.dtype, device=like.device)
    second = torch.zeros_like(identity)
    second[1:-1] = identity[:-2] - 2 * identity[1:-1] + identity[2:]
    mass = (2 / 3) * identity + torch.diag_embed(identity.new_full((longest - 1,), 1 / 6), 1)
    mass = mass + torch.diag_embed(identity.new_full((longest - 1,), 1 / 6), -1)
    inner = (knot > 0) & (knot < count[:, None] - 1)
    second = torch.where(inner[:, :, None], second, 0.0)
    return second.mT @ mass @ second


def closest_parameter_flat(
    control: Float[Tensor, "c k"],
    count: Int[Tensor, " n"],
    points: Float[Tensor, "m k"],
    spline: Int[Tensor, " m"],
) -> Float[Tensor, " m"]:
    """Parameters of the points of packed splines that are nearest to given points.

    `spline` says whose each point is.
    The nearest of evenly spaced samples, then Newton steps that stay within one spacing of it and
    within the spline.
    """
    if not len(points):
        return points.new_zeros(0)
    longest = int(count.max())
    number = _SAMPLES_PER_KNOT * (longest - 1) + 1
    share = torch.linspace(0, 1, number, dtype=points.dtype, device=points.device)
    sample_t = share * (count[:, None] - 1)
    every = torch.arange(len(count), device=count.device).repeat_interleave(number)
    sample = evaluate_flat(control, count, sample_t.flatten(), every)
    sample = sample.reshape(len(count), number, -1)
    per_chunk = max(1, _CHUNK_POINTS // number)
    nearest = [
        (sample[s] - p[:, None]).square().sum(-1).argmin(-1)
        for p, s in zip(points.split(per_chunk), spline.split(per_chunk), strict=True)
    ]
    t = sample_t[spline, torch.cat(nearest)]
    last = (count[spline] - 1).to(t)
    spacing = last / (number - 1)
    low, high = (t - spacing).clamp_min(0), torch.minimum(t + spacing, last)

    coefficient = to_coefficients_flat(control, count)
    start_of_spline, count_of_spline = starts(count)[spline], count[spline]
    slot = torch.arange(4, device=t.device)
    for _ in range(_NEWTON_STEPS):
        start, weight, d_weight, dd_weight = window_with_curvature(t, count_of_spline)
        rank = torch.minimum(start[:, None] + slot, count_of_spline[:, None] - 1)
        around = coefficient[start_of_spline[:, None] + rank]
        offset = (weight[..., None] * around).sum(1) - points
        d = (d_weight[..., None] * around).sum(1)
        dd = (dd_weight[..., None] * around).sum(1)
        slope = (offset * d).sum(-1)
        speed_sq = d.square().sum(-1)
        # Half of the speed at least: near a centre of curvature the second derivative vanishes.
        curvature = torch.maximum(speed_sq + (offset * dd).sum(-1), speed_sq / 2)
        t = t - slope / curvature.clamp_min(torch.finfo(t.dtype).tiny)
        t = torch.minimum(torch.maximum(t, low), high)
    return t


def _reduce(values: Tensor, group: Tensor, count: int, how: str) -> Tensor:
    return values.new_zeros(count).scatter_reduce(0, group, values, how, include_self=False)
