"""The road's surface along a drive: ruled by level-to-the-car lines square to the way, and where rays meet it.

The surface is laid by dead reckoning: how far the car moved, where it headed (measured rotations)
and how the road sloped (the estimated normals). Positions drift by centimetres over the few metres
between where a marker is seen and where the car passes it, rotations do so by far less.
`DriveSurface.shift` leads from the reckoned to the measured world at every frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.road.dead_reckoning import dead_reckon, fit_slip, headings
from crowdmap_torch.road.ego_motion import EgoMotion
from crowdmap_torch.road.vanishing_point import LaneRays

_NODE_M = 0.5
"""Nodes of the surface are this far apart or further."""
_BEYOND_M = 100.0
"""Beyond its ends a drive is taken to go straight on for so long."""
_STEPS = 5
"""Of Newton's method for the point in which a ray meets the surface."""


@dataclass(frozen=True)
class DriveSurface:
    """The surface in reckoned coordinates: the camera over it in each frame, and nodes along it."""

    station: Float[Tensor, " f"]
    """Furthest way ahead since the first frame [m]."""
    slope: Float[Tensor, " f"]
    """Of the road ahead."""
    centre: Float[Tensor, "f 3"]
    """Of the camera, reckoned [m]."""
    shift: Float[Tensor, "f 3"]
    """Measured minus reckoned position of the camera [m]."""
    node: Float[Tensor, "n 6"]
    """Station, place (3), direction of travel, slope to the right; by increasing station."""

    def at(self, station: Float[Tensor, " p"]) -> tuple[Float[Tensor, "3 p"], Tensor, Tensor]:
        """Place, direction of travel [p] and slope to the right [p] on the way, by linear interpolation."""
        at, *columns = self.node.mT.contiguous()
        right = torch.searchsorted(at, station.detach().contiguous()).clamp(1, len(at) - 1)
        left = right - 1
        low = at.index_select(0, left)
        share = ((station - low) / (at.index_select(0, right) - low)).clamp(0, 1)
        found = []
        for column in columns:
            low = column.index_select(0, left)
            found.append(low + share * (column.index_select(0, right) - low))
        return torch.stack(found[:3]), found[3], found[4]


@dataclass(frozen=True)
class SurfacePoints:
    """Where rays meet the surface."""

    station: Float[Tensor, " p"]
    """Of the nearest point of the way [m]."""
    offset: Float[Tensor, " p"]
    """To the right of it, in the top view [m]."""
    point: Float[Tensor, "p 3"]
    """In reckoned coordinates."""
    depth: Float[Tensor, " p"]
    """In units of the rays' length."""
    is_met: Bool[Tensor, " p"]
    """False for rays that do not come down to the surface ahead."""


def lay_surface(
    motion: EgoMotion,
    alpha: Float[Tensor, " f"],
    beta: Float[Tensor, " f"],
    height: Float[Tensor, " f"],
) -> DriveSurface:
    """The surface of a drive whose camera has these heights above it, its normal these tilts."""
    slope, cross = alpha - motion.alpha, beta - motion.beta
    slip = fit_slip(motion, slope)
    across, up = dead_reckon(motion, slope, slip)
    normal = torch.stack((beta, torch.ones_like(alpha), alpha), dim=-1)
    normal = torch.nn.functional.normalize(normal, dim=-1)
    down = height[:, None] * (motion.R_world_road @ normal[..., None])[..., 0]
    foot = torch.cat((across + down[:, :2], up[:, None]), dim=-1)
    centre = foot - down
    station = motion.station.cummax(0)[0]
    return DriveSurface(
        station=station,
        slope=slope,
        centre=centre,
        shift=motion.position - centre,
        node=_nodes(station, foot, headings(motion) + slip.angle, cross, slope),
    )


def intersect(
    surface: DriveSurface,
    ray_world: Float[Tensor, "p 3"],
    frame: Int[Tensor, " p"],
    depth: Float[Tensor, " p"],
) -> SurfacePoints:
    """Where rays from the cameras of frames meet the surface.

    `depth` is a first guess in units of the rays' length.
    """
    # Column by column: points are many, and every operation runs along them.
    origin, ray = (t.mT.contiguous() for t in (surface.centre[frame], ray_world))
    start, slope = surface.station[frame], surface.slope[frame]
    station = start + depth * torch.hypot(ray[0], ray[1])
    for _ in range(_STEPS):
        x, y, z = torch.addcmul(origin, depth, ray)
        place, heading, cross = surface.at(station)
        c, s = heading.cos(), heading.sin()
        x, y = x - place[0], y - place[1]
        along = x * c + y * s
        offset = x * s - y * c
        above = z - place[2] - cross * offset - along * slope
        falling = cross * (ray[0] * s - ray[1] * c) + slope * (ray[0] * c + ray[1] * s) - ray[2]
        step = above / torch.where(falling > 1e-3, falling, 1e-3)
        depth = (depth + step.clamp(-0.3 * depth, 0.3 * depth)).clamp_min(1e-3)
        station = station + along.clamp(-10, 10)
    point = torch.addcmul(origin, depth, ray)
    place, heading, cross = surface.at(station)
    x, y = point[:2] - place[:2]
    along = x * heading.cos() + y * heading.sin()
    offset = x * heading.sin() - y * heading.cos()
    above = point[2] - place[2] - cross * offset
    is_met = (above.abs() < 0.02) & (along.abs() < 0.5) & (station > start)
    return SurfacePoints(station, offset, point.mT.contiguous(), depth, is_met)


def flattened_rays(
    surface: DriveSurface,
    motion: EgoMotion,
    rays: LaneRays,
    alpha: Float[Tensor, " f"],
    beta: Float[Tensor, " f"],
    height: Float[Tensor, " f"],
) -> LaneRays:
    """The image of lane points if the road ran straight and flat, not bending, leaning or climbing ahead.

    Points that do not come down to the surface are put above the horizon.
    """
    frame = rays.frame[rays.detection]
    ray = torch.stack((rays.x, rays.y, torch.ones_like(rays.x)), dim=-1)
    depression = rays.y + alpha[frame] + beta[frame] * rays.x
    points = intersect(
        surface,
        (motion.R_world_road[frame] @ ray[..., None])[..., 0],
        frame,
        height[frame] / depression.clamp_min(0.02),
    )
    ahead = points.station - surface.station[frame]
    is_met = points.is_met & (ahead > 1.0)
    ahead = ahead.clamp_min(1.0)
    x = torch.where(is_met, points.offset / ahead, 0.0)
    y = torch.where(is_met, height[frame] / ahead - alpha[frame], -1.0)
    return replace(rays, x=x, y=y)


def _nodes(
    station: Tensor, foot: Tensor, heading: Tensor, cross: Tensor, slope: Tensor
) -> Float[Tensor, "n 6"]:
    """Rows of the frames that are `_NODE_M` apart, and one far ahead and behind each."""
    index = (station / _NODE_M).floor()
    first = torch.cat((torch.ones_like(index[:1], dtype=torch.bool), index[1:] > index[:-1]))
    row = torch.cat((station[:, None], foot, heading[:, None], cross[:, None]), dim=-1)[first]
    ends = []
    for k, way in ((0, -_BEYOND_M), (-1, _BEYOND_M)):
        c, s = heading[first][k], slope[first][k]
        beyond = torch.stack((c.cos(), c.sin(), s)) * way / (1 + s.square()).sqrt()
        end = row[k].clone()
        end[0] += way
        end[1:4] += beyond
        ends.append(end)
    return torch.cat((ends[0][None], row, ends[1][None]))
