"""Where fits of signs begin (IV-B): mid-points of rays, the best plane, and planes turned to either side."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_median, group_sum
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.geometry.triangulation import midpoint_ragged
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.optim.robust import usual
from crowdmap_torch.ranges import Angle, Count, Settings
from crowdmap_torch.residuals.sign_prior import against_the_drive
from crowdmap_torch.signs.corner_noise import corner_noise
from crowdmap_torch.signs.fit import SignFitConfig, fit_signs_coarsely, robust_noise_scale
from crowdmap_torch.signs.views import SignStart, SignViews, thinned
from crowdmap_torch.tables import concatenate

REWEIGHTINGS = 8
"""Rounds of reweighting towards the median ray."""
MIN_DEPTH_M = 1.0
"""A mid-point nearer than this, or behind a camera, has no depth there."""
NEAR_ENOUGH_RAD = 2e-3
"""Rays this close to a point agree with it: their weights do not grow further."""
MAX_SIZE_RATIO = 3.0
"""A plane whose size differs by more from the boxes' size is taken for a misfit."""
_AS_ASSUMED = 48.0
"""Views with the noise that is assumed that count beside those of a drive: three tracklets' worth."""
_MOST_IN_COMMON = 4.0
"""Fits are never noisier than corners by themselves by more than this, by what all corners of a detection have wrong."""
_MUCH_NOISIER = 1.3
"""A drive that is noisier by less has the noise that is assumed; each sign has a scale of its own beside."""
_ROUNDS = 3
"""How often a drive's noise is found at most: far from what is assumed its signs are not placed well at first."""


@dataclass(frozen=True)
class SignStartConfig(Settings):
    """Where joint fits begin."""

    yaw_deg: tuple[Angle, ...] = (-30.0, 30.0)
    """Angles from the line of sight to start from, beside the best plane."""
    max_views: Count = 16
    """Views of each sign that the starts are compared on."""


def centre_points(
    views: SignViews, count: int, *, typical_height_m: float
) -> Float[Tensor, "count 3"]:
    """Mid-points of the rays to the means of each sign's corners, robust to views that are far off (IV-B).

    Rays are weighted by one over their distance squared, so that angles count and not metres, and reweighted by one
    over their angle: what remains is near the median. Where a mid-point lies behind a camera a sign of typical height
    gives the depth.
    """
    ray = _mean_ray(views)
    origin = views.p_world_camera
    typical_depth = typical_height_m / _extent(views)[:, 1].clamp_min(1e-6)
    weight = 1 / typical_depth.square()
    point, _ = midpoint_ragged(origin, ray, views.sign, count, weight)
    for _ in range(REWEIGHTINGS):
        to_point = point[views.sign] - origin
        along = (to_point * ray).sum(-1)
        across = (to_point - along[:, None] * ray).norm(dim=-1)
        depth = torch.where(along > MIN_DEPTH_M, along, typical_depth)
        weight = 1 / (depth * across.clamp_min(NEAR_ENOUGH_RAD * depth))
        point, _ = midpoint_ragged(origin, ray, views.sign, count, weight)
    return point


def corner_points(
    views: SignViews, centre: Float[Tensor, "n 3"], count: int
) -> Float[Tensor, "count 8 3"]:
    """Mid-points of the rays of each corner of every sign (IV-B)."""
    slots = polygon.MAX_CORNERS
    ideal = torch.nn.functional.pad(views.corners_ideal, (0, 1), value=1.0)
    ray = se3.rotate(views.T_world_camera[:, None], ideal)
    origin = views.p_world_camera[:, None].expand_as(ray)
    group = views.sign[:, None] * slots + torch.arange(slots, device=views.sign.device)
    distance = (centre[views.sign] - views.p_world_camera).norm(dim=-1).clamp_min(MIN_DEPTH_M)
    weight = (1 / distance.square())[:, None].expand(-1, slots)
    point, _ = midpoint_ragged(
        *(origin.flatten(0, 1), ray.flatten(0, 1)),
        *(group.flatten(), count * slots, weight.flatten()),
    )
    return point.reshape(count, slots, 3)


def starts(
    views: SignViews,
    shape: Int[Tensor, " n"],
    centre: Float[Tensor, "n 3"],
    *,
    yaws: tuple[float, ...],
    size_limits: tuple[float, float],
) -> list[SignStart]:
    """Upright signs turned from the line of sight by each of `yaws` [rad], and the best plane through the corners.

    A small plane that is far away looks the same turned to either side, and its fit has two minima.
    """
    n = len(shape)
    towards = views.p_world_camera - centre[views.sign]
    depth = -(towards * views.T_world_camera[:, :3, 2]).sum(-1)
    size = group_median(_extent(views) * depth.clamp_min(MIN_DEPTH_M)[:, None], views.sign, n)
    size = size.clamp(*size_limits)
    to_camera = group_sum(towards, views.sign, n)
    heading = torch.atan2(to_camera[:, 1], to_camera[:, 0])
    found = [SignStart(se3.make(_upright(heading + yaw), centre), size) for yaw in yaws]
    points = corner_points(views, centre, n)
    T, fitted, shift = polygon.fit_sign(points, shape, to_camera)
    # Noise may fold a far plane over; and a start whose corners are in another order than the views' is none.
    ratio = torch.maximum(fitted / size, size / fitted).amax(-1)
    good = (ratio < MAX_SIZE_RATIO) & (shift == 0) & T.isfinite().all(-1).all(-1)
    first = found[0]
    found.append(
        SignStart(
            torch.where(good[:, None, None], T, first.T_world_sign),
            torch.where(good[:, None], fitted, first.size),
        )
    )
    return found


