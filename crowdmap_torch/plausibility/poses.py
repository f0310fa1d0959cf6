"""Whether poses are those of a camera on a car near the origin, and if not, what they are instead.

A camera on a car looks where the car goes and keeps its feet down. Poses that do not are tried as what they are
usually mistaken for: quaternions in another order, another frame's axes, the inverse, another world. What then looks
ahead and stands upright is the cause.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.plausibility.finding import Finding
from crowdmap_torch.tables import Journey, Origin


@dataclass(frozen=True)
class PoseLimits:
    """What is still taken for a car near the origin."""

    axis_deg: float = 40.0
    """Median angle between optical axis and motion: a front camera looks ahead."""
    upright_deg: float = 35.0
    """Median angle between the image's down and the world's."""
    baseline_m: float = 3.0
    """Way over which the direction of motion is taken."""
    fastest_mps: float = 70.0
    """Median speed of the moving part."""
    leap_mps: float = 150.0
    """Speed of a single step: more is a teleport."""
    leap_m: float = 5.0
    """Least length of such a step: noise between frames that are close in time is none."""
    far_m: float = 100_000.0
    """Distance from the origin: the tangent plane is a kilometre over the ground there."""
    high_m: float = 2_000.0
    """Height over the origin, in either direction."""
    frame_s: tuple[float, float] = (0.004, 2.0)
    """Median time between frames."""
    sigma_m: tuple[float, float] = (1e-3, 100.0)
    """Median sigma of positions."""
    sigma_rad: tuple[float, float] = (1e-6, 0.5)
    """The same of rotations."""


_AXES = {
    # Columns: the camera's axes (right, down, ahead) in the body's.
    "x ahead, y left, z up": ((0, 0, 1), (-1, 0, 0), (0, -1, 0)),
    "x ahead, y right, z down": ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
}
_DEGREE_M = 111e3
"""Length of a degree of latitude."""
_TWO_MISTAKES = 0.3
"""How much better, in units of the limits, two mistakes at once have to fit than one."""
_NORTH_EAST_DOWN = ((0, 1, 0), (1, 0, 0), (0, 0, -1))


def pose_findings(
    journey: Journey, origin: Origin, limits: PoseLimits | None = None
) -> list[Finding]:
    """What is wrong with a journey's poses as such; nothing of its detections is read."""
    limits = limits or PoseLimits()
    place = _place(journey, origin, limits)
    if place is not None:
        return [place]
    return [
        *_heights(journey, origin, limits),
        *_speeds(journey, limits),
        *_sigmas(journey, limits),
        *_axes(journey, limits),
    ]


def _place(journey: Journey, origin: Origin, limits: PoseLimits) -> Finding | None:
    """Positions that are no metres from the origin."""
    across = _links(journey)[:, :2, 3]
    x, y = across.median(0).values.tolist()
    is_still = float((across.amax(0) - across.amin(0)).norm()) < 1.0
    near = {(origin.lat_deg, origin.lon_deg), (origin.lon_deg, origin.lat_deg)}
    if is_still and any(abs(x - a) < 1 and abs(y - b) < 1 for a, b in near):
        return Finding(
            "degrees",
            f"x and y stay at ({x:.4f}, {y:.4f}), the origin's latitude and longitude",
            "positions are in degrees",
            "write metres east, north and up of dataset.json's origin",
        )
    if math.hypot(x, y) < limits.far_m:
        return None
    evidence = f"positions are {math.hypot(x, y) / 1000:.0f} km from the origin"
    east, north = _utm(origin)
    if math.hypot(x - east, y - north) < limits.far_m:
        return Finding(
            "utm",
            evidence,
            "these are UTM coordinates",
            "subtract the origin's and turn them to true north: x, y, z are metres east, north "
            "and up of dataset.json's origin",
        )
    return Finding(
        "far-away",
        evidence,
        "they are not relative to the origin of dataset.json",
        "write metres east, north and up of it, or move the origin",
    )


