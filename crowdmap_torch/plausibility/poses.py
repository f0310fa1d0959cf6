"""Whether poses are those of a camera on a car near the origin, and if not, what they are instead.

A camera on a car looks where the car goes and keeps its feet down. Poses that do not are tried as what they are
usually mistaken for: quaternions in another order, another frame's axes, the inverse, another world. What then looks
ahead and stands upright is the cause.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.optim.robust import median_along
from crowdmap_torch.plausibility.finding import Finding, Repair
from crowdmap_torch.plausibility.put_right import put_right_findings
from crowdmap_torch.plausibility.units import UnitLimits, unit_findings, usual_speed
from crowdmap_torch.processes.sums import running_sum
from crowdmap_torch.tables import Journey, Origin


@dataclass(frozen=True)
class PoseLimits:
    """What is still taken for a car near the origin."""

    axis_deg: float = 40.0
    """Median angle between optical axis and motion: a front camera looks ahead."""
    upright_deg: float = 35.0
    """Median angle between the image's down and the world's."""
    leaning: float = 0.25
    """A share of these limits from which on poses are doubted, ..."""
    much_better: float = 4.0
    """... if they fit so many times better as something else: of a drive to the east w x y z looks nearly like x y z w."""
    baseline_m: float = 3.0
    """Way over which the direction of motion is taken."""
    leap_mps: float = 150.0
    """Speed of a single step: more is a teleport."""
    leap_m: float = 5.0
    """Least length of such a step: noise between frames that are close in time is none."""
    far_m: float = 100_000.0
    """Distance from the origin: the tangent plane is a kilometre over the ground there."""
    high_m: float = 2_000.0
    """Height over the origin, in either direction."""
    flat_m: float = 150.0
    """Over so much of a road its height changes."""
    sigma_m: tuple[float, float] = (1e-3, 100.0)
    """Median sigma of positions."""
    sigma_rad: tuple[float, float] = (1e-6, 0.5)
    """The same of rotations."""
    least_rotations: int = 5
    """Rotations that differ from which on it is told whether they were rounded."""
    units: UnitLimits = field(default_factory=UnitLimits)
    """How often frames come, and how fast cars are."""


_AXES = {
    # Columns: the camera's axes (right, down, ahead) in the body's.
    "x ahead, y left, z up": ((0, 0, 1), (-1, 0, 0), (0, -1, 0)),
    "x ahead, y right, z down": ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
}
ONE_HEIGHT = "one-height"
"""Kind of the finding that tells of heights that nobody measured."""
_SAME_HEIGHT_M = 1e-6
"""Heights that went through a mount and back differ by less."""
_UPRIGHT = ((1, 0, 0), (0, -1, 0), (0, 0, -1))
"""The same of a camera as OpenGL has it: x right, y up, z back."""
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
        *put_right_findings(journey),
        *_sigmas(journey, limits),
        *_rounded(journey, limits),
        *_axes(journey, limits),
    ]


def in_kilometres(journey: Journey, limits: PoseLimits | None = None) -> Journey | None:
    """A journey that hardly moves as it is if positions are in kilometres; None if it is none, or would be no drive then."""
    limits = limits or PoseLimits()
    T = _links(journey)
    speed = usual_speed(journey.t_ns.double().numpy() * 1e-9, T[:, :3, 3].numpy(), limits.units)
    low, high = limits.units.usual_mps
    if speed is None or not low <= 1e3 * speed <= high:
        return None
    T = se3.make(T[:, :3, :3], 1e3 * (T[:, :3, 3] - T[0, :3, 3]))
    larger = replace(journey, T_world_camera=T @ journey.rig.T_link_camera)
    misfit = _misfit(larger.T_world_camera, limits)
    return larger if misfit is not None and misfit < 1 else None


def _place(journey: Journey, origin: Origin, limits: PoseLimits) -> Finding | None:
    """Positions that are no metres from the origin."""
    across = _links(journey)[:, :2, 3]
    x, y = median_along(across, 0).tolist()
    is_still = float((across.amax(0) - across.amin(0)).norm()) < 1.0
    near = {(origin.lat_deg, origin.lon_deg), (origin.lon_deg, origin.lat_deg)}
    if is_still and any(abs(x - a) < 1 and abs(y - b) < 1 for a, b in near):
        is_lat_first = abs(x - origin.lat_deg) < 1 and abs(y - origin.lon_deg) < 1
        is_lon_first = abs(x - origin.lon_deg) < 1 and abs(y - origin.lat_deg) < 1
        is_sure = is_lat_first != is_lon_first
        return Finding(
            "degrees",
            f"x and y stay at ({x:.4f}, {y:.4f}), the origin's latitude and longitude",
            "positions are in degrees",
            "write metres east, north and up of dataset.json's origin",
            repair=Repair("degrees", (float(is_lon_first),)) if is_sure else None,
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
            repair=Repair("utm", (float(_zone(origin)), float(origin.lat_deg < 0))),
        )
    return Finding(
        "far-away",
        evidence,
        "they are not relative to the origin of dataset.json",
        "write metres east, north and up of it, or move the origin",
    )


def _utm(origin: Origin) -> tuple[float, float]:
    """About where the origin is in its UTM zone, to some kilometres [m]."""
    central_deg = 6 * _zone(origin) - 183
    east = 5e5 + _DEGREE_M * math.cos(math.radians(origin.lat_deg)) * (origin.lon_deg - central_deg)
    return east, _DEGREE_M * origin.lat_deg + (1e7 if origin.lat_deg < 0 else 0)


def _zone(origin: Origin) -> int:
    """The UTM zone of the origin, those around Norway and Spitsbergen not widened."""
    return min(math.floor(origin.lon_deg / 6) + 31, 60)


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
            repair=Repair("heights", (height,)),
        )
    elif abs(z) > limits.high_m:
        yield Finding(
            "height",
            f"poses are {z:.0f} m over the origin",
            "z or the origin's height_m is in another unit or datum",
            "write metres over dataset.json's origin",
        )
    p = _links(journey)[:, :3, 3]
    extent = p.amax(0) - p.amin(0)
    if float(extent[:2].norm()) > limits.flat_m and float(extent[2]) < _SAME_HEIGHT_M:
        yield Finding(
            ONE_HEIGHT,
            f"z is {float(p[0, 2]):.2f} m in every frame, over {float(extent[:2].norm()):.0f} m of road",
            "positions are of two dimensions",
            "write heights: signs and lanes are mapped on a level plane otherwise, and rise and fall with no road",
        )


def _speeds(journey: Journey, limits: PoseLimits) -> Iterator[Finding]:
    if journey.frame_count < 2:
        return
    # Of the pose that files give: a camera beside it turns about what is held.
    position = _links(journey)[:, :3, 3]
    named = [*unit_findings(journey.t_ns.double().numpy(), position.numpy(), limits.units)]
    if named:
        yield from named
        return
    seconds = journey.t_ns.diff().double() * 1e-9
    step = position.diff(dim=0).norm(dim=-1)
    speed = step / seconds
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
                repair=Repair("no-sigmas", of=name),
            )


_ROUNDED_FRAMES = 64
"""Frames of which it is told whether their rotations were rounded."""


def _rounded(journey: Journey, limits: PoseLimits) -> Iterator[Finding]:
    """Whether quaternions have two digits: all four numbers are hundredths then, but for their common length."""
    q = se3.to_quaternion(_links(journey)[:, :3, :3])
    q = q[:: -(-len(q) // _ROUNDED_FRAMES)]
    if len(q.unique(dim=0)) < limits.least_rotations:
        return
    largest = q.abs().amax(-1, keepdim=True)
    hundredths = torch.arange(50, 102).to(q)[:, None] * (q / largest)[:, None]
    is_rounded = ((hundredths - hundredths.round()).abs() < 1e-6).all(-1).any(-1)
    if float(is_rounded.double().mean()) < _MOSTLY:
        return
    off = math.degrees(2 * 0.005 * 3**0.5)
    yield Finding(
        "rounded-rotations",
        f"quaternions are hundredths: rotations are up to {off:.1g} degrees off",
        "they were written with two digits",
        "write all digits; what is lost cannot be put right",
    )


_MOSTLY = 0.9


def _axes(journey: Journey, limits: PoseLimits) -> Iterator[Finding]:
    given = _misfit(journey.T_world_camera, limits)
    if given is None or given < limits.leaning:
        return
    tried = [
        (misfit + extra, finding)
        for extra, finding, T_world_camera in _instead(journey)
        if (misfit := _misfit(T_world_camera, limits)) is not None
    ]
    best = min(tried, default=(math.inf, None), key=lambda found: found[0])
    if best[1] is not None and best[0] < min(
        1.0, given / (2 if given >= 1 else limits.much_better)
    ):
        yield replace(best[1], evidence=_seen(journey, limits))
    elif given >= 1:
        yield Finding(
            "axes",
            _seen(journey, limits),
            "the camera looks aside or back, or poses, mount and camera do not fit each other",
            "nothing, if it is mounted so; else: poses are T_world_link of the mount's pose_link, "
            "quaternions qx qy qz qw; the camera's x is right, y down, z ahead",
        )


def axes_alike(
    journey: Journey, named: Finding, limits: PoseLimits | None = None
) -> Finding | None:
    """What was named in another journey, if this one fits better under it too: mistakes are made in all alike."""
    limits = limits or PoseLimits()
    given = _misfit(journey.T_world_camera, limits)
    for _, finding, T_world_camera in _instead(journey):
        if given is None or (finding.kind, finding.cause) != (named.kind, named.cause):
            continue
        misfit = _misfit(T_world_camera, limits)
        if misfit is not None and misfit < given / 2:
            return replace(finding, evidence=_seen(journey, limits))
    return None


def _seen(journey: Journey, limits: PoseLimits) -> str:
    axis, down = _angles(journey.T_world_camera, limits)
    return (
        f"the camera looks {axis:.0f} degrees off the direction of travel "
        f"and its image's down is {down:.0f} degrees off the world's"
    )


def _instead(journey: Journey) -> Iterator[tuple[float, Finding, Float[Tensor, "f 4 4"]]]:
    """What poses may be instead: how much a less usual mistake has to fit better, what it is called, the poses."""
    T_link_camera, T = journey.rig.T_link_camera, _links(journey)
    R, p = T[:, :3, :3], T[:, :3, 3]
    x, y, z, w = se3.to_quaternion(R).unbind(-1)
    yield (
        0.0,
        Finding(
            "quaternion-order",
            "",
            "quaternions are stored as w x y z",
            "store qx qy qz qw",
            repair=Repair("quaternion-order"),
        ),
        se3.make(se3.from_quaternion(torch.stack((y, z, w, x), dim=-1)), p) @ T_link_camera,
    )
    yield (
        0.0,
        Finding(
            "camera-from-world",
            "",
            "poses are the world's in the camera (T_camera_world)",
            "store their inverses, T_world_camera",
            repair=Repair("inverse-poses"),
        ),
        se3.inverse(T) @ T_link_camera,
    )
    same = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
    world = se3.make(R.new_tensor(_NORTH_EAST_DOWN), p.new_zeros(3))
    down = Finding(
        "north-east-down",
        "",
        "the world is north-east-down",
        "write east-north-up: swap x and y of positions and world axes, and turn z over",
        repair=_axes_repair(_NORTH_EAST_DOWN, same),
    )
    yield 0.0, down, world @ T @ T_link_camera
    if not torch.equal(T_link_camera, torch.eye(4).to(T_link_camera)):
        return
    of_body = (
        "poses are of a body frame with {}, not the camera's",
        "give the rig a mount (rig.urdf), or store the camera's own poses",
    )
    upright = "poses are of a camera with x right, y up, z back (OpenGL)"
    named = [
        *(
            ("body-frame", of_body[0].format(name), of_body[1], axes)
            for name, axes in _AXES.items()
        ),
        ("camera-axes", upright, "turn y and z of the camera's axes over", _UPRIGHT),
    ]
    for kind, cause, cure, axes in named:
        body = se3.make(R.new_tensor(axes), p.new_zeros(3))
        yield 0.0, Finding(kind, "", cause, cure, repair=_axes_repair(same, axes)), T @ body
        if kind == "camera-axes":
            continue  # Upright, looking back: a rear camera is likelier than two mistakes.
        # Of a car that drives north-east the one looks like the other.
        both = replace(
            down,
            cause=f"{down.cause} and {cause}",
            cure=f"{down.cure}; {cure}",
            repair=_axes_repair(_NORTH_EAST_DOWN, axes),
        )
        yield _TWO_MISTAKES, both, world @ T @ body


_Axes = tuple[tuple[int, int, int], ...]


def _axes_repair(world: _Axes, camera: _Axes) -> Repair:
    """Positions and rotations turned by `world`, and the camera's axes put where `camera` has them."""
    return Repair(
        "axes", tuple(float(x) for matrix in (world, camera) for row in matrix for x in row)
    )


