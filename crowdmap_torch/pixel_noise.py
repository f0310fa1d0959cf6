"""How large the noise of detections is, from what an adjustment leaves of their residuals; outliers do not matter."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.robust import median_scale

_CLASSES = 8
"""Classes of boxes of about equal numbers, by size."""


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
    A = torch.stack((torch.ones_like(inverse), inverse), dim=1) / variance[:, None].clamp_min(1e-12)
    whole = torch.stack((variance.mean(), torch.zeros_like(variance[0])))
    fit = torch.linalg.lstsq(A, torch.ones_like(variance)).solution if len(parts) > 1 else whole
    large, small = torch.where((fit > 0).all(), fit, whole)
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
    total = residual.new_zeros(len(count)).index_add_(0, group, residual)
    several = count > 1
    if not bool(several.any()):
        return residual.new_tensor(1.0)
    return median_scale(total[several] / count[several].sqrt()) / median_scale(residual, floor=1e-9)
