"""What the car's own course says of the drift: wheels roll where they point, so positions that slide sideways are wrong.

Reckoning from the measured headings and the way made gives the same drive once more. Between knots of the drift
(`pose_drift`) the two may part sideways by what positions drift, by what headings drift times the way, and by little
else.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.optim.problem import CostTerm
from crowdmap_torch.pose_drift import DriftConfig, knot_count
from crowdmap_torch.road.level import Level, level_of
from crowdmap_torch.road.reckoning import direction, fit_slip, headings, reckon
from crowdmap_torch.tables import Journey


@dataclass(frozen=True)
class CourseConfig:
    """How far a car's course can be trusted."""

    slide_sigma: float = 2.5e-3
    """1-sigma of the angle between course and wheels that comes and goes, over the way from knot to knot [rad]."""
    blind_sigma: float = 1.3e-3
    """1-sigma of the way sideways between two frames that no heading shows, over the square of their distance [1/m]: next
    to nothing at a camera's rate, centimetres where frames are missing."""
    position_sigma_m: float = 0.016
    """White noise of positions from frame to frame."""


@dataclass(frozen=True)
class DrivePath:
    """A drive as fits along its way need it."""

    T_world_camera: Float[Tensor, "f 4 4"]
    station: Float[Tensor, " f"]
    """Way up to each frame [m], not decreasing."""
    camera: Camera
    course: CostTerm
    """What the car's course says of the drift."""


def drive_path(journey: Journey, config: CourseConfig, drift: DriftConfig) -> DrivePath:
    """The way of a journey, and what its course says."""
    level = level_of(journey)
    # The furthest way ahead: noise at a stand makes no way, and a gap in the frames is as long as it is.
    way = level.station.cummax(0)[0]
    course = course_term(level, way, config, drift)
    return DrivePath(journey.T_world_camera, way, journey.rig.camera, course)


def course_term(
    level: Level, way: Float[Tensor, " f"], config: CourseConfig, drift: DriftConfig
) -> CostTerm:
    """The sideways parting of measured and reckoned course from knot to knot, by the variable `drift`."""
    slope = -level.alpha
    slip = fit_slip(level, slope)
    across, _ = reckon(level, slope, slip)
    knots = knot_count(way, drift)
    nearest = (way / drift.knot_m).round().long()
    number = torch.bincount(nearest, minlength=knots).to(way)

    def mean(value: Float[Tensor, "f k"]) -> Float[Tensor, "n k"]:
        total = value.new_zeros(knots, value.shape[1]).index_add(0, nearest, value)
        return total / number.clamp_min(1)[:, None]

    # Means over the frames around each knot: single positions are noisier than the drift between knots.
    place, path = mean(level.position[:, :2]), mean(across)
    axis = mean(direction(headings(level) + slip.angle))
    up = mean(level.R_world_road[:, 2] @ level.R_road_camera)
    before = torch.nonzero((number[:-1] > 0) & (number[1:] > 0))[:, 0]
    after = before + 1
    ahead = torch.nn.functional.normalize(axis[before] + axis[after], dim=-1)
    left = torch.stack((-ahead[:, 1], ahead[:, 0]), dim=-1)
    reckoned = path[after] - path[before]
    seen = ((place[after] - place[before] - reckoned) * left).sum(-1)
    advance = (reckoned * ahead).sum(-1)[:, None]
    swing = ((axis[after] - axis[before]) * left).sum(-1)[:, None]
    turn = (up[before] + up[after]) * advance / 4
    sideways = torch.nn.functional.pad(left, (0, 1))
    habits = torch.cat((advance, swing), dim=-1) / 2
    by_before = torch.cat((-sideways, -turn, -habits), dim=-1)
    by_after = torch.cat((sideways, -turn, -habits), dim=-1)
    blind = mean((config.blind_sigma * level.advance.square()).square().cumsum(0)[:, None])[:, 0]
    noise = config.position_sigma_m**2 * (1 / number[before] + 1 / number[after])
    slide = (config.slide_sigma * advance[:, 0]).square()
    sigma = (noise + slide + blind[after] - blind[before]).sqrt()

    def jacobian(a: Tensor, b: Tensor, *rows: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        error = rows[0] + (rows[1] * a + rows[2] * b).sum(-1)
        return error[:, None], (rows[1][:, None], rows[2][:, None])

    return CostTerm(
        course_parting,
        (("drift", before), ("drift", after)),
        (seen, by_before, by_after),
        weight=1 / sigma,
        jacobian=jacobian,
    )


def course_parting(
    before: Float[Tensor, " 8"],
    after: Float[Tensor, " 8"],
    seen: Float[Tensor, ""],
    by_before: Float[Tensor, " 8"],
    by_after: Float[Tensor, " 8"],
) -> Float[Tensor, " 1"]:
    """How far measured and reckoned course part sideways from knot to knot, once drift and slip are taken off [m]."""
    return (seen + by_before @ before + by_after @ after)[None]
