"""Drives: where the camera truly was in every frame, and how the body stood on the road."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.signal import lfilter

from crowdmap_torch.ranges import (
    Angle,
    Degrees,
    Factor,
    FrameRate,
    LengthOrNone,
    Rate,
    Seconds,
    SecondsSpan,
    Settings,
    Share,
    Speed,
)
from crowdmap_torch.simulate.passing import Passing
from crowdmap_torch.simulate.rigs import SimulatedRig
from crowdmap_torch.simulate.sight import Sight
from crowdmap_torch.simulate.worlds import World

_STEP_M = 0.5
"""Station between the nodes of a speed profile."""


@dataclass(frozen=True)
class VehicleConfig(Settings):
    """How cars are driven and sprung."""

    frame_rate_hz: FrameRate = 15.0
    speed_variation: Share = 0.12
    """Amplitude of the speed's slow ups and downs, as a share of it."""
    acceleration: Speed = 1.5
    """Largest, in both directions [m/s^2]."""
    lateral_acceleration: Speed = 2.5
    """What drivers bear in a curve [m/s^2]."""
    stop_probability: Share = 0.4
    """That a traffic light is red."""
    stop_s: SecondsSpan = (3.0, 12.0)
    """Shortest and longest wait at a light."""
    lane_changes_per_km: Rate = 1.0
    wander_m: LengthOrNone = 0.25
    """Amplitude of the sway within a lane."""
    keeping_m: LengthOrNone = 0.12
    """1-sigma of a driver's constant distance from the middle of the lane."""
    load_deg: Angle = 1.0
    """Largest constant pitch of a loaded body; each journey has its own."""
    load_roll_deg: Angle = 0.3
    load_height_m: LengthOrNone = 0.02
    vibration_deg: Degrees = 0.12
    """1-sigma of the body's fast pitch; its roll has half of that."""
    squat_deg: Degrees = 0.2
    """Steady pitch of the body for 1 m/s^2 of acceleration."""
    laps: Factor = 1.0
    """How often a closed block is driven round."""
    start_spread_m: LengthOrNone = 30.0
    """Journeys start up to this far behind one another."""
    frame_loss: Share = 0.001
    """Share of single frames that are missing; their numbers are left out."""
    gap_s: Seconds = 0.0
    """One gap of this length in the frames, at a random place."""


@dataclass(frozen=True)
class Drive:
    """One journey's truth, frame by frame."""

    frame: Int[np.ndarray, " f"]
    """Frame numbers; lost frames leave gaps."""
    t: Float[np.ndarray, " f"]
    """Seconds since the journey began."""
    direction: int
    """1 along the stations, -1 against them."""
    station: Float[np.ndarray, " f"]
    """Of the point of the road under the camera; not wrapped on a closed road."""
    offset: Float[np.ndarray, " f"]
    distance: Float[np.ndarray, " f"]
    """Travelled so far [m]."""
    speed: Float[np.ndarray, " f"]
    p_world_camera: Float[np.ndarray, "f 3"]
    R_world_camera: Float[np.ndarray, "f 3 3"]
    road_normal_camera: Float[np.ndarray, "f 3"]
    """True unit normal from the camera towards the road."""
    camera_height: Float[np.ndarray, " f"]
    passing: Passing | Sight | None = None
    """Where it is beside markers that do not follow the stations."""

    def __len__(self) -> int:
        return len(self.t)


