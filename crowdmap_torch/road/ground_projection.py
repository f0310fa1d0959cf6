"""Where the points of lane markers are in the world, and how sure that is (IV-C, eq:ipm; IV-D)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.geometry import camera as camera_module
from crowdmap_torch.geometry.plane import ground_points
from crowdmap_torch.processes.sums import running_sum
from crowdmap_torch.road.ego_motion import EgoMotion, motion_of, slopes_of_normal
from crowdmap_torch.road.surface import DriveSurface, SurfacePoints, intersect, lay_surface
from crowdmap_torch.tables import Journey, LanePoints, RoadEstimate, Rows

_SHIFT_WINDOW_M = 2.0
"""Way over which the white noise of positions is averaged."""


@dataclass(frozen=True)
class GroundPoints(Rows):
    """Lane points on the road."""

    point_world: Float[Tensor, "p 3"]
    depth: Float[Tensor, " p"]
    """How far ahead of the camera [m]."""
    station: Float[Tensor, " p"]
    """Way of the car at the point [m]."""
    offset: Float[Tensor, " p"]
    """How far to the right of the camera's way [m]."""
    is_on_ground: Bool[Tensor, " p"]
    """False for points above the horizon."""


def project_to_planes(journey: Journey, road: RoadEstimate) -> GroundPoints:
    """Points on the plane under the car in the frame that sees them: the paper's mapping (eq:ipm)."""
    motion = motion_of(journey)
    frame = journey.lanes.frame[journey.lane_points.detection]
    ray = torch.nn.functional.pad(journey.lane_points.ideal, (0, 1), value=1.0)
    h = road.normal_camera * road.height[:, None]
    falling = (h[frame] * ray).sum(-1)
    # Grazing rays meet the plane kilometres away or behind the camera.
    is_on_ground = falling > 1e-3 * road.height[frame]
    ray = torch.where(is_on_ground[:, None], ray, h[frame])
    point = ground_points(ray, h[frame], journey.T_world_camera[frame])
    ahead = point - journey.T_world_camera[frame, :3, 3]
    in_road = (motion.R_world_road[frame].mT @ ahead[..., None])[..., 0]
    station = motion.station.cummax(0)[0][frame] + in_road[:, 2]
    return GroundPoints(point, in_road[:, 2], station, in_road[:, 0], is_on_ground)


def project_to_surface(journey: Journey, road: RoadEstimate) -> GroundPoints:
    """Points on the surface that the car drove, as measured when the car saw them from nearest.

    Unlike the paper, the road is no plane: its slopes ahead and to the right are those that the car
    met later. From the frame that sees a point to the frame that sees it from nearest the way is
    reckoned, so the drift of positions between is not in it.
    """
    if not len(journey.lane_points):
        return project_to_planes(journey, road)
    motion = motion_of(journey)
    surface, points, _ = _intersect_surface(journey, motion, road, journey.lane_points)
    frame = journey.lanes.frame[journey.lane_points.detection]
    depth = points.station - surface.station[frame]
    near = _nearest_view(journey, motion, points.offset)
    seen_at = torch.maximum(points.station - near, surface.station[frame])
    return GroundPoints(
        point_world=points.point + _shift(surface, seen_at),
        depth=depth,
        station=points.station,
        offset=points.offset,
        is_on_ground=points.is_met,
    )


def ground_points_camera(
    journey: Journey, road: RoadEstimate, points: LanePoints
) -> tuple[Float[Tensor, "p 3"], Bool[Tensor, " p"]]:
    """Lane points in the camera's frame, on the surface that the car drove, and which of them lie on it."""
    if not len(points):
        return points.ideal.new_zeros(0, 3), torch.zeros_like(points.detection, dtype=torch.bool)
    _, met, ray = _intersect_surface(journey, motion_of(journey), road, points)
    return met.depth[:, None] * ray, met.is_met


def lateral_sigma(
    ground: GroundPoints,
    frame: Int[Tensor, " p"],
    road: RoadEstimate,
    *,
    sigma_ideal: float,
    normal_sigma: float,
    drift: float,
) -> Float[Tensor, " p"]:
    """1-sigma of points across the road [m]: their noise in the image, the normal's, and drift over the way to them.

    A normal off by an angle moves a point by `depth / height` times its offset: far points are
    worth little. `normal_sigma` is what differs from frame to frame [rad]; `drift` [m] over one
    metre of travel.
    """
    height = road.height[frame]
    depth = ground.depth.clamp_min(0.1)
    slant = ground.offset / height
    by_noise = (sigma_ideal * depth).square() * (1 + slant.square())
    by_normal = (normal_sigma * slant * depth).square() + (normal_sigma * depth).square()
    return (by_noise + by_normal + drift**2 * depth).sqrt()


def _intersect_surface(
    journey: Journey, motion: EgoMotion, road: RoadEstimate, points: LanePoints
) -> tuple[DriveSurface, SurfacePoints, Float[Tensor, "p 3"]]:
    """The surface of a drive, where the rays of lane points meet it, and the rays in the camera's frame."""
    alpha, beta = slopes_of_normal(road.normal_camera, motion.R_road_camera)
    surface = lay_surface(motion, alpha, beta, road.height)
    frame = journey.lanes.frame[points.detection]
    ray = torch.nn.functional.pad(points.ideal, (0, 1), value=1.0)
    in_road = ray @ motion.R_road_camera.T
    ray, in_road = ray / in_road[:, 2:], in_road / in_road[:, 2:]
    depression = in_road[:, 1] + alpha[frame] + beta[frame] * in_road[:, 0]
    ray_world = (motion.R_world_road[frame] @ in_road[..., None])[..., 0]
    depth = road.height[frame] / depression.clamp_min(0.02)
    return surface, intersect(surface, ray_world, frame, depth), ray


def _nearest_view(
    journey: Journey, motion: EgoMotion, offset: Float[Tensor, " p"]
) -> Float[Tensor, " p"]:
    """How far ahead a point with a given offset is when it is about to leave the image [m]."""
    like = motion.position
    side = torch.arange(-16.0, 16.5, 1.0).to(like)
    ahead = torch.arange(1.0, 30.25, 0.25).to(like)
    down = torch.full_like(ahead, journey.rig.camera_height)
    grid = torch.stack(torch.broadcast_tensors(side[:, None], down[None], ahead[None]), dim=-1)
    visible = camera_module.project(journey.rig.camera, grid @ motion.R_road_camera)[1]
    ever = visible.any(-1)
    first = torch.where(ever, ahead[visible.to(torch.uint8).argmax(-1)], ahead[-1])
    index = (offset - side[0]).round().long().clamp(0, len(side) - 1)
    return first[index]


def _shift(surface: DriveSurface, station: Float[Tensor, " p"]) -> Float[Tensor, "p 3"]:
    """Measured minus reckoned position, the mean over the frames around a place on the way."""
    at = surface.station.contiguous()
    total = torch.cat((surface.shift[:1] * 0, running_sum(surface.shift)))
    half = _SHIFT_WINDOW_M / 2
    low = torch.searchsorted(at, (station - half).contiguous())
    high = torch.searchsorted(at, (station + half).contiguous(), right=True)
    # At least the nearest frame: beyond the ends, and in a gap.
    low = torch.minimum(low, high - 1).clamp(0, len(at) - 1)
    high = torch.maximum(high, low + 1)
    return (total[high] - total[low]) / (high - low)[:, None]
