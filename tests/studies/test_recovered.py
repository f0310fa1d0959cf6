from __future__ import annotations

import numpy as np
import pytest

from crowdmap_torch.mapper import MapResult
from crowdmap_torch.studies.recovered import recovered, recovered_table


def found_of(shared: float, apart: float, cars: int, rng: np.random.Generator) -> dict:
    """A map whose cars err by a draw in common and by one of their own, as sure as they are."""
    errors = shared * rng.normal() + apart * rng.normal(size=(cars, 1))
    sigma, of_mean = np.hypot(shared, apart), np.hypot(shared, apart / cars**0.5)
    return {
        "calibration": {
            "focal": {
                "errors": errors.tolist(),
                "sigmas": np.full((cars, 1), sigma).tolist(),
                "mean_sigma": [of_mean],
            }
        }
    }


def test_what_cars_have_in_common_is_told_apart_from_what_they_differ_in():
    rng = np.random.default_rng(0)
    maps = [found_of(2.0, 0.5, 8, rng) for _ in range(400)]
    table = recovered_table("found", maps, "")
    (row,) = table.rows
    row = dict(zip(table.columns, row, strict=True))
    assert row["parameter"] == "focal" and row["numbers"] == 3200
    # 400 draws in common: their mean square is 1 to within 0.07 (1-sigma).
    assert row["its squared error in sigmas"] == pytest.approx(1, abs=0.2)
    assert row["mean of the cars: error"] == pytest.approx(row["1-sigma of that"], rel=0.1)
    assert row["from car to car: error"] == pytest.approx(0.5 * (7 / 8) ** 0.5, rel=0.05)
    assert row["1-sigma of those"] == pytest.approx(0.5 * (7 / 8) ** 0.5, rel=1e-6)
    assert row["inside 95 % [%], car to car"] == pytest.approx(95, abs=1.5)


def test_maps_without_calibration_have_no_rows():
    assert recovered_table("found", [{"calibration": {}}, {}], "").rows == ()


def test_every_number_is_held_against_its_truth(tiny_result: MapResult):
    uncertainty = tiny_result.uncertainty
    right = {
        "mount_rotation_deg": [0.0] * 3,
        "mount_place_m": [0.0] * 3,
        "principal_point_px": [0.0] * 2,
        "corner_px": [0.0] * 2,
    }
    right |= dict.fromkeys(
        ("clock_s", "focal_share", "read_out_s", "box_share", "lane_left_m", "camera_height_m"), 0.1
    )
    found = recovered(uncertainty, dict.fromkeys(uncertainty.calibration, right))
    for name, one in found.items():
        for car, error, sigma in zip(
            uncertainty.calibration, one["errors"], one["sigmas"], strict=True
        ):
            stated = uncertainty.calibration[car]
            off = 0.1 if len(error) == 1 else 0.0
            assert error == pytest.approx([value - off for value in stated.estimate[name]])
            assert sigma == list(stated.sigma[name])
            # A mean is no less sure than the least sure of those that it is of.
            assert one["mean_sigma"][0] <= max(s[0] for s in one["sigmas"]) * (1 + 1e-9)
