"""Noise of detections: what it is taken to be, and how large an adjustment's residuals show it; outliers do not matter.

The error of a pose hits all corners of a detection alike: it moves the sign in the image and leaves its outline. So one
detection is one observation, and its covariance is that of pixel noise of the corners and of the pose that they share.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.geometry import polygon
from crowdmap_torch.optim.robust import median_scale
from crowdmap_torch.processes.amounts import at_once
from crowdmap_torch.processes.sums import add_at
from crowdmap_torch.ranges import Pixels, Settings, Sigma

_CLASSES = 8
"""Classes of boxes of about equal numbers, by size."""
_LOT = 1 << 10
"""Detections of which whitening is found at once on a CPU."""


@dataclass(frozen=True)
class PixelNoiseConfig(Settings):
    """Noise of the corners of detections."""

    sigma_px: Pixels = 0.6
    """Noise of each corner of a large detection, per axis [px]."""
    small_box_px: Pixels = 12.0
    """Box at which that noise has grown by a factor of 1.41 [px]."""
    box_sigma: Sigma = 0.5
    """Noise of width and height of detections that are axis-aligned boxes, or have their shape drawn into one, as a share:
    boxes are drawn around a sign, wider than its outline where it is seen at an angle."""


@dataclass(frozen=True)
class DetectionNoise:
    """What is known of the noise of every detection; of a shape with C corners the leading 2 C entries count."""

    whitening: Float[Tensor, "m 16 16"]
    """Inverse Cholesky factor of the covariance; being triangular, its leading part is a factor of its own."""
    by_pose: Float[Tensor, "m 16 6"]
    """Derivative of the pixel errors by the detection's pose."""
    pose_variance: Float[Tensor, "m 6"]
    pose_error: Float[Tensor, "m 6"]
    """The detection's own pose error as far as it is known; `by_pose` is taken there."""

    def likely_pose_error(self, whitened: Float[Tensor, "m 16"]) -> Float[Tensor, "m 6"]:
        """The most likely error of each detection's pose, given what is left of its pixel errors."""
        by_pose = self.whitening @ self.by_pose
        # The error is predicted minus observed: a camera that is off by d makes it by_pose d larger, and is corrected
        # by -d.
        return -self.pose_variance * (by_pose.mT @ whitened[..., None])[..., 0]


def detection_noise(
    corners_px: Float[Tensor, "m 8 2"],
    shape: Int[Tensor, " m"],
    factor: Float[Tensor, " m"],
    by_pose: Float[Tensor, "m 16 6"],
    pose_variance: Float[Tensor, "m 6"],
    pose_error: Float[Tensor, "m 6"],
    config: PixelNoiseConfig,
) -> DetectionNoise:
    """The noise of detections whose pixels are noisier by `factor` than usual, and whose poses have such a variance."""
    pixel = corner_variance(longer_side(corners_px), config) * factor.square()
    dim = by_pose.shape[1]
    whitening = by_pose.new_empty(len(by_pose), dim, dim)
    eye = torch.eye(dim, dtype=by_pose.dtype, device=by_pose.device)
    # In lots: each of these steps makes matrices as large as all that is kept.
    lot = at_once(_LOT, by_pose.device)
    for first in range(0, len(by_pose), lot):
        here = slice(first, first + lot)
        covariance = (by_pose[here] * pose_variance[here, None]) @ by_pose[here].mT
        covariance.diagonal(dim1=-2, dim2=-1).add_(pixel[here, None])
        by_scale = box_scales(corners_px[here], shape[here]) * config.box_sigma
        covariance += by_scale @ by_scale.mT
        lower = torch.linalg.cholesky(covariance)
        whitening[here] = torch.linalg.solve_triangular(lower, eye.expand_as(lower), upper=False)
    return DetectionNoise(whitening, by_pose, pose_variance, pose_error)


def longer_side(corners_px: Float[Tensor, "m 8 2"]) -> Float[Tensor, " m"]:
    """The longer side of the box around each outline [px]."""
    return (corners_px.amax(1) - corners_px.amin(1)).amax(-1)


def corner_variance(box_px: Float[Tensor, " m"], config: PixelNoiseConfig) -> Float[Tensor, " m"]:
    """The variance of a corner per axis that is usual where the longer side of its box is that long [px^2]."""
    return config.sigma_px**2 * (1 + (config.small_box_px / box_px).square())


def box_scales(
    corners_px: Float[Tensor, "m 8 2"], shape: Int[Tensor, " m"]
) -> Float[Tensor, "m 16 2"]:
    """Derivatives of the corners by the logarithms of the box's width and height; zero for outlines that are no boxes."""
    low, high = corners_px.amin(1, keepdim=True), corners_px.amax(1, keepdim=True)
    offset = (corners_px - (low + high) / 2) * polygon.is_box(corners_px, shape)[:, None, None]
    return torch.diag_embed(offset).flatten(1, 2)


@dataclass(frozen=True)
class BoxNoise:
    """Standard deviation of corners by the size of their box: `large_px * sqrt(1 + (small_box_px / box)^2)`."""

    large_px: Float[Tensor, ""]
    small_box_px: Float[Tensor, ""]


def noise_by_box(length: Float[Tensor, " m"], box_px: Float[Tensor, " m"]) -> BoxNoise:
    """The noise of corners whose residuals have these lengths, in units of their median's expectation.

    The median of every class of boxes is one observation of the variance, and least squares with neither part below
    zero fit the two: small boxes may be as good as large ones, but not better.
    """
    order = torch.argsort(box_px, stable=True)
    parts = [part for part in order.tensor_split(_CLASSES) if len(part)]
    variance = torch.stack([length[part].median().square() for part in parts])
    inverse = torch.stack([box_px[part].median() for part in parts]).pow(-2)
    # A relative error of the variance is about the same in every class.
    of_large = variance.clamp_min(1e-12).reciprocal()
    of_small = inverse * of_large
    # In closed form: LAPACK's least squares differ in the last bit from call to call.
    share = (of_small * of_large).sum() / of_large.square().sum()
    beside = of_small - share * of_large
    told_apart = beside.square().sum() > 1e-9 * of_small.square().sum()
    small = beside.sum() / beside.square().sum().clamp_min(1e-300)
    large = of_large.sum() / of_large.square().sum() - share * small
    both = told_apart & (large > 0) & (small > 0)
    large = torch.where(both, large, variance.mean())
    small = torch.where(both, small, 0.0)
    return BoxNoise(large.sqrt(), (small / large.clamp_min(1e-12)).sqrt())


def shared_error(
    residual: Float[Tensor, " m"], frame: Int[Tensor, " m"], detection: Int[Tensor, " m"]
) -> Float[Tensor, ""]:
    """Factor by which sums over the points of a detection scatter more than if the points erred one by one.

    `detection` is counted by journey, `frame` over all journeys.
    """
    if not len(residual):
        return residual.new_tensor(1.0)
    key = frame * (int(detection.max()) + 1) + detection
    _, group = torch.unique(key, return_inverse=True)
    count = torch.bincount(group)
    total = add_at(residual.new_zeros(len(count)), 0, group, residual)
    several = count > 1
    if not bool(several.any()):
        return residual.new_tensor(1.0)
    return median_scale(total[several] / count[several].sqrt()) / median_scale(residual, floor=1e-9)