def _utm(origin: Origin) -> tuple[float, float]:
    """About where the origin is in its UTM zone, to some kilometres [m]."""
    central_deg = 6 * math.floor(origin.lon_deg / 6) + 3
    east = 5e5 + _DEGREE_M * math.cos(math.radians(origin.lat_deg)) * (origin.lon_deg - central_deg)
    return east, _DEGREE_M * origin.lat_deg + (1e7 if origin.lat_deg < 0 else 0)


def _heights(journey: Journey, origin: Origin, limits: PoseLimits) -> Iterator[Finding]:
    z = float(journey.T_world_camera[:, 2, 3].median())
    height = origin.height_m
    # Terrain differs from place to place, but hardly by as much as the origin happens to be high.
    if abs(height) > 15 and abs(z - height) < min(15.0, 0.25 * abs(height)):
        yield Finding(
            "absolute-heights",
            f"poses are {z:.0f} m over an origin that is itself {height:.0f} m high",
            "z holds heights over the ellipsoid or the sea",
            "write heights over dataset.json's origin",
        )
    elif abs(z) > limits.high_m:
        yield Finding(
            "height",
            f"poses are {z:.0f} m over the origin",
            "z or the origin's height_m is in another unit or datum",
            "write metres over dataset.json's origin",
        )


def _speeds(journey: Journey, limits: PoseLimits) -> Iterator[Finding]:
    seconds = journey.t_ns.diff().double() * 1e-9
    if not len(seconds):
        return
    step = journey.T_world_camera[:, :3, 3].diff(dim=0).norm(dim=-1)
    between = float(seconds.median())
    low, high = limits.frame_s
    if not low <= between <= high:
        yield Finding(
            "frame-times",
            f"frames are {between:.2g} s apart in the median",
            "t_ns is not in nanoseconds, or frames are missing",
            "write nanoseconds since 1970-01-01 UTC",
        )
        return
    speed = step / seconds
    moving = speed[step > 0.01]
    if len(moving) and float(moving.median()) > limits.fastest_mps:
        yield Finding(
            "speed",
            f"the car drives {float(moving.median()):.0f} m/s in the median",
            "positions or times are in another unit",
            "write metres and nanoseconds",
        )
    leaps = (speed > limits.leap_mps) & (step > limits.leap_m)
    if bool(leaps.any()):
        first = int(leaps.nonzero()[0, 0])
        yield Finding(
            "leap",
            f"between frames {int(journey.frame_number[first])} and "
            f"{int(journey.frame_number[first + 1])} the car moves {float(step[first]):.0f} m in "
            f"{float(seconds[first]):.2f} s",
            "positioning lost its way, or two drives stand in one file",
            "cut the journey there",
        )


def _sigmas(journey: Journey, limits: PoseLimits) -> Iterator[Finding]:
    columns = (
        ("sigma_e, sigma_n, sigma_u", journey.sigma_position, limits.sigma_m, "m"),
        ("sigma_rot", journey.sigma_rotation, limits.sigma_rad, "rad"),
    )
    for name, sigma, (low, high), unit in columns:
        if sigma is None:
            continue
        usual = float(sigma.median())
        if not low <= usual <= high:
            yield Finding(
                "sigmas",
                f"{name} are {usual:.3g} {unit} in the median",
                "positioning does not know its own errors, or the unit is another",
                "leave the columns out where they are not known",
            )


def _axes(journey: Journey, limits: PoseLimits) -> Iterator[Finding]:
    given = _misfit(journey.T_world_camera, limits)
    if given is None or given < 1:
        return
    tried = [
        (misfit + extra, kind, cause, cure)
        for extra, kind, cause, cure, T_world_camera in _instead(journey)
        if (misfit := _misfit(T_world_camera, limits)) is not None
    ]
    best = min(tried, default=None, key=lambda found: found[0])
    axis, down = _angles(journey.T_world_camera, limits)
    evidence = (
        f"the camera looks {axis:.0f} degrees off the direction of travel "
        f"and its image's down is {down:.0f} degrees off the world's"
    )
    if best is not None and best[0] < min(1.0, given / 2):
        yield Finding(best[1], evidence, best[2], best[3])
    else:
        yield Finding(
            "axes",
            evidence,
            "poses, mount and camera do not fit each other",
            "poses are T_world_link of the mount's pose_link, quaternions qx qy qz qw; the "
            "camera's x is right, y down, z ahead",
        )


