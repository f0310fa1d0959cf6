"""The non-holonomic constraint on the drift: wheels roll where they point, so positions that slide sideways are wrong.

Reckoning from the measured headings and the way made gives the same drive once more. Between knots of the drift
(`noise.positioning`) the two may part sideways by what positions drift, by what headings drift times the way, and by little
else.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.noise.positioning import DriftPathConfig, PositioningNoise, knot_count
from crowdmap_torch.optim.problem import CostTerm
from crowdmap_torch.processes.sums import running_sum
from crowdmap_torch.ranges import Length, Settings, Sigma
from crowdmap_torch.residuals.pose import sideways_parting
from crowdmap_torch.road.dead_reckoning import dead_reckon, direction, fit_slip, headings
from crowdmap_torch.road.ego_motion import EgoMotion, motion_of
from crowdmap_torch.tables import Journey


@dataclass(frozen=True)
class NonholonomicConfig(Settings):
    """How well cars hold the non-holonomic constraint."""

    slide_sigma: Sigma = 2.5e-3
    """1-sigma of the angle between the car's way and its wheels, which comes and goes [rad]."""
    slide_length_m: Length = 4.0
    """Way over which that angle is one [m]."""
    blind_sigma: Sigma = 1.3e-3
    """1-sigma of the way sideways between two frames that no heading shows, over the square of their distance [1/m]: next
    to nothing at a camera's rate, centimetres where frames are missing."""


@dataclass(frozen=True)
class DrivePath:
    """A drive as fits along its way need it."""

    T_world_camera: Float[Tensor, "f 4 4"]
    station: Float[Tensor, " f"]
    """Way up to each frame [m], not decreasing."""
    camera: Camera
    nonholonomic: CostTerm
    """What the non-holonomic constraint says of the drift."""


def drive_path(
    journey: Journey,
    positioning: PositioningNoise,
    config: NonholonomicConfig,
    drift: DriftPathConfig,
) -> DrivePath:
    """The way of a journey, and its non-holonomic constraint."""
    level = motion_of(journey)
    # The furthest way ahead: noise at a stand makes no way, and a gap in the frames is as long as it is.
    way = level.station.cummax(0)[0]
    term = nonholonomic_term(level, way, positioning, config, drift)
    return DrivePath(journey.T_world_camera, way, journey.rig.camera, term)


def nonholonomic_term(
    level: EgoMotion,
    way: Float[Tensor, " f"],
    positioning: PositioningNoise,
    config: NonholonomicConfig,
    drift: DriftPathConfig,
) -> CostTerm:
    """The sideways parting of measured and reckoned path from knot to knot, by the variable `drift`."""
    knots = knot_count(way, drift)
    nearest = (way / drift.knot_m).round().long()
    parted = partings(level, nearest, knots, config)
    sigma = (positioning.white_sigma_m**2 * parted.frames + parted.variance).sqrt()
    return CostTerm(
        sideways_parting,
        (("drift", parted.before), ("drift", parted.before + 1)),
        (parted.seen, parted.by_before, parted.by_after),
        weight=1 / sigma,
        takes_rows=True,
    )


@dataclass(frozen=True)
class Partings:
    """How far measured and reckoned path part sideways from each stretch of a drive to the next one."""

    before: Int[Tensor, " n"]
    """The stretch; frames of the next one are there, too."""
    seen: Float[Tensor, " n"]
    """By the poses as they are given, to the left [m]."""
    by_before: Float[Tensor, "n 8"]
    """What the drift of a stretch adds: that of the pose (6), the angle from the camera's axis to the car's, its lever."""
    by_after: Float[Tensor, "n 8"]
    """Likewise that of the next one."""
    frames: Float[Tensor, " n"]
    """The variance of this, as a share of that of the position of a frame."""
    variance: Float[Tensor, " n"]
    """What is left of it where positions have no noise [m^2]."""


def partings(
    level: EgoMotion, stretch: Int[Tensor, " f"], count: int, config: NonholonomicConfig
) -> Partings:
    """Those between so many stretches of a drive; `stretch` is that of each frame, -1: none."""
    slope = -level.alpha
    slip = fit_slip(level, slope)
    across, _ = dead_reckon(level, slope, slip)
    rows = torch.nonzero(stretch >= 0)[:, 0]
    stretch = stretch[rows]
    number = torch.bincount(stretch, minlength=count).to(across)

    def mean(value: Float[Tensor, "f k"]) -> Float[Tensor, "n k"]:
        total = value.new_zeros(count, value.shape[1]).index_add(0, stretch, value[rows])
        return total / number.clamp_min(1)[:, None]

    # Means over the frames of each: single positions are noisier than the drift between stretches.
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
    blind = mean(running_sum((config.blind_sigma * level.advance.square()).square())[:, None])[:, 0]
    slide = config.slide_sigma**2 * config.slide_length_m * advance[:, 0].abs()
    return Partings(
        before,
        seen,
        by_before=torch.cat((-sideways, -turn, -habits), dim=-1),
        by_after=torch.cat((sideways, -turn, -habits), dim=-1),
        frames=1 / number[before] + 1 / number[after],
        variance=slide + blind[after] - blind[before],
    )