def drive_through(
    world: World,
    rig: SimulatedRig,
    config: VehicleConfig,
    rng: np.random.Generator,
    *,
    direction: int = 1,
) -> Drive:
    """A drive over the world's length with one rig, along the stations (1) or against them (-1)."""
    road = world.road
    length = world.config.length_m * (config.laps if road.closed else 1.0)
    start = rng.uniform(0, road.length if road.closed else config.start_spread_m) + 5.0
    if direction < 0 and not road.closed:
        start = start + length
    travelled = np.arange(round(length / _STEP_M) + 1) * _STEP_M
    station = start + direction * travelled

    speed, waits = _speed_profile(world, config, station, rng)
    frame, t, u, v, a = _frames(travelled, speed, waits, config, rng)
    offset, offset_rate = _offset(world, config, direction, length, u, rng)
    frame_station = start + direction * u
    R_tangent = road.tangent_frame(frame_station, offset, offset_rate * direction)
    if direction < 0:
        # Who drives against the stations looks back along the road; the surface's normal stays.
        R_tangent = R_tangent * np.array([-1.0, -1.0, 1.0])
    R_body, height = _suspension(R_tangent, v, a, rig, config, rng)
    up = R_tangent[:, :, 2]
    p = road.surface(frame_station, offset) + height[:, None] * up
    R_world_camera = R_body @ rig.R_body_camera
    steps = np.linalg.norm(np.diff(p, axis=0), axis=-1)
    return Drive(
        frame=frame,
        t=t,
        direction=direction,
        station=frame_station,
        offset=offset,
        distance=np.concatenate(([0.0], np.cumsum(steps))),
        speed=v,
        p_world_camera=p,
        R_world_camera=R_world_camera,
        road_normal_camera=-(R_world_camera.transpose(0, 2, 1) @ up[..., None])[..., 0],
        camera_height=height,
    )


