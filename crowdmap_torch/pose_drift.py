"""Drift of a journey's poses: one smooth path of errors for the whole drive, position and rotation, with a known spread.

A knot holds the error of position and rotation (6), and how the camera stands in the car: the angle from its axis to the
course, and the lever by which it swings out in bends, both next to constant (`drift_course`).

The error is a Gauss-Markov chain over knots along the way: bound to the knot before, and drawn towards zero over the
way on which the positioning forgets. All landmarks of a journey share it, so each of them is held by what the
others, seen from the same stretch, say of the way between views.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.problem import CostTerm

CAR_CHANGES_M = 1e6
"""Way over which a camera's place in its car changes."""


@dataclass(frozen=True)
class DriftConfig:
    """How the error of poses changes along a drive."""

    sigma_m: float = 0.029
    """Standard deviation of positions over one metre, per axis, of a usual drive; it grows with the root of the way."""
    sigma_rad: float = 3.7e-4
    """The same of rotations."""
    scales: tuple[float, ...] = (0.125, 0.25, 0.5, 1.0, 2.0)
    """Multiples of the two of which each journey shows the most likely."""
    sigma_log_scale: float = 0.7
    """Spread of the logarithm of that multiple among journeys."""
    forget_m: float = 150.0
    """Way over which the error falls to 1/e of what it was."""
    knot_m: float = 4.0
    """Distance between the knots of the path."""
    max_window_m: float = 160.0
    """Views further from the closest one share the drift there: detections that follow the car for miles are false."""

    slip_sigma_rad: float = 0.03
    """1-sigma of the angle between the camera's axis and the car's course, beyond what is known of it."""
    lever_sigma_m: float = 1.0
    """1-sigma of the distance of the camera from the axle that does not steer, likewise."""

    @property
    def left_between(self) -> tuple[float, float]:
        """Variance of positions and of rotations that interpolation between knots leaves of the walk, on average."""
        return self.sigma_m**2 * self.knot_m / 6, self.sigma_rad**2 * self.knot_m / 6


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


def knot_count(station: Float[Tensor, " f"], config: DriftConfig) -> int:
    """Knots that reach from the start to the end of a drive."""
    return int(station.max() / config.knot_m) + 2


def places_on_path(station: Float[Tensor, " m"], config: DriftConfig) -> PathPlaces:
    """Where stations [m] lie between knots."""
    position = station / config.knot_m
    before = position.floor().long()
    return PathPlaces(before, position - before)


def closest_view(away: Float[Tensor, " m"], group: Int[Tensor, " m"]) -> Int[Tensor, " g"]:
    """The row with the least `away` of each group, the first of equals; every group must have a row."""
    # Sorted by group and then by distance, the first row of each group is the one.
    order = torch.argsort(away, stable=True)
    order = order[torch.argsort(group[order], stable=True)]
    count = torch.bincount(group)
    return order[count.cumsum(0) - count]


def drift_step(
    before: Float[Tensor, " 8"], after: Float[Tensor, " 8"], keep: Float[Tensor, " 8"]
) -> Float[Tensor, " 8"]:
    """What is new in the drift from one knot to the next, the share `keep` of the old being left."""
    return after - keep * before


def drift_start(drift: Float[Tensor, " 8"]) -> Float[Tensor, " 8"]:
    """Drift at the first knot."""
    return drift.clone()


def drift_terms(
    knots: int, config: DriftConfig, scale: float, like: Float[Tensor, "*any"]
) -> dict[str, CostTerm]:
    """The chain of the variable `drift`, that of the poses in multiples `scale` of its usual standard deviations."""
    walk = scale * like.new_tensor((config.sigma_m,) * 3 + (config.sigma_rad,) * 3)
    # A walk of that spread, pulled back so, has this spread in the long run.
    far = walk * (config.forget_m / 2) ** 0.5
    car = like.new_tensor((config.slip_sigma_rad, config.lever_sigma_m))
    far = torch.cat((far, car))
    way = like.new_tensor((config.forget_m,) * 6 + (CAR_CHANGES_M,) * 2)
    keep = torch.exp(-config.knot_m / way)
    before = torch.arange(knots - 1, device=like.device)
    eye = torch.eye(8, dtype=like.dtype, device=like.device)

    def step_jacobian(a: Tensor, b: Tensor, keep: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        return b - keep * a, (-torch.diag_embed(keep), eye.expand(len(a), 8, 8))

    def start_jacobian(a: Tensor) -> tuple[Tensor, tuple[Tensor]]:
        return a, (eye.expand(len(a), 8, 8),)

    return {
        "drift_step": CostTerm(
            drift_step,
            (("drift", before), ("drift", before + 1)),
            (keep.expand(len(before), 8),),
            weight=(1 / (far * (1 - keep.square()).sqrt())).expand(len(before), 8),
            jacobian=step_jacobian,
        ),
        "drift_start": CostTerm(
            drift_start,
            (("drift", before[:1]),),
            weight=(1 / far)[None],
            jacobian=start_jacobian,
        ),
    }