def _links(journey: Journey) -> Float[Tensor, "f 4 4"]:
    """Poses as poses.parquet has them: of the mount's link."""
    return journey.T_world_camera @ se3.inverse(journey.rig.T_link_camera)


def _misfit(T_world_camera: Float[Tensor, "f 4 4"], limits: PoseLimits) -> float | None:
    """How far the camera is from looking ahead and standing upright, 1 at the limit; None if it stands still."""
    moves = bool(_motion(T_world_camera, limits)[1].any())
    if not moves or _way(T_world_camera) < 3 * limits.baseline_m:
        return None
    axis, down = _angles(T_world_camera, limits)
    return max(axis / limits.axis_deg, down / limits.upright_deg)


def _angles(T_world_camera: Float[Tensor, "f 4 4"], limits: PoseLimits) -> tuple[float, float]:
    """Median angles [deg] of optical axis to motion, and of the image's down to the world's."""
    motion, moves = _motion(T_world_camera, limits)
    axis = (T_world_camera[:, :3, 2] * torch.nn.functional.normalize(motion, dim=-1)).sum(-1)
    down = -T_world_camera[:, 2, 1]
    return _degrees(axis[moves]), _degrees(down)


def _motion(
    T_world_camera: Float[Tensor, "f 4 4"], limits: PoseLimits
) -> tuple[Float[Tensor, "f 3"], Bool[Tensor, " f"]]:
    """Where the camera is a baseline's way after each frame, seen from there, and whether it has moved.

    Of a car that stands positions tremble: that way adds up, and leads nowhere.
    """
    p = T_world_camera[:, :3, 3]
    station = torch.cat((p.new_zeros(1), running_sum(p.diff(dim=0).norm(dim=-1))))
    ahead = torch.searchsorted(station, station + limits.baseline_m)
    motion = p[ahead.clamp_max(len(p) - 1)] - p
    return motion, (ahead < len(p)) & (motion.norm(dim=-1) > limits.baseline_m / 2)


def _degrees(cosine: Float[Tensor, " f"]) -> float:
    """The angle with the median cosine [deg]."""
    return math.degrees(math.acos(float(cosine.median().clamp(-1, 1))))


def _way(T_world_camera: Float[Tensor, "f 4 4"]) -> float:
    """Length of the box around the positions [m]."""
    p = T_world_camera[:, :3, 3]
    return float((p.amax(0) - p.amin(0)).norm())
