"""What cars have wrong, as the linear estimator finds it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from crowdmap_torch.adjustment.calibration import CalibrationConfig
from crowdmap_torch.evaluation.signs import evaluate_signs
from crowdmap_torch.geometry import se3
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.simulate.dataset import SimulationConfig, write_dataset
from crowdmap_torch.simulate.errors import with_errors
from crowdmap_torch.simulate.fleet import FleetConfig
from crowdmap_torch.simulate.rigs import RigConfig
from crowdmap_torch.simulate.vehicle import VehicleConfig
from crowdmap_torch.simulate.worlds import WORLD_PRESETS
from crowdmap_torch.studies import linear_map as module
from crowdmap_torch.studies.linear_cars import calibration_of, prior_of_cars
from crowdmap_torch.studies.linear_map import LinearMap, linear_map
from crowdmap_torch.studies.measure import Drives, load_drives

ERRORS = ("mounts", "focals", "principals", "clocks", "shutters", "boxes", "lane-offsets")


@pytest.fixture(scope="module")
def simulation() -> SimulationConfig:
    """Four drives of two cars on a short street, with five times the errors that real ones have."""
    street = WORLD_PRESETS["street"]
    signs = replace(street.signs, posts_per_km=60.0)
    right = SimulationConfig(
        world=replace(street, length_m=120.0, lights_per_km=0.0, signs=signs),
        vehicle=VehicleConfig(frame_rate_hz=8.0),
        rig=RigConfig(camera="pinhole"),
        fleet=FleetConfig(vehicles=2),
        journeys=4,
    )
    return with_errors(right, ERRORS, 5.0)


@pytest.fixture(scope="module")
def folder(simulation: SimulationConfig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("cars") / "dataset"
    write_dataset(simulation, place)
    return place


@pytest.fixture(scope="module")
def drives(folder: Path) -> Drives:
    return load_drives(folder)


def estimate(
    drives: Drives, folder: Path, simulation: SimulationConfig, *, know_cars: bool = False
) -> LinearMap:
    vehicles = None if know_cars else drives.vehicles
    signs = read_map(folder / "survey").signs
    assert drives.survey is not None and drives.truth is not None
    return linear_map(drives.truth, drives.survey, signs, simulation, vehicles)


@torch.no_grad()
def test_mounts_and_clocks_explain_what_poses_are_wrong_by(
    drives: Drives, folder: Path, simulation: SimulationConfig
):
    assert drives.survey is not None and drives.truth is not None
    signs = read_map(folder / "survey").signs
    bundle = module._bundle_at_truth(
        *(drives.truth, drives.survey, signs, torch.arange(len(signs))),
        *(drives.vehicles, calibration_of(simulation.fleet)),
    )
    given = torch.cat([t.journey.T_world_camera for t in drives.truth.journeys])[bundle.frame]
    values, fleet = bundle.values(), bundle.fleet
    error = se3.local(given, values["pose"])
    moved = fleet.by_mount(values["pose"]) @ values["mount"][fleet.of_pose][..., None]
    turns, left = error[:, 3:], error[:, 3:] - moved[:, 3:, 0]
    # A degree of mount about each axis; drift and noise of rotations are 0.15 degrees.
    assert left.square().mean().sqrt() < 0.4 * turns.square().mean().sqrt()


def test_cars_that_are_wrong_are_found_so(
    drives: Drives, folder: Path, simulation: SimulationConfig
):
    """By who takes them for right, signs are off by decimetres more."""
    assert drives.survey is not None
    found = estimate(drives, folder, simulation)
    blind = estimate(drives, folder, simulation, know_cars=True)
    errors = [evaluate_signs(one.signs, drives.survey.signs) for one in (found, blind)]
    means = [error.absolute.total.mean for error in errors]
    assert means[0] is not None and means[1] is not None and means[0] < 0.7 * means[1]


def test_what_has_to_be_found_costs_the_bound_something(
    drives: Drives, folder: Path, simulation: SimulationConfig
):
    """And what cannot be far off does not."""

    def bound(factor: float) -> float:
        sizes = {k: v for k, v in vars(simulation.fleet).items() if isinstance(v, float)}
        fleet = replace(simulation.fleet, **{k: factor * v for k, v in sizes.items()})
        found = estimate(drives, folder, replace(simulation, fleet=fleet))
        return float(found.signs.covariance.diagonal(dim1=1, dim2=2).sum(1).mean())

    known = bound(1e-6)
    assert bound(1e-5) == pytest.approx(known, rel=1e-4)
    assert bound(1.0) > 1.05 * known


@torch.no_grad()
def test_boxes_are_too_large_alike(drives: Drives, folder: Path, simulation: SimulationConfig):
    assert drives.survey is not None and drives.truth is not None
    config = calibration_of(simulation.fleet)
    assert config.height_m == config.load_m == config.corner_px == 0
    assert CalibrationConfig.off() == calibration_of(FleetConfig())
    signs = read_map(folder / "survey").signs
    bundle = module._bundle_at_truth(
        *(drives.truth, drives.survey, signs, torch.arange(len(signs))), *(drives.vehicles, config)
    )
    terms = {
        name: (information, force)
        for name, information, force in prior_of_cars(
            bundle.values(), bundle.fleet, simulation.fleet
        )
    }
    information, force = terms["optics"]
    cars, k = bundle.values()["optics"].shape
    covariance = torch.linalg.inv(information).view(cars, k, cars, k)
    own, mean = simulation.fleet.box_error**2, simulation.fleet.box_error_mean**2
    box = bundle.fleet.config
    assert box.box == pytest.approx((own + mean) ** 0.5)
    shared = covariance[0, :, 1].diagonal()
    assert float(shared.max()) == pytest.approx(mean / (own + mean))
    assert int((shared.abs() > 1e-9).sum()) == 1
    torch.testing.assert_close(force, information @ bundle.values()["optics"].flatten())