def _speed_profile(
    world: World, config: VehicleConfig, station: Float[np.ndarray, " n"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Speed at each node, and how long the car waits there."""
    cruise = world.config.speed_mps * rng.uniform(0.95, 1.05)
    wave = _sway(np.arange(len(station)) * _STEP_M, (180.0, 70.0), rng)
    target = cruise * (1 + config.speed_variation * wave)
    bend = np.abs(world.road.curvature_at(station))
    target = np.minimum(target, np.sqrt(config.lateral_acceleration / np.maximum(bend, 1e-6)))
    waits = np.zeros(len(station))
    for light in world.lights:
        distance = np.abs(station - light)
        if world.road.closed:
            distance = np.abs(
                np.mod(station - light + world.road.length / 2, world.road.length)
                - world.road.length / 2
            )
        is_near = distance <= _STEP_M / 2
        is_near[[0, -1]] = False
        # Round a block a light is passed more than once.
        for node in np.flatnonzero(is_near & ~np.roll(is_near, 1)):
            is_red, wait = rng.random() < config.stop_probability, rng.uniform(*config.stop_s)
            waits[node] = wait if is_red else 0.0
    target = np.where(waits > 0, 0.0, target)
    # v^2 may change by at most 2 a ds from node to node, both ways: two running minima.
    ramp = 2 * config.acceleration * _STEP_M * np.arange(len(station))
    squared = np.minimum.accumulate(target**2 - ramp) + ramp
    squared = (np.minimum.accumulate((squared + ramp)[::-1]))[::-1] - ramp
    return np.sqrt(np.maximum(squared, 0.0)), waits


def _frames(
    travelled: Float[np.ndarray, " n"],
    speed: Float[np.ndarray, " n"],
    waits: Float[np.ndarray, " n"],
    config: VehicleConfig,
    rng: np.random.Generator,
) -> tuple[
    Int[np.ndarray, " f"],
    Float[np.ndarray, " f"],
    Float[np.ndarray, " f"],
    Float[np.ndarray, " f"],
    Float[np.ndarray, " f"],
]:
    """Number, time, way, speed and acceleration at the frames; constant between two nodes."""
    step = np.diff(travelled)
    duration = 2 * step / (speed[1:] + speed[:-1])
    acceleration = np.diff(speed) / duration
    departure = np.concatenate(([0.0], np.cumsum(duration))) + np.cumsum(waits)
    arrival = departure - waits
    frame = np.arange(int(departure[-1] * config.frame_rate_hz))
    lost = rng.random(len(frame)) < config.frame_loss
    gap_from = rng.uniform(0.2, 0.8) * len(frame)
    lost |= (frame >= gap_from) & (frame < gap_from + config.gap_s * config.frame_rate_hz)
    frame = frame[~lost]
    t = frame / config.frame_rate_hz
    node = np.clip(np.searchsorted(departure, t, side="right") - 1, 0, len(step) - 1)
    since = np.minimum(t - departure[node], duration[node])
    stands = t >= arrival[node + 1]
    a = np.where(stands, 0.0, acceleration[node])
    v = np.where(stands & (waits[node + 1] > 0), 0.0, speed[node] + a * since)
    u = travelled[node] + speed[node] * since + 0.5 * acceleration[node] * since**2
    return frame, t, np.where(stands, travelled[node + 1], u), v, a


def _offset(
    world: World,
    config: VehicleConfig,
    direction: int,
    length: float,
    u: Float[np.ndarray, " f"],
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, " f"], Float[np.ndarray, " f"]]:
    """Offset from the centre line and its derivative by the way: lanes, their changes, and sway."""
    lanes = np.array(world.lane_centres[direction])
    lane = int(rng.integers(len(lanes)))
    fine = np.arange(0.0, length + _STEP_M, _STEP_M)
    offset = np.full_like(fine, lanes[lane])
    changes = rng.poisson(config.lane_changes_per_km * length / 1000) if len(lanes) > 1 else 0
    for place in np.sort(rng.uniform(0.05, 0.95, changes)) * length:
        aim = lane + (1 if lane == 0 else -1 if lane == len(lanes) - 1 else rng.choice([-1, 1]))
        share = np.clip((fine - place) / 45.0, 0, 1)
        offset = offset + (lanes[aim] - lanes[lane]) * share**3 * (10 - 15 * share + 6 * share**2)
        lane = int(aim)
    offset = offset + config.keeping_m * np.clip(rng.normal(), -2, 2)
    offset = offset + config.wander_m * _sway(fine, (120.0, 45.0), rng)
    rate = np.gradient(offset, _STEP_M)
    return np.interp(u, fine, offset), np.interp(u, fine, rate)


def _suspension(
    R_tangent: Float[np.ndarray, "f 3 3"],
    speed: Float[np.ndarray, " f"],
    acceleration: Float[np.ndarray, " f"],
    rig: SimulatedRig,
    config: VehicleConfig,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "f 3 3"], Float[np.ndarray, " f"]]:
    """Rotation of the body, pitched and rolled against the road, and the camera's height."""
    count, dt = len(acceleration), 1 / config.frame_rate_hz
    load_pitch = np.radians(rng.uniform(-config.load_deg, config.load_deg))
    load_roll = np.radians(rng.uniform(-config.load_roll_deg, config.load_roll_deg))
    load_height = rng.uniform(-config.load_height_m, config.load_height_m)
    # The springs answer in about 0.4 s; while the car rolls, the road shakes it (memory 0.15 s).
    follow = np.exp(-dt / 0.4)
    smooth = np.asarray(lfilter([1 - follow], [1, -follow], acceleration))
    memory = np.exp(-dt / 0.15)
    push = np.sqrt(1 - memory**2) * rng.normal(size=(count, 2))
    shake = np.asarray(lfilter([1.0], [1, -memory], push, axis=0))
    shake = shake * np.radians((config.vibration_deg, config.vibration_deg / 2))
    shake = shake * np.minimum(speed / 3.0, 1.0)[:, None]
    # A positive pitch about the left axis lowers the nose; accelerating raises it.
    pitch = load_pitch - np.radians(config.squat_deg) * smooth + shake[:, 0]
    roll = load_roll + shake[:, 1]
    cp, sp, cr, sr = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    zero = np.zeros_like(pitch)
    tilt = np.stack((cp, sp * sr, sp * cr, zero, cr, -sr, -sp, cp * sr, cp * cr), axis=-1)
    height = np.full(count, rig.camera_height + load_height)
    return R_tangent @ tilt.reshape(-1, 3, 3), height


def _sway(
    way: Float[np.ndarray, " n"], wavelengths: tuple[float, ...], rng: np.random.Generator
) -> Float[np.ndarray, " n"]:
    """A smooth wave between about -1 and 1."""
    total = np.zeros_like(way)
    for k, wavelength in enumerate(wavelengths):
        wave = np.sin(2 * np.pi * way / (wavelength * rng.uniform(0.8, 1.25)) + rng.uniform(0, 6.3))
        total += wave / (k + 1)
    return total / sum(1 / (k + 1) for k in range(len(wavelengths)))
