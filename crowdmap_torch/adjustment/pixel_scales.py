"""How noisy pixels are, as the residuals of an adjustment show it: by kind of detection, or all alike as in eq:ba (V-B)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.adjustment.observations import CornerObservations, LanePointObservations
from crowdmap_torch.noise.pixels import noise_by_box, shared_error
from crowdmap_torch.optim.robust import median_scale

_MEDIAN_LENGTH = 1.1774
"""Of a two-dimensional normal vector, in its sigmas."""


@dataclass(frozen=True)
class PixelErrors:
    """Pixel errors at the moment, of all corners and of the lane points that have a match."""

    corners: CornerObservations
    of_corners: Float[Tensor, "m 2"]
    lane_points: LanePointObservations
    of_lanes: Float[Tensor, " k"]


def pixel_scales(
    errors: PixelErrors, small_box: Float[Tensor, ""], config: AdjustConfig
) -> tuple[Float[Tensor, " 3"], Float[Tensor, ""]]:
    """`scale` and `small_box` of a bundle; the latter as it was where there are no corners."""
    if config.method == "paper2017":
        every = torch.cat((errors.of_corners.flatten(), errors.of_lanes))
        scale = median_scale(every, floor=config.sign_sigma_px)
        return torch.stack((scale, scale, torch.ones_like(scale))), torch.zeros_like(small_box)
    least = [config.sign_sigma_px, config.lane_sigma_px, config.lane_correlation]
    seen = small_box.new_tensor(least)
    if len(errors.corners):
        tight = errors.corners.loose_px == 0
        length = errors.of_corners.norm(dim=-1)[tight] / _MEDIAN_LENGTH
        noise = noise_by_box(length, errors.corners.box_px[tight])
        seen[0] = noise.large_px.clamp_min(config.sign_sigma_px)
        small_box = noise.small_box_px
    if len(errors.lane_points):
        rows = errors.lane_points
        seen[1] = median_scale(errors.of_lanes, floor=config.lane_sigma_px)
        together = shared_error(errors.of_lanes, rows.frame, rows.detection)
        seen[2] = together.clamp_min(config.lane_correlation)
    return seen, small_box
