"""The pitch of the camera against the road, from the vanishing point of the lane markers of one frame.

Markers run side by side: at a depth Z ahead all of them have moved sideways by the same amount. On
a plane road this shows in the image as lines that meet at the horizon (straight), or as hyperbolas
with a common part (bends): with `q = (y + alpha) / h` for 1 / Z,

    x = m_i (y + alpha) + psi + kappa / (2 q) + kappa' / (6 q^2),

where m_i is the offset of marker i in camera heights and psi, kappa, kappa' are the heading, the
bend and its change that all markers of the frame share. Two markers give the pitch alpha; none of
the poses' errors is in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_sum
from crowdmap_torch.optim.robust import Tukey
from crowdmap_torch.ranges import FILLED, Factor, Pixels, Settings, SigmaOrNone, Span

_SHARED = 4
"""Unknowns of a frame: alpha, psi, kappa, kappa'."""
_PRIOR_SIGMA = (0.1, 0.5, 0.03, 1e-3)
"""Of the four, far wider than any road; they keep frames with a single marker solvable."""
_PRIOR_OFFSET = 1e-6
"""Weight that keeps a marker without usable points solvable."""


@dataclass(frozen=True)
class VanishingConfig(Settings):
    """How the vanishing point of lane markers is found in a frame."""

    noise_px: Pixels = 1.0
    """1-sigma of lane points."""
    range_m: Span = (3.0, 35.0)
    """Nearest and farthest depth of the points that are used."""
    bend_sigma: SigmaOrNone = 3e-4
    """What the road bends up or down beyond what is known of it [1/m]; takes weight from far
    points."""
    scales: Annotated[tuple[Factor, ...], FILLED] = (16.0, 6.0, 2.0, 1.0)
    """Factors on the noise, one for each step of iterated least squares (Tukey): from coarse to
    fine."""


@dataclass(frozen=True)
class LaneRays:
    """Lane points of some frames in the road frame, those of one detection adjacent."""

    detection: Int[Tensor, " p"]
    """Index of the detection, not decreasing."""
    frame: Int[Tensor, " d"]
    """Frame of each detection."""
    frames: int
    x: Float[Tensor, " p"]
    """On the plane z = 1 of the road frame, to the right."""
    y: Float[Tensor, " p"]
    """Likewise, down."""


@dataclass(frozen=True)
class VanishingFit:
    """The pitch that each frame's markers show, were the road plane, and what a curved road does to it."""

    alpha: Float[Tensor, " f"]
    variance: Float[Tensor, " f"]
    """Of alpha from the points' noise; large where fewer than two markers are seen."""
    by_curvature: Float[Tensor, " f"]
    """Change of alpha for a road that bends upward ahead, by its curvature [m]."""
    by_twist: Float[Tensor, " f"]
    """Change of alpha for a road whose slope to the right grows ahead, by its growth per metre
    [m]."""
    bend: Float[Tensor, " f"]
    """kappa, positive to the right [1/m]."""
    offset: Float[Tensor, " d"]
    """m_i: how far to the right of the camera each marker is, in camera heights."""
    offset_weight: Float[Tensor, " d"]
    """Inverse variance of it."""


