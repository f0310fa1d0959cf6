"""A whole simulated dataset: one world, one fleet, many journeys, and the truth about all of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from jaxtyping import Float

from crowdmap_torch.io.atomic import atomic_folder
from crowdmap_torch.io.documents import write_json
from crowdmap_torch.ranges import Count, Seed, Settings
from crowdmap_torch.simulate import faults, files, lane_perception, sign_detections
from crowdmap_torch.simulate.fleet import FleetConfig, Vehicle, build_vehicle
from crowdmap_torch.simulate.lane_perception import LaneDetectionConfig, LaneRows, detect_lanes
from crowdmap_torch.simulate.motion import Motion
from crowdmap_torch.simulate.passing import passing
from crowdmap_torch.simulate.positioning import (
    DriveErrors,
    PositioningConfig,
    drive_errors,
    measured_poses,
    pose_errors,
    reported_sigmas,
)
from crowdmap_torch.simulate.recorded import drive_again
from crowdmap_torch.simulate.rigs import RigConfig, SimulatedRig, build_rig
from crowdmap_torch.simulate.sign_detections import SignDetectionConfig, SignRows
from crowdmap_torch.simulate.sign_perception import detect_signs
from crowdmap_torch.simulate.vehicle import Drive, VehicleConfig, drive_through
from crowdmap_torch.simulate.worlds import WORLD_PRESETS, World, WorldConfig, build_world, on_route

_WORLD, _RIG, _JOURNEY, _FAULTS, _VEHICLE, _DETECTOR, _DRIVE, _ROUTE = range(8)
"""Streams of random numbers: what one of them draws does not depend on how much the others did."""
_FIRST_START = datetime(2026, 5, 1, 8, 0, tzinfo=UTC)
DETECTION_PRESETS = {
    "day": (sign_detections.DAY, lane_perception.DAY),
    "night": (sign_detections.NIGHT, lane_perception.NIGHT),
}


@dataclass(frozen=True)
class SimulationConfig(Settings):
    """Everything that decides a dataset; the same configuration gives the same bytes."""

    world: WorldConfig = field(default_factory=lambda: WORLD_PRESETS["suburb"])
    vehicle: VehicleConfig = field(default_factory=VehicleConfig)
    rig: RigConfig = field(default_factory=RigConfig)
    fleet: FleetConfig = field(default_factory=FleetConfig)
    positioning: PositioningConfig = field(default_factory=PositioningConfig)
    signs: SignDetectionConfig = field(default_factory=SignDetectionConfig)
    lanes: LaneDetectionConfig = field(default_factory=LaneDetectionConfig)
    journeys: Count = 25
    seed: Seed = 0
    world_seed: Seed | None = None
    """Seed of the world alone, `seed` if not given: other journeys in the same world."""
    bad_drives: tuple[str, ...] = ()
    """One journey is spoilt for each of these `faults.KINDS`."""


@dataclass(frozen=True)
class SimulatedJourney:
    """One journey as it was, and as its files tell it."""

    journey_id: str
    vehicle: Vehicle
    drive: Drive
    """As each picture is taken, in its middle row."""
    started: datetime
    T_world_link: Float[np.ndarray, "f 4 4"]
    """Poses of the pose link of which the mount as it is stated makes the true poses of the camera."""
    T_reported: Float[np.ndarray, "f 4 4"]
    errors: DriveErrors
    signs: SignRows
    lanes: LaneRows
    fault: str | None


def make_world(config: SimulationConfig) -> World:
    """The world of a dataset."""
    seed = config.seed if config.world_seed is None else config.world_seed
    return build_world(config.world, np.random.default_rng([seed, _WORLD]))


def make_rigs(config: SimulationConfig) -> tuple[SimulatedRig, ...]:
    """The rigs, as they are stated."""
    return tuple(
        build_rig(config.rig, index, np.random.default_rng([config.seed, _RIG, index]))
        for index in range(config.rig.rigs)
    )


def make_fleet(config: SimulationConfig, world: World | None = None) -> tuple[Vehicle, ...]:
    """The vehicles that drive the journeys in turn, with the rigs of a world's recordings if it has some."""
    rigs = _rigs(config, world)
    fleet = []
    for index in range(config.fleet.vehicles or len(rigs)):
        number = index % len(rigs)
        detector = (0, number) if config.fleet.one_detector else (1, index)
        fleet.append(
            build_vehicle(
                config.fleet,
                index,
                rigs[number],
                np.random.default_rng([config.seed, _VEHICLE, index]),
                np.random.default_rng([config.seed, _DETECTOR, *detector]),
            )
        )
    return tuple(fleet)


