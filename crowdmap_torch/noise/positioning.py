"""Drift of a journey's poses: one smooth path of errors for the whole drive, position and rotation, with a known spread.

A knot holds the error of position and rotation (6), and how the camera stands in the car: the angle from its axis to the
car's, and the lever by which it swings out in bends, both next to constant (`road.nonholonomic`).

The error is a Gauss-Markov chain over knots along the way: bound to the knot before, and drawn towards zero over the
way on which the positioning forgets. All landmarks of a journey share it, so each of them is held by what the
others, seen from the same stretch, say of the way between views.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.problem import CostTerm
from crowdmap_torch.ranges import FILLED, Factor, Length, Settings, Sigma, SigmaOrNone, Spacing
from crowdmap_torch.residuals.pose import (
    gauss_markov_start,
    gauss_markov_step,
    gauss_markov_step_jacobian,
)

CAR_CHANGES_M = 1e6
"""Way over which a camera's place in its car changes."""


@dataclass(frozen=True)
class PositioningNoise(Settings):
    """What positioning gets wrong where it does not say itself; every sigma is 1-sigma per axis.

    The error of a journey's poses is a bias, a drift about it (an Ornstein-Uhlenbeck process along the way), and noise from
    frame to frame. Over kilometres the bias wanders: of drives that are long enough, or show it, it is a constant and a
    second such process, far slower.
    """

    bias_sigma_m: tuple[Sigma, Sigma, Sigma] = (0.6, 0.6, 0.9)
    """Constant error of a journey's positions: east, north, up [m]. Between lane-level positioning (the paper, I; 0.3 m in
    simulations) and a consumer receiver beside an IMU (0.85 m); each journey's own scale is estimated from there."""
    bias_sigma_deg: Sigma = 0.05
    """Constant error of the rotation: the camera's place in its car included [deg]."""
    wander_sigma_m: SigmaOrNone = 0.2
    """How far the bias of the position wanders on long drives [m]; each journey's own scale is estimated from there. 0: it
    does not."""
    wander_length_m: Length = 3000.0
    """Way over which its correlation falls to 1/e [m]. Drives of half of that wander; from a fifth on where they show it.
    The signs of a crowd may tell that it is a half, a quarter or an eighth of this: that is taken then."""
    drift_sigma_m: Sigma = 0.25
    """Slow error of the position [m]; with it the paper's method ends near the paper's relative error (docs/RESULTS.md)."""
    drift_length_m: Length = 150.0
    """Way over which its correlation falls to 1/e [m]."""
    rotation_sigma_deg: Sigma = 0.15
    """Slow error of the rotation [deg]. A consumer gyro of 0.014 deg/s/sqrt(Hz) alone walks 0.04 in the ten seconds that
    100 m take; what holds it to the vertical and to the way wanders too."""
    rotation_length_m: Length = 100.0
    """Way over which its correlation falls to 1/e [m]."""
    white_sigma_m: SigmaOrNone = 0.02
    """Noise of the position from frame to frame [m]: what a filter of GNSS and IMU leaves, as in simulations. Where frames
    of a drive show more, what they show counts, up to ten times this."""
    white_sigma_deg: SigmaOrNone = 0.03
    """Noise of the rotation from frame to frame [deg]; fits of single drives hardly tell 0.02 from 0.03 (kitti-signs)."""

    @property
    def walk_m(self) -> float:
        """Random walk of the position over one metre [m]: what the drift is over ways far shorter than its length."""
        return self.drift_sigma_m * math.sqrt(2 / self.drift_length_m)

    @property
    def walk_rad(self) -> float:
        """Random walk of the rotation over one metre [rad]."""
        return self.rotation_sigma_rad * math.sqrt(2 / self.rotation_length_m)

    @property
    def bias_sigma_rad(self) -> float:
        """Constant error of the rotation [rad]."""
        return math.radians(self.bias_sigma_deg)

    @property
    def rotation_sigma_rad(self) -> float:
        """Slow error of the rotation [rad]."""
        return math.radians(self.rotation_sigma_deg)

    @property
    def white_sigma_rad(self) -> float:
        """Noise of the rotation from frame to frame [rad]."""
        return math.radians(self.white_sigma_deg)


