"""What cars have wrong: against the true camera, and found again in drives that have it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from crowdmap_torch import mapper
from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.calibration import CalibrationConfig, Fleet, columns, fleet_of
from crowdmap_torch.adjustment.calibration_priors import CalibrationScales, priors
from crowdmap_torch.adjustment.found_calibration import FleetCalibration
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.geometry import camera, se3
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.noise.calibration import KnownCalibration
from crowdmap_torch.optim.linearize import residuals
from crowdmap_torch.simulate.dataset import SimulationConfig, write_dataset
from crowdmap_torch.simulate.fleet import FleetConfig
from crowdmap_torch.simulate.rigs import RigConfig
from crowdmap_torch.simulate.vehicle import VehicleConfig
from crowdmap_torch.simulate.worlds import WORLD_PRESETS
from crowdmap_torch.tables import Dataset

F64 = torch.float64


def bundle_of(dataset: Dataset, result: MapResult, config: MapperConfig) -> Bundle:
    return mapper.build_bundle(dataset.journeys, result.journey_maps, result.first, config)


def with_calibration(bundle: Bundle, variable: str, **wrong: float | tuple[float, ...]) -> None:
    """Puts the calibration of all cars at these numbers, and looks at everything anew."""
    values = bundle.values()
    config = bundle.fleet.config
    for name, at in columns(variable, config).items():
        if name in wrong:
            values[variable][:, at] = torch.tensor(wrong[name], dtype=F64) / getattr(config, name)
    bundle.fold(values)
    bundle.relinearise()


def corner_errors(bundle: Bundle) -> Tensor:
    term = bundle.problem().terms["sign_reprojection"]
    assert term.weight is not None
    return residuals(replace(term, weight=None), bundle.values())


def seen_points(bundle: Bundle) -> Tensor:
    """The corners of the map in the frames of their detections."""
    rows, values = bundle.corners, bundle.values()
    plane = torch.nn.functional.pad(rows.template * values["size"][rows.sign], (0, 1))
    point = se3.transform(values["sign"][rows.sign], plane)
    return se3.transform(se3.inverse(values["pose"])[rows.frame], point)


def seen_at(bundle: Bundle, point_camera: Tensor) -> Tensor:
    """The pixels of points, each by its own camera as it is stated."""
    px = torch.zeros_like(bundle.corners.px)
    for number, lens in enumerate(bundle.lenses):
        mine = bundle.corners.lens == number
        px = px.index_put((mine,), camera.project(lens, point_camera[mine])[0])
    return px


def test_corners_are_seen_by_the_true_camera(tiny: Dataset, tiny_result: MapResult) -> None:
    bundle = bundle_of(tiny, tiny_result, MapperConfig())
    bundle.refresh()
    focal, principal, box = 0.004, (2.0, -3.0), 0.02
    with_calibration(bundle, "optics", focal=focal, principal_px=principal, box=box)
    point, rows = seen_points(bundle), bundle.corners
    for number, lens in enumerate(bundle.lenses):
        K = lens.K.clone()
        K[[0, 1], [0, 1]] *= 1 + focal
        K[:2, 2] += torch.tensor(principal, dtype=F64)
        mine = rows.lens == number
        px = camera.project(replace(lens, K=K), point[mine])[0]
        stated = camera.project(lens, point[mine])[0]
        detection = rows.detection[mine]
        for one in detection.unique()[::7]:
            of = detection == one
            grown = box * (stated[of] - stated[of].mean(0))
            expected = px[of] + grown - rows.px[mine][of]
            torch.testing.assert_close(corner_errors(bundle)[mine][of], expected, rtol=0, atol=1e-9)


def test_rows_are_seen_when_they_are_read_out(tiny: Dataset, tiny_result: MapResult) -> None:
    bundle = bundle_of(tiny, tiny_result, MapperConfig())
    bundle.refresh()
    before, point, rows = corner_errors(bundle), seen_points(bundle), bundle.corners
    read_out, fleet = 1e-3, bundle.fleet
    with_calibration(bundle, "optics", read_out_s=read_out)
    px = seen_at(bundle, point)
    tall = torch.tensor([lens.height for lens in bundle.lenses])[rows.lens]
    late = read_out * (px[:, 1] / tall - 0.5)
    pose = bundle.values()["pose"]
    move = torch.cat((fleet.velocity, fleet.turning), dim=-1)[rows.frame] * late[:, None]
    moved = se3.retract(pose[rows.frame], move)
    world = se3.transform(pose[rows.frame], point)
    later = seen_at(bundle, se3.transform(se3.inverse(moved), world))
    # A millisecond of driving is linear to a hundredth of what it does.
    change = corner_errors(bundle) - before
    assert float(change.detach().abs().max()) > 0.05
    torch.testing.assert_close(change, later - px, rtol=0.02, atol=2e-3)


def heights_over_road(bundle: Bundle) -> Tensor:
    term = bundle.problem().terms["lane_height"]
    return residuals(replace(term, weight=None), bundle.values())[:, 0]


@pytest.mark.parametrize("cars", [CalibrationConfig(), CalibrationConfig.off()])
def test_a_load_is_that_of_one_drive(
    tiny: Dataset, tiny_result: MapResult, cars: CalibrationConfig
) -> None:
    load_m = 0.02
    config = replace(MapperConfig(), calibration=replace(cars, load_m=load_m))
    bundle = bundle_of(tiny, tiny_result, config)
    bundle.refresh()
    before, values = heights_over_road(bundle), bundle.values()
    assert values["load"].shape == (len(tiny.journeys), 1)
    drive = int(bundle.lane_points.journey[0])
    values["load"][drive] = 0.5
    bundle.fold(values)
    sunk = torch.where(bundle.lane_points.journey == drive, -0.5 * load_m, 0.0)
    assert bool((sunk == 0).any())
    torch.testing.assert_close(heights_over_road(bundle) - before, sunk.to(F64))


def test_all_known_is_the_adjustment_without(tiny: Dataset, tiny_result: MapResult) -> None:
    off = replace(MapperConfig(), calibration=CalibrationConfig.off())
    bundle = bundle_of(tiny, tiny_result, off)
    assert bundle.fleet.variables == ()
    assert not {"mount", "optics", "load"} & set(bundle.values())
    assert not any("prior" in name for name in bundle.problem().terms if "mount" in name)


def fleet_of_cars(
    dataset: Dataset, config: CalibrationConfig, known: dict[str, KnownCalibration]
) -> Fleet:
    """Of four cars, a to d, that drove once each."""
    journey = dataset.journeys[0]
    cars = [replace(journey, vehicle_id=name) for name in "abcd"]
    first = torch.arange(4) * len(journey.t_ns)
    return fleet_of(cars, first, torch.arange(4), config, known)


def covariance_before(fleet: Fleet, variable: str) -> Tensor:
    """Of all cars' numbers [v, k, v, k], by the rows that are known of them before anything is seen."""
    numbers = sum(start.shape[1] for start in fleet.expected.values())
    ones = (
        torch.ones(len(fleet.kinds), dtype=F64),
        torch.ones(len(fleet.vehicles), numbers).double(),
    )
    every = priors(fleet, CalibrationScales(*ones)).items()
    terms = [term for name, term in every if name.startswith(variable)]

    def cost(x: Tensor) -> Tensor:
        return torch.stack([residuals(t, {variable: x}).square().sum() / 2 for t in terms]).sum()

    x = fleet.expected[variable]
    hessian = torch.autograd.functional.hessian(cost, x)
    assert isinstance(hessian, Tensor)
    return torch.linalg.inv(hessian.reshape(x.numel(), -1)).view(hessian.shape)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 1.0])