def _rigs(config: SimulationConfig, world: World | None) -> tuple[SimulatedRig, ...]:
    if world is None or not world.recordings:
        return make_rigs(config)
    return tuple({recording.rig.rig_id: recording.rig for recording in world.recordings}.values())


def make_journey(
    config: SimulationConfig,
    world: World,
    fleet: tuple[Vehicle, ...],
    index: int,
    fault: str | None = None,
) -> SimulatedJourney:
    """The `index`-th journey; it does not depend on how many there are."""
    rng = np.random.default_rng([config.seed, _JOURNEY, index])
    drive_rng, pose_rng, sign_rng, lane_rng, fault_rng, burst_rng = rng.spawn(6)
    vehicle = fleet[index % len(fleet)]
    # With both directions the vehicles take turns in pairs, so that each of them drives both ways.
    direction = 1
    if config.world.both_directions:
        direction = 1 if index % 2 == 0 else -1
        vehicle = fleet[index // 2 % len(fleet)]
    drive = _drive(config, world, vehicle, index, drive_rng, direction=direction)
    wrong = drive_errors(
        drive.distance, config.positioning, np.random.default_rng([config.seed, _DRIVE, index])
    )
    error = pose_errors(drive.distance, config.positioning, pose_rng)
    shift = wrong.shift(drive.distance)
    if wrong.bursts is not None:
        shift = shift + wrong.bursts.noise(drive.distance, drive.t, burst_rng)
    error = replace(error, translation=error.translation + shift)
    T_reported = measured_poses(_stamped_poses(drive, vehicle), error)
    if wrong.freezes is not None:
        T_reported = wrong.freezes.held(T_reported, drive.distance, drive.t)
    true_camera = vehicle.true_rig.camera
    seen_from, camera = faults.with_sensor_fault(drive, true_camera, fault, fault_rng)
    claimed = faults.with_upload_fault(world.signs, fault, fault_rng)
    rate = config.vehicle.frame_rate_hz
    return SimulatedJourney(
        journey_id=_journey_id(index),
        vehicle=vehicle,
        drive=drive,
        started=_FIRST_START + timedelta(hours=19 * index),
        T_world_link=_camera_poses(drive) @ np.linalg.inv(vehicle.rig.T_link_camera),
        T_reported=faults.with_pose_fault(T_reported, drive, fault, fault_rng),
        errors=wrong,
        signs=detect_signs(
            claimed,
            seen_from,
            camera,
            config.signs,
            sign_rng,
            frame_rate_hz=rate,
            errors=vehicle.errors,
            streets=world.streets,
        ),
        lanes=detect_lanes(
            world,
            seen_from,
            camera,
            config.lanes,
            lane_rng,
            frame_rate_hz=rate,
            errors=vehicle.errors,
        ),
        fault=fault,
    )


def _drive(
    config: SimulationConfig,
    world: World,
    vehicle: Vehicle,
    index: int,
    rng: np.random.Generator,
    *,
    direction: int,
) -> Drive:
    """The truth of the `index`-th journey: along the road, or as one of the vehicle's rig was driven before."""
    rig = vehicle.true_rig
    if world.recordings:
        own = [r for r in world.recordings if r.rig.rig_id == vehicle.rig.rig_id]
        drive = drive_again(
            own[index % len(own)], vehicle.rig, rig, world.road, config.vehicle, rng
        )
    else:
        route_rng = np.random.default_rng([config.seed, _ROUTE, index])
        changes = config.vehicle.lane_changes_per_km
        way = on_route(world, route_rng, changes_per_km=changes)
        drive = drive_through(way, rig, config.vehicle, rng, direction=direction)
    if not world.is_map:
        return drive
    ahead = drive.R_world_camera[:, :, 2]
    return replace(drive, passing=passing(world.markers, drive.p_world_camera, ahead))


def write_dataset(
    config: SimulationConfig,
    out: Path,
    *,
    world: World | None = None,
    overwrite: bool = False,
    on_journey: Callable[[int], None] = lambda _: None,
) -> World:
    """Simulates and writes a dataset with its survey, in the configuration's world or a given one.

    `on_journey` is called after each journey.
    """
    if out.exists():
        if not overwrite:
            raise ValueError(f"{out} exists already; choose another folder or pass --overwrite")
        if not out.is_dir() or (any(out.iterdir()) and not (out / "dataset.json").exists()):
            raise ValueError(f"{out} is no dataset (it has no dataset.json); it is left alone")
    world = make_world(config) if world is None else world
    fleet = make_fleet(config, world)
    drives = {}
    rng = np.random.default_rng([config.seed, _FAULTS])
    fault_of = faults.spread_faults(config.bad_drives, config.journeys, rng)
    settings = {"generator": "crowdmap_torch.simulate", "settings": asdict(config)}
    with atomic_folder(out) as folder:
        write_json(
            folder / "dataset.json",
            {"format": "crowdmap-dataset", "version": 1, "origin": asdict(world.origin)},
        )
        for rig in _rigs(config, world):
            files.write_rig(folder / "rigs" / rig.rig_id, rig)
        for index in range(config.journeys):
            journey = make_journey(config, world, fleet, index, fault_of[index])
            _write_journey(config, folder, world, journey)
            drives[journey.journey_id] = {
                "vehicle_id": journey.vehicle.vehicle_id,
                **asdict(journey.errors),
            }
            on_journey(index)
        files.write_survey(folder / "survey", world, settings)
        write_json(
            folder / "survey" / "truth" / "bad_drives.json",
            {_journey_id(k): fault for k, fault in enumerate(fault_of) if fault is not None},
        )
        files.write_vehicles(folder / "survey" / "truth" / "vehicles.json", fleet)
        write_json(folder / "survey" / "truth" / "drives.json", drives)
    return world


def _write_journey(
    config: SimulationConfig, out: Path, world: World, journey: SimulatedJourney
) -> None:
    folder = out / "journeys" / journey.journey_id
    started_ns = round(journey.started.timestamp()) * 10**9
    write_json(
        folder / "journey.json",
        {
            "format": "crowdmap-journey",
            "version": 1,
            "journey_id": journey.journey_id,
            "rig": journey.vehicle.rig.rig_id,
            "vehicle_id": journey.vehicle.vehicle_id,
            "started_at": journey.started.strftime("%Y-%m-%dT%H:%M:%SZ"),
        },
    )
    files.write_drive_poses(
        folder / "poses.parquet",
        journey.drive,
        journey.T_reported,
        started_ns,
        reported_sigmas(config.positioning, journey.errors),
    )
    files.write_sign_rows(folder / "signs.parquet", journey.signs, journey.drive, world)
    files.write_lane_rows(folder / "lanes.parquet", journey.lanes, journey.drive)
    files.write_truth(
        out / "survey" / "truth" / journey.journey_id,
        world,
        journey.drive,
        journey.T_world_link,
        started_ns,
        journey.signs,
        journey.lanes,
    )


def _journey_id(index: int) -> str:
    return f"journey-{index:03d}"


def _stamped_poses(drive: Drive, vehicle: Vehicle) -> Float[np.ndarray, "f 4 4"]:
    """True poses of the link that the positioning module reports, at the stamps of the pictures: the body is rigid."""
    late = vehicle.errors.clock_s
    T_world_camera = Motion(drive).poses(drive.t - late) if late else _camera_poses(drive)
    return T_world_camera @ np.linalg.inv(vehicle.true_rig.T_link_camera)


def _camera_poses(drive: Drive) -> Float[np.ndarray, "f 4 4"]:
    T_world_camera = np.zeros((len(drive), 4, 4))
    T_world_camera[:, :3, :3] = drive.R_world_camera
    T_world_camera[:, :3, 3] = drive.p_world_camera
    T_world_camera[:, 3, 3] = 1.0
    return T_world_camera