def _instead(journey: Journey) -> Iterator[tuple[float, str, str, str, Float[Tensor, "f 4 4"]]]:
    """What poses may be instead: how much a less usual mistake has to fit better, its kind, cause and cure, the poses."""
    T_link_camera, T = journey.rig.T_link_camera, _links(journey)
    R, p = T[:, :3, :3], T[:, :3, 3]
    x, y, z, w = se3.to_quaternion(R).unbind(-1)
    yield (
        0.0,
        "quaternion-order",
        "quaternions are stored as w x y z",
        "store qx qy qz qw",
        se3.make(se3.from_quaternion(torch.stack((y, z, w, x), dim=-1)), p) @ T_link_camera,
    )
    yield (
        0.0,
        "camera-from-world",
        "poses are the world's in the camera (T_camera_world)",
        "store their inverses, T_world_camera",
        se3.inverse(T) @ T_link_camera,
    )
    world = se3.make(R.new_tensor(_NORTH_EAST_DOWN), p.new_zeros(3))
    down = (
        "north-east-down",
        "the world is north-east-down",
        "write east-north-up: swap x and y of positions and world axes, and turn z over",
    )
    yield (0.0, *down, world @ T @ T_link_camera)
    if not torch.equal(T_link_camera, torch.eye(4).to(T_link_camera)):
        return
    for name, axes in _AXES.items():
        body = se3.make(R.new_tensor(axes), p.new_zeros(3))
        yield (
            0.0,
            "body-frame",
            f"poses are of a body frame with {name}, not the camera's",
            "give the rig a mount (rig.urdf), or store the camera's own poses",
            T @ body,
        )
        # Of a car that drives north-east the one looks like the other.
        both = f"{down[1]} and the body's axes are {name}"
        yield (_TWO_MISTAKES, down[0], both, down[2], world @ T @ body)


def _links(journey: Journey) -> Float[Tensor, "f 4 4"]:
    """Poses as poses.parquet has them: of the mount's link."""
    return journey.T_world_camera @ se3.inverse(journey.rig.T_link_camera)


def _misfit(T_world_camera: Float[Tensor, "f 4 4"], limits: PoseLimits) -> float | None:
    """How far the camera is from looking ahead and standing upright, 1 at the limit; None if it stands still."""
    if _way(T_world_camera) < 3 * limits.baseline_m:
        return None
    axis, down = _angles(T_world_camera, limits)
    return max(axis / limits.axis_deg, down / limits.upright_deg)


def _angles(T_world_camera: Float[Tensor, "f 4 4"], limits: PoseLimits) -> tuple[float, float]:
    """Median angles [deg] of optical axis to motion, and of the image's down to the world's."""
    p = T_world_camera[:, :3, 3]
    station = torch.cat((p.new_zeros(1), p.diff(dim=0).norm(dim=-1).cumsum(0)))
    ahead = torch.searchsorted(station, station + limits.baseline_m)
    has = ahead < len(p)
    motion = torch.nn.functional.normalize(p[ahead[has]] - p[has], dim=-1)
    axis = (T_world_camera[has, :3, 2] * motion).sum(-1)
    down = -T_world_camera[:, 2, 1]
    return _degrees(axis), _degrees(down)


def _degrees(cosine: Float[Tensor, " f"]) -> float:
    """The angle with the median cosine [deg]."""
    return math.degrees(math.acos(float(cosine.median().clamp(-1, 1))))


def _way(T_world_camera: Float[Tensor, "f 4 4"]) -> float:
    """Length of the box around the positions [m]."""
    p = T_world_camera[:, :3, 3]
    return float((p.amax(0) - p.amin(0)).norm())