def choose_starts_of_drive(
    views: SignViews,
    shape: Int[Tensor, " n"],
    positioning: PositioningNoise,
    config: SignStartConfig,
    fit: SignFitConfig,
    *,
    size_limits: tuple[float, float],
) -> tuple[SignStart, Float[Tensor, " n"], SignFitConfig]:
    """`choose_starts` of all signs of a drive, and `fit` with corners as noisy as this drive's are, if that is more.

    Cameras of many pixels, and detectors that look at pictures made smaller, have a noise of their own: by a bound on what
    is usual all of their signs would be pruned. The noise scales are multiples of the drive's, up to what `fit` admits.
    Where most tracks are no signs, but plates of cars say, what is usual is their misfit: then corners' own noise counts.
    """
    seen = torch.bincount(views.sign, minlength=len(shape)).clamp_max(config.max_views)
    start, scale = choose_starts(views, shape, positioning, config, fit, size_limits=size_limits)
    for _ in range(_ROUNDS - 1):
        own = corner_noise(views, shape, fit.pixels)
        noisier = usual(scale, seen.to(scale), assumed=own, beside=_AS_ASSUMED)
        if noisier > _MOST_IN_COMMON * own:
            noisier = own
        if noisier < _MUCH_NOISIER:
            break
        pixels = replace(fit.pixels, sigma_px=noisier * fit.pixels.sigma_px)
        fit = replace(fit, pixels=pixels)
        start, scale = choose_starts(
            views, shape, positioning, config, fit, size_limits=size_limits
        )
    return start, scale.clamp_max(fit.max_noise_scale), fit


def choose_starts(
    views: SignViews,
    shape: Int[Tensor, " n"],
    positioning: PositioningNoise,
    config: SignStartConfig,
    fit: SignFitConfig,
    *,
    size_limits: tuple[float, float],
) -> tuple[SignStart, Float[Tensor, " n"]]:
    """Signs fitted one by one from several starts, of each the best; and their noise scales, however large."""
    few = views[thinned(views, config.max_views)]
    n, m = len(shape), len(few)
    centre = centre_points(few, n, typical_height_m=fit.habit.typical_size_m)
    facing = against_the_drive(few.T_world_camera, few.sign, n)
    yaws = tuple(math.radians(yaw) for yaw in config.yaw_deg)
    candidates = starts(few, shape, centre, yaws=yaws, size_limits=size_limits)
    k = len(candidates)
    coarse = fit_signs_coarsely(
        concatenate([replace(few, sign=few.sign + i * n) for i in range(k)]),
        shape.repeat(k),
        SignStart(
            torch.cat([s.T_world_sign for s in candidates]), torch.cat([s.size for s in candidates])
        ),
        facing.repeat(k, 1),
        positioning,
        fit,
    )
    cost = torch.where(coarse.cost.isfinite(), coarse.cost, torch.inf).reshape(k, n)
    choice = cost.argmin(0)
    best = choice * n + torch.arange(n, device=shape.device)
    view = choice[few.sign] * m + torch.arange(m, device=shape.device)
    scale = robust_noise_scale(coarse.error_sq[view], few.sign, n)
    return SignStart(coarse.start.T_world_sign[best], coarse.start.size[best]), scale


def choose_starts_again(
    views: SignViews,
    again: Bool[Tensor, " n"],
    shape: Int[Tensor, " n"],
    start: SignStart,
    scale: Float[Tensor, " n"],
    positioning: PositioningNoise,
    config: SignStartConfig,
    fit: SignFitConfig,
    *,
    size_limits: tuple[float, float],
) -> tuple[SignStart, Float[Tensor, " n"]]:
    """The beginnings `start` of signs and their noise `scale`, those of the signs `again` found anew."""
    mine = views[again[views.sign]]
    sign, compact = mine.sign.unique(return_inverse=True)
    new, new_scale = choose_starts(
        replace(mine, sign=compact), shape[sign], positioning, config, fit, size_limits=size_limits
    )
    T, size = start.T_world_sign, start.size
    merged = SignStart(T.index_put((sign,), new.T_world_sign), size.index_put((sign,), new.size))
    return merged, scale.index_put((sign,), new_scale.clamp_max(fit.max_noise_scale))


def _mean_ray(views: SignViews) -> Float[Tensor, "m 3"]:
    low, high = views.corners_ideal.amin(1), views.corners_ideal.amax(1)
    middle = torch.nn.functional.pad((low + high) / 2, (0, 1), value=1.0)
    return torch.nn.functional.normalize(se3.rotate(views.T_world_camera, middle), dim=-1)


def _extent(views: SignViews) -> Float[Tensor, "m 2"]:
    """Width and height of each view's box on the plane z = 1."""
    return views.corners_ideal.amax(1) - views.corners_ideal.amin(1)


def _upright(heading: Float[Tensor, " n"]) -> Float[Tensor, "n 3 3"]:
    z = torch.stack((heading.cos(), heading.sin(), torch.zeros_like(heading)), dim=-1)
    y = torch.zeros_like(z)
    y[:, 2] = 1
    return torch.stack((torch.linalg.cross(y, z), y, z), dim=-1)
