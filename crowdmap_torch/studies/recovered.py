"""How well an adjustment finds what cars have wrong, and whether it knows how well."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from crowdmap_torch.adjustment.covariance import MapUncertainty
from crowdmap_torch.studies.chapter import Cell, Table

TRUE_NAMES = {
    "mount_deg": "mount_rotation_deg",
    "mount_m": "mount_place_m",
    "clock_s": "clock_s",
    "focal": "focal_share",
    "principal_px": "principal_point_px",
    "read_out_s": "read_out_s",
    "box": "box_share",
    "corner_px": "corner_px",
    "lane_m": "lane_left_m",
    "height_m": "camera_height_m",
}
"""What a simulation's truth calls each parameter of a calibration."""
_NORMAL_95 = 1.96
COLUMNS = (
    "parameter",
    "error",
    "1-sigma",
    "inside 95 % [%]",
    "mean of the cars: error",
    "1-sigma of that",
    "its squared error in sigmas",
    "from car to car: error",
    "1-sigma of those",
    "inside 95 % [%], car to car",
    "numbers",
)


def recovered(uncertainty: MapUncertainty, vehicles: Mapping[str, Any]) -> dict[str, Any]:
    """By parameter of a calibration, estimates less truth and 1-sigmas of every number [car, number], and of their mean."""
    cars = uncertainty.calibration
    return {
        name: {
            "errors": [
                np.subtract(found.estimate[name], vehicles[car][true]).ravel().tolist()
                for car, found in cars.items()
            ],
            "sigmas": [list(found.sigma[name]) for found in cars.values()],
            "mean_sigma": list(uncertainty.calibration_mean_sigma[name]),
        }
        for name, true in TRUE_NAMES.items()
        if name in uncertainty.calibration_mean_sigma
    }


def recovered_table(name: str, maps: Sequence[Mapping[str, Any]], caption: str) -> Table:
    """Errors of all numbers of each parameter, RMS, beside what the adjustment says of them.

    What all cars have in common is told apart from what they differ in: of a map it is one number, however many cars.
    """
    found = [one["calibration"] for one in maps if one.get("calibration")]
    parameters = [key for key in TRUE_NAMES if found and key in found[0]]
    return Table(name, COLUMNS, tuple(_row(key, found) for key in parameters), caption)


def _row(name: str, found: Sequence[Mapping[str, Any]]) -> tuple[Cell, ...]:
    error, sigma = (_joined(found, name, part) for part in ("errors", "sigmas"))
    # Of every map and number, one mean over its cars.
    means = np.concatenate([np.mean(one[name]["errors"], axis=0) for one in found])
    of_mean = np.concatenate([one[name]["mean_sigma"] for one in found])
    by_map = [np.asarray(one[name]["errors"]) for one in found]
    apart = np.concatenate([(one - one.mean(0)).ravel() for one in by_map])
    variance = [
        np.square(one[name]["sigmas"]) - np.square(one[name]["mean_sigma"]) for one in found
    ]
    sigma_apart = np.sqrt(np.concatenate([part.ravel() for part in variance]).clip(1e-30))
    return (
        name,
        _rms(error),
        _rms(sigma),
        100 * float(np.mean(np.abs(error) < _NORMAL_95 * sigma)),
        _rms(means),
        _rms(of_mean),
        float(np.mean(np.square(means / of_mean))),
        _rms(apart),
        _rms(sigma_apart),
        100 * float(np.mean(np.abs(apart) < _NORMAL_95 * sigma_apart)),
        len(error),
    )


def _joined(found: Sequence[Mapping[str, Any]], name: str, part: str) -> np.ndarray:
    return np.concatenate([np.ravel(one[name][part]) for one in found])


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
