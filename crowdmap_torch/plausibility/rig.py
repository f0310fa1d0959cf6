"""Whether a rig is a front camera on a car: its road calibration and its focal length."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch

from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.plausibility.finding import Finding, Repair
from crowdmap_torch.tables import Rig


@dataclass(frozen=True)
class RigLimits:
    """What is still taken for a front camera on a car or lorry."""

    height_m: tuple[float, float] = (0.4, 4.5)
    """Height of the camera over the road."""
    tilt_deg: float = 35.0
    """Angle between the road's normal and the camera's down."""
    view_deg: tuple[float, float] = (12.0, 175.0)
    """Horizontal field of view of the pinhole part."""
    tangential: float = 0.02
    """Tangential distortion p1, p2 of a lens that is not broken; half of it where another order makes a usual lens."""
    centre: float = 0.25
    """Distance of the principal point from the image's middle, as a share of its size."""


def rig_findings(rig: Rig, limits: RigLimits | None = None) -> Iterator[Finding]:
    """What is wrong with a rig as such."""
    limits = limits or RigLimits()
    down = float(rig.road_normal_camera[1])
    if down < -math.cos(math.radians(limits.tilt_deg)):
        yield Finding(
            "road-normal",
            f"the road normal of rig {rig.rig_id!r} points up in the image (y {down:.2f})",
            "it is the road's own normal, from the road upwards",
            "road.normal points from the camera to the road: turn its sign",
            repair=Repair("turn-normal"),
        )
    elif down < math.cos(math.radians(limits.tilt_deg)):
        yield Finding(
            "road-normal",
            f"the road normal of rig {rig.rig_id!r} is {math.degrees(math.acos(down)):.0f} degrees "
            "off the image's down",
            "it is not in the camera's frame (x right, y down, z ahead)",
            "turn it into the camera's frame",
        )
    low, high = limits.height_m
    if not low <= rig.camera_height <= high:
        units = [(u, f) for u, f in _UNITS if low <= rig.camera_height * f <= high]
        unit, factor = units[0] if len(units) == 1 else (None, 1.0)
        yield Finding(
            "camera-height",
            f"the camera of rig {rig.rig_id!r} is {rig.camera_height:g} m over the road",
            "road.height_m is not in metres" if unit is None else f"road.height_m is in {unit}",
            "write the distance from the camera centre to the road plane in metres",
            repair=None if unit is None else Repair("height-unit", (factor,)),
        )
    yield from _camera(rig, limits)


def _camera(rig: Rig, limits: RigLimits) -> Iterator[Finding]:
    camera = rig.camera
    low, high = limits.view_deg
    view = 2 * math.degrees(math.atan(camera.width / 2 / float(camera.K[0, 0])))
    off = max(
        abs(float(camera.K[0, 2]) - (camera.width - 1) / 2) / camera.width,
        abs(float(camera.K[1, 2]) - (camera.height - 1) / 2) / camera.height,
    )
    if not low <= view <= high or off > limits.centre:
        yield Finding(
            "intrinsics",
            f"rig {rig.rig_id!r} sees {view:.0f} degrees in {camera.width} pixels, its principal "
            f"point {off:.0%} of the image off the middle",
            "fx, fy, cx, cy are of an image of another size, or not in pixels",
            "write them in pixels of the images that detections are of",
        )
    if camera.model != "brown_conrady":
        return
    lens = camera.distortion.tolist()
    tangential, repair = max(map(abs, lens[2:4]), default=0), _reordered(camera, limits)
    if tangential > (limits.tangential if repair is None else limits.tangential / 2):
        yield Finding(
            "coefficient-order",
            f"tangential distortion p1, p2 of rig {rig.rig_id!r} is {lens[2]:g}, {lens[3]:g}, more than "
            "usual lenses have",
            "distortion coefficients are in another order",
            "write k1, k2, p1, p2, k3 (OpenCV's order)",
            repair=repair,
        )


COEFFICIENT_ORDERS = {
    "k1, k2, k3, p1, p2": (0, 1, 3, 4, 2),
    "k1, p1, p2, k2, k3": (0, 3, 1, 2, 4),
    "p1, p2, k1, k2, k3": (2, 3, 0, 1, 4),
}
"""How else coefficients are written: where in that order k1, k2, p1, p2, k3 stand."""


def reordered(camera: Camera, order: tuple[int, ...]) -> Camera:
    """The camera with its coefficients taken to be in another order."""
    given = torch.nn.functional.pad(camera.distortion, (0, max(5 - len(camera.distortion), 0)))
    return replace(camera, distortion=given[[*order, *range(5, len(given))]])


def _reordered(camera: Camera, limits: RigLimits) -> Repair | None:
    """The order in which the coefficients are those of a lens, if it is one only."""
    fits = []
    for order in COEFFICIENT_ORDERS.values():
        k1, k2, p1, p2, k3 = reordered(camera, order).distortion[:5].tolist()
        if max(abs(p1), abs(p2)) < min(limits.tangential / 4, abs(k1) / 4) and abs(k1) >= max(
            abs(k2), abs(k3)
        ):
            fits.append(order)
    return Repair("coefficients", tuple(map(float, fits[0]))) if len(fits) == 1 else None


_UNITS = (("centimetres", 0.01), ("millimetres", 0.001), ("feet", 0.3048))