def fit_vanishing(
    rays: LaneRays,
    alpha: Float[Tensor, " f"],
    height: float,
    sigma_ideal: float,
    config: VanishingConfig,
) -> VanishingFit:
    """The pitch of each frame by robust Gauss-Newton from a first guess `alpha`, all at once."""
    x, y, detection, frame = rays.x, rays.y, rays.detection, rays.frame[rays.detection]
    count = len(rays.frame)
    shared = torch.cat((alpha[:, None], alpha.new_zeros(len(alpha), _SHARED - 1)), dim=-1)
    prior = alpha.new_tensor(_PRIOR_SIGMA).square().reciprocal()
    centre = shared
    offset = _first_offsets(rays, alpha)
    loss = Tukey()
    near, far = config.range_m
    covariance = response = torch.zeros_like(shared[:, :, None])
    own = torch.zeros_like(offset)
    for number, scale in enumerate(config.scales, 1):
        a, psi, kappa, rate = shared[frame].unbind(-1)
        m = offset[detection]
        depression = (y + a).clamp_min(height / (2 * far))
        Z = height / depression
        residual = x - m * (y + a) - psi - kappa * Z / 2 - rate * Z**2 / 6
        by_y = -m + (kappa / 2 + rate * Z / 3) * Z**2 / height
        used = (Z > near) & (Z < far) & (y + a > height / far)
        variance = sigma_ideal**2 * (1 + by_y**2) + (by_y * config.bend_sigma * Z / 2) ** 2
        whitened = residual.square() / variance
        weight = loss.weight(whitened / scale**2) / variance * used
        # Columns: alpha, psi, kappa, kappa'; then what a curved and a twisted road would add to
        # alpha, which is asked for at the end.
        J = (by_y, -torch.ones_like(Z), -Z / 2, -(Z**2) / 6)
        if number == len(config.scales):
            J = (*J, by_y * Z / 2, by_y * x * Z)
        by_offset = -(y + a)
        A, B, C, shared_rhs, offset_rhs = _normal_equations(
            J, by_offset, residual, weight, detection, rays.frame, count, rays.frames
        )
        own = C + _PRIOR_OFFSET
        # Each marker's own offset is eliminated: what is left is 4 x 4 for each frame.
        ratio = B / own[:, None]
        S = A.index_add(0, rays.frame, -ratio[:, :, None] * B[:, None, :])
        rhs = shared_rhs.index_add(0, rays.frame, -ratio * offset_rhs[:, None])
        S_shared = S[:, :_SHARED, :_SHARED] + torch.diag(prior)
        pull = rhs[:, :_SHARED] - prior * (shared - centre)
        covariance = torch.linalg.inv(S_shared)
        step = (covariance @ pull[..., None])[..., 0]
        shared = shared + step
        back = (B[:, :_SHARED] * step[rays.frame]).sum(-1)
        offset = offset + (offset_rhs - back) / own
        response = (covariance @ S[:, :_SHARED, _SHARED:])[:, 0]
    return VanishingFit(
        alpha=shared[:, 0],
        variance=covariance[:, 0, 0],
        by_curvature=response[:, 0],
        by_twist=response[:, 1],
        bend=shared[:, 2],
        offset=offset,
        offset_weight=own,
    )


def _first_offsets(rays: LaneRays, alpha: Float[Tensor, " f"]) -> Float[Tensor, " d"]:
    """Slope of a line through each marker's points in the image: its offset, if the road ran straight on."""
    count = len(rays.frame)
    points = torch.stack((rays.x, rays.y), dim=1)
    number = torch.bincount(rays.detection, minlength=count).clamp_min(1)
    mean = group_sum(points, rays.detection, count) / number[:, None]
    x, y = (points - mean[rays.detection]).unbind(1)
    xy, yy = group_sum(torch.stack((x * y, y * y), dim=1), rays.detection, count).unbind(1)
    return xy / (yy + 1e-9)


def _normal_equations(
    J: Sequence[Float[Tensor, " p"]],
    by_offset: Float[Tensor, " p"],
    residual: Float[Tensor, " p"],
    weight: Float[Tensor, " p"],
    detection: Int[Tensor, " p"],
    frame: Int[Tensor, " d"],
    count: int,
    frames: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Blocks of J^T W J, shared [f k k], mixed [d k] and own [d], and the parts of -J^T W r; J by its columns."""
    columns = (*J, by_offset, residual)
    size = len(columns)
    own = residual.new_zeros(size, size, count)
    # Of the symmetric matrices one half is summed up, number by number: products of all at once take three times as long.
    for i, pulling in enumerate(weight * column for column in columns):
        # The square of the residual is of no use.
        for j in range(i, size if i < size - 1 else 0):
            own[i, j].index_add_(0, detection, pulling * columns[j])
            own[j, i] = own[i, j]
    own = own.permute(2, 0, 1).contiguous()
    k = size - 2
    A = own.new_zeros(frames, k, k).index_add(0, frame, own[:, :k, :k])
    rhs = own.new_zeros(frames, k).index_add(0, frame, -own[:, :k, k + 1])
    return A, own[:, :k, k], own[:, k, k], rhs, -own[:, k, k + 1]