@dataclass(frozen=True)
class DriftPathConfig(Settings):
    """How the drift of one drive is estimated along with what was seen."""

    scales: Annotated[tuple[Factor, ...], FILLED] = (0.125, 0.25, 0.5, 1.0, 2.0)
    """Multiples of the usual drift of which each journey shows the most likely."""
    sigma_log_scale: Sigma = 0.7
    """Spread of the logarithm of that multiple among journeys."""
    knot_m: Spacing = 4.0
    """Distance between the knots of the path."""
    max_window_m: Length = 160.0
    """Views further from the closest one share the drift there: detections that follow the car for miles are false."""

    slip_sigma_rad: Sigma = 0.03
    """1-sigma of the angle between the camera's axis and the car's, beyond what is known of it."""
    lever_sigma_m: Sigma = 1.0
    """1-sigma of the distance of the camera from the axle that does not steer, likewise."""


@dataclass(frozen=True)
class PathPlaces:
    """Places on the path, between two knots each."""

    before: Int[Tensor, " m"]
    """The knot before each place; the one after it is the next."""
    share: Float[Tensor, " m"]
    """Weight of the knot after it; the one before has the rest."""

    def drift(self, at_knots: Float[Tensor, "k 8"]) -> Float[Tensor, "m 8"]:
        """The drift there, interpolated."""
        share = self.share[:, None]
        return (1 - share) * at_knots[self.before] + share * at_knots[self.before + 1]


def left_between_knots(
    positioning: PositioningNoise, config: DriftPathConfig
) -> tuple[float, float]:
    """Variance of positions and of rotations that interpolation between knots leaves of the walk, on average."""
    return positioning.walk_m**2 * config.knot_m / 6, positioning.walk_rad**2 * config.knot_m / 6


def knot_count(station: Float[Tensor, " f"], config: DriftPathConfig) -> int:
    """Knots that reach from the start to the end of a drive."""
    return int(station.max() / config.knot_m) + 2


def places_on_path(station: Float[Tensor, " m"], config: DriftPathConfig) -> PathPlaces:
    """Where stations [m] lie between knots."""
    position = station / config.knot_m
    before = position.floor().long()
    return PathPlaces(before, position - before)


def drift_terms(
    knots: int,
    scale: float,
    like: Float[Tensor, "*any"],
    positioning: PositioningNoise,
    config: DriftPathConfig,
) -> dict[str, CostTerm]:
    """The chain of the variable `drift`, that of the poses in multiples `scale` of its usual standard deviations."""
    p = positioning
    usual = like.new_tensor((p.drift_sigma_m,) * 3 + (p.rotation_sigma_rad,) * 3)
    car = like.new_tensor((config.slip_sigma_rad, config.lever_sigma_m))
    far = torch.cat((scale * usual, car))
    way = like.new_tensor(
        (p.drift_length_m,) * 3 + (p.rotation_length_m,) * 3 + (CAR_CHANGES_M,) * 2
    )
    keep = torch.exp(-config.knot_m / way)
    before = torch.arange(knots - 1, device=like.device)
    at_rest = torch.zeros_like(far)
    return {
        "drift_step": CostTerm(
            gauss_markov_step,
            (("drift", before), ("drift", before + 1)),
            (at_rest.expand(len(before), 8), keep.expand(len(before), 8)),
            weight=(1 / (far * (1 - keep.square()).sqrt())).expand(len(before), 8),
            jacobian=gauss_markov_step_jacobian,
        ),
        "drift_start": CostTerm(
            gauss_markov_start,
            (("drift", before[:1]),),
            (at_rest[None],),
            (1 / far)[None],
            takes_rows=True,
        ),
    }