def test_cars_have_a_share_of_their_programs_errors_in_common(tiny: Dataset, share: float) -> None:
    config = CalibrationConfig(in_common=share)
    fleet = fleet_of_cars(tiny, config, {})
    found = covariance_before(fleet, "optics")
    for name, at in columns("optics", config).items():
        expected = torch.eye(4, dtype=F64)
        if name in ("read_out_s", "box", "corner_px", "lane_m"):
            expected = share + (1 - share) * expected
        for number in range(at.start, at.stop):
            of_number = found[:, number, :, number]
            torch.testing.assert_close(of_number, expected, rtol=1e-5, atol=1e-5)


def test_what_was_found_of_a_car_has_nothing_in_common_with_the_others(tiny: Dataset) -> None:
    config = CalibrationConfig(in_common=0.5)
    box = columns("optics", config)["box"].start
    fleet = fleet_of_cars(tiny, config, {"b": {"box": ((0.01,), (0.001,))}})
    found = covariance_before(fleet, "optics")[:, box, :, box]
    expected = 0.5 + 0.5 * torch.eye(4, dtype=F64)
    expected[1], expected[:, 1] = 0, 0
    expected[1, 1] = 0.1**2
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-9)


def test_a_lever_arm_turns_with_the_camera_where_it_is_now(tiny: Dataset) -> None:
    fleet = fleet_of_cars(tiny, CalibrationConfig(), {})
    pose = tiny.journeys[0].T_world_camera[:4]
    turned = pose.clone()
    turned[:, :3, :3] = pose[:, :3, :3] @ se3.so3_exp(torch.tensor([0.0, 0.02, 0.0], dtype=F64))
    place = columns("mount", fleet.config)["mount_m"]
    by = fleet.by_mount(turned)[:, :3, place]
    torch.testing.assert_close(by, turned[:, :3, :3] * fleet.config.mount_m)


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two cars on a short street, each driven three times, their mounts, clocks and heights far off."""
    out = tmp_path_factory.mktemp("wrong") / "dataset"
    street = WORLD_PRESETS["street"]
    config = SimulationConfig(
        world=replace(street, length_m=200.0, signs=replace(street.signs, posts_per_km=50.0)),
        vehicle=VehicleConfig(frame_rate_hz=8.0),
        rig=RigConfig(camera="pinhole", rigs=1),
        fleet=FleetConfig(vehicles=2, mount_error_deg=0.4, clock_error_s=0.04, height_error_m=0.08),
        journeys=6,
        seed=5,
    )
    write_dataset(config, out)
    return out


@pytest.fixture(scope="module")
def found(wrong: Path) -> FleetCalibration:
    return mapper.build_map(load_dataset(wrong), MapperConfig()).uncertainty.calibration


def test_what_is_wrong_with_cars_is_found(wrong: Path, found: FleetCalibration) -> None:
    truth = read_vehicles(wrong)
    assert found.keys() == truth.keys()
    off = []
    for name, car in found.items():
        for key, true in (
            ("mount_deg", truth[name]["mount_rotation_deg"]),
            ("clock_s", (truth[name]["clock_s"],)),
            ("height_m", (truth[name]["camera_height_m"],)),
        ):
            for estimate, sigma, value in zip(car.estimate[key], car.sigma[key], true, strict=True):
                assert sigma > 0
                off.append((estimate - value) / sigma)
    # Ten numbers: the mean square of what they are off in sigmas is one, and three with a chance of 1e-3.
    assert sum(x * x for x in off) / len(off) < 3.0
    far = [abs(v) for car in truth.values() for v in car["mount_rotation_deg"]]
    missed = [
        abs(a - b)
        for name, car in found.items()
        for a, b in zip(car.estimate["mount_deg"], truth[name]["mount_rotation_deg"], strict=True)
    ]
    assert sum(missed) < 0.5 * sum(far)


def test_a_cars_height_is_as_unsure_as_its_loads(found: FleetCalibration) -> None:
    three_drives = CalibrationConfig().load_m / 3**0.5
    for car in found.values():
        (sigma,) = car.sigma["height_m"]
        # What is known of cars' heights takes a few hundredths off.
        assert 0.9 * three_drives < sigma < 2 * three_drives


def test_what_cannot_be_seen_is_named(found: FleetCalibration) -> None:
    for car in found.values():
        for name, sigma in car.sigma.items():
            ratio = car.ratio(name)
            assert all(0 < r < 1.01 for r in ratio), name
            # Nobody is surer of what is named than the prior was, by much.
            for label in (x for x in car.unseen if x.startswith(name)):
                assert max(ratio) > 0.7, label
            assert len(sigma) == len(car.prior_sigma[name])


def test_what_was_found_is_where_the_next_adjustment_begins(
    wrong: Path, found: FleetCalibration
) -> None:
    dataset, config = load_dataset(wrong), MapperConfig()
    one = replace(dataset, journeys=dataset.journeys[:1])
    maps = mapper.map_journeys(one.journeys, config)
    first = mapper.first_map(one.journeys, maps, config)
    known = {
        name: {key: (car.estimate[key], car.sigma[key]) for key in car.estimate}
        for name, car in found.items()
    }
    car = found[one.journeys[0].vehicle]
    bundle = mapper.build_bundle(one.journeys, maps, first, config, known_cars=known)
    start = bundle.values()["mount"][0, columns("mount", config.calibration)["mount_deg"]]
    expected = torch.tensor(car.estimate["mount_deg"], dtype=F64)
    torch.testing.assert_close(start * config.calibration.mount_deg, expected)
    adjust.adjust(bundle)
    moved = bundle.values()["mount"][0, columns("mount", config.calibration)["mount_deg"]]
    sigma = torch.tensor(car.sigma["mount_deg"], dtype=F64)
    assert bool(((moved * config.calibration.mount_deg - expected).abs() < 3 * sigma).all())


def read_vehicles(folder: Path) -> dict:
    return json.loads((folder / "survey" / "truth" / "vehicles.json").read_text())
