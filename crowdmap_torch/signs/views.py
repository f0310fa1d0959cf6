"""Views of signs, where fits to them begin, and what they find (IV-B)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_argmin
from crowdmap_torch.geometry import camera, se3
from crowdmap_torch.road.nonholonomic import DrivePath
from crowdmap_torch.tables import Rows

APPROACH_FRAMES = 150
"""Frames after a sign's closest view among which its closest approach is looked for."""

UNKNOWN_M = 1e3
"""1-sigma of a centre whose normal equations have no inverse: such a sign is pruned as too uncertain [m]."""


@dataclass(frozen=True)
class SignViews(Rows):
    """Detections of signs, corners in the order of the sign's template."""

    sign: Int[Tensor, " m"]
    """Row of the sign that each detection shows."""
    frame: Int[Tensor, " m"]
    corners_px: Float[Tensor, "m 8 2"]
    corners_ideal: Float[Tensor, "m 8 2"]
    observation: Float[Tensor, "m 8 3 3"]
    T_world_camera: Float[Tensor, "m 4 4"]

    @property
    def p_world_camera(self) -> Float[Tensor, "m 3"]:
        """Where each view was taken from."""
        return self.T_world_camera[:, :3, 3]


@dataclass(frozen=True)
class SignStart:
    """Where a fit begins."""

    T_world_sign: Float[Tensor, "n 4 4"]
    size: Float[Tensor, "n 2"]


@dataclass(frozen=True)
class CoarseFit:
    """Signs fitted to views one by one, the drift counted as white noise."""

    start: SignStart
    cost: Float[Tensor, " n"]
    error_sq: Float[Tensor, " m"]
    """Mean square of each view's whitened error."""


@dataclass(frozen=True)
class SignFit:
    """Signs fitted to views, each relative to the given pose at its closest approach."""

    T_world_sign: Float[Tensor, "n 4 4"]
    size: Float[Tensor, "n 2"]
    frame: Int[Tensor, " n"]
    """Of the closest approach: the nearest frame that has the sign in its image, detected or not."""
    covariance: Float[Tensor, "n 3 3"]
    """Of the centre, relative to the pose at that frame [m^2]; that of `UNKNOWN_M` where the views leave it open."""
    error_sq: Float[Tensor, " m"]
    """Mean square of each view's whitened error; views beyond `tukey` squared have no say."""
    drift_scale: float
    """By how much the poses drift, in multiples of what is usual."""


def held_covariance(covariance: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3 3"]:
    """The covariances, with that of `UNKNOWN_M` in place of those that are not finite."""
    eye = torch.eye(3, dtype=covariance.dtype, device=covariance.device)
    is_known = covariance.isfinite().flatten(1).all(1)
    return torch.where(is_known[:, None, None], covariance, UNKNOWN_M**2 * eye)


def distance_away(views: SignViews, fit: SignFit | SignStart) -> Float[Tensor, " m"]:
    """Distance of each view from its sign [m]."""
    return (views.p_world_camera - fit.T_world_sign[views.sign, :3, 3]).norm(dim=-1)


def closest_approach(
    views: SignViews, signs: SignFit | SignStart, drive: DrivePath
) -> Int[Tensor, " n"]:
    """The nearest of the frames from each sign's closest view on that has it in its image: few are detected at the last."""
    centre = signs.T_world_sign[:, :3, 3]
    closest_view = views.frame[group_argmin(distance_away(views, signs), views.sign)]
    ahead = torch.arange(APPROACH_FRAMES, device=centre.device)
    frame = (closest_view[:, None] + ahead).clamp_max(len(drive.station) - 1)
    in_camera = se3.transform(se3.inverse(drive.T_world_camera)[frame], centre[:, None])
    _, visible = camera.project(drive.camera, in_camera)
    distance = torch.where(visible, in_camera.norm(dim=-1), torch.inf)
    # The view itself counts, whatever its sign's centre as fitted.
    distance[:, 0] = in_camera[:, 0].norm(dim=-1)
    return frame.gather(1, distance.argmin(1, keepdim=True))[:, 0]


def sign_by_sign(views: SignViews) -> Int[Tensor, " m"]:
    """The order of the views of one sign after the other, each along its frames."""
    order = torch.argsort(views.frame, stable=True)
    return order[torch.argsort(views.sign[order], stable=True)]


def thinned(views: SignViews, most: int) -> Bool[Tensor, " m"]:
    """About `most` views of each sign, spread evenly over its frames, the last one among them."""
    order = sign_by_sign(views)
    count = torch.bincount(views.sign)
    first = (count.cumsum(0) - count)[views.sign[order]]
    rank = torch.arange(len(order), device=order.device) - first
    share = rank * most // count[views.sign[order]].clamp_min(most)
    last = torch.ones_like(share, dtype=torch.bool)
    last[:-1] = (share[1:] != share[:-1]) | (rank[1:] == 0)
    return torch.zeros_like(last).index_put((order,), last)
