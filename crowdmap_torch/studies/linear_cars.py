"""What cars have wrong, as unknowns of the linear estimator: it knows how far they may be, as a simulation draws them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.adjustment.calibration import CalibrationConfig, Fleet, columns
from crowdmap_torch.simulate.fleet import FleetConfig
from crowdmap_torch.studies.recovered import TRUE_NAMES


def calibration_of(fleet: FleetConfig) -> CalibrationConfig:
    """How far the cars of a simulation are from what is stated, 1-sigma; heights, which no pixel shows, are known."""
    return CalibrationConfig(
        mount_deg=fleet.mount_error_deg,
        mount_m=fleet.mount_error_m,
        clock_s=fleet.clock_error_s,
        focal=fleet.focal_error,
        principal_px=fleet.principal_error_px,
        read_out_s=fleet.read_out_s,
        box=math.hypot(fleet.box_error, fleet.box_error_mean),
        corner_px=fleet.corner_error_px,
        lane_m=fleet.lane_error_m,
        height_m=0.0,
        load_m=0.0,
    )


def true_cars(
    values: Mapping[str, Tensor], fleet: Fleet, vehicles: Mapping[str, Any]
) -> dict[str, Tensor]:
    """The `values` of a bundle with those of its cars as they truly are, by the `vehicles` of a simulation's truth."""
    changed = dict(values)
    for name in fleet.variables:
        changed[name] = torch.zeros_like(values[name])
        for parameter, at in columns(name, fleet.config).items():
            for car, of_car in zip(fleet.vehicles, changed[name], strict=True):
                true = torch.as_tensor(vehicles[car][TRUE_NAMES[parameter]]).to(of_car)
                of_car[at] = true / getattr(fleet.config, parameter)
    return changed


def prior_of_cars(
    values: Mapping[str, Tensor], fleet: Fleet, drawn: FleetConfig
) -> Iterator[tuple[str, Float[Tensor, "c c"], Float[Tensor, " c"]]]:
    """By variable of the cars, information and force of what is known before: zero is likeliest, cars err each for itself.

    But boxes: those of all cars are too large by a share that they have in common.
    """
    for name in fleet.variables:
        cars, k = values[name].shape
        information = torch.eye(cars * k).to(values[name]).view(cars, k, cars, k)
        if (box := columns(name, fleet.config).get("box")) is not None:
            own, mean = drawn.box_error**2, drawn.box_error_mean**2
            # Of a common share alone all cars have the same: they would be one unknown.
            own = max(own, 1e-6 * mean)
            covariance = own * torch.eye(cars).to(values[name]) + mean
            information[:, box.start, :, box.start] = torch.linalg.inv(covariance / (own + mean))
        information = information.reshape(cars * k, cars * k)
        yield name, information, information @ values[name].flatten()
