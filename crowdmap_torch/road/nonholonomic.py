"""The non-holonomic constraint on the drift: wheels roll where they point, so positions that slide sideways are wrong.

Reckoning from the measured headings and the way made gives the same drive once more. Between knots of the drift
(`noise.positioning`) the two may part sideways by what positions drift, by what headings drift times the way, and by little
else.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.noise.positioning import DriftPathConfig, PositioningNoise, knot_count
from crowdmap_torch.optim.problem import CostTerm
from crowdmap_torch.processes.sums import running_sum
from crowdmap_torch.ranges import Settings, Sigma
from crowdmap_torch.residuals.pose import sideways_parting
from crowdmap_torch.road.dead_reckoning import dead_reckon, direction, fit_slip, headings
from crowdmap_torch.road.ego_motion import EgoMotion, motion_of
from crowdmap_torch.tables import Journey


@dataclass(frozen=True)
class NonholonomicConfig(Settings):
    """How well cars hold the non-holonomic constraint."""

    slide_sigma: Sigma = 2.5e-3
    """1-sigma of the angle between the car's way and its wheels, which comes and goes, from knot to knot [rad]."""
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
    slope = -level.alpha
    slip = fit_slip(level, slope)
    across, _ = dead_reckon(level, slope, slip)
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
    blind = mean(running_sum((config.blind_sigma * level.advance.square()).square())[:, None])[:, 0]
    noise = positioning.white_sigma_m**2 * (1 / number[before] + 1 / number[after])
    slide = (config.slide_sigma * advance[:, 0]).square()
    sigma = (noise + slide + blind[after] - blind[before]).sqrt()
    return CostTerm(
        sideways_parting,
        (("drift", before), ("drift", after)),
        (seen, by_before, by_after),
        weight=1 / sigma,
        takes_rows=True,
    )
