"""What an adjustment found of cars' calibrations, on disk: `calibration.json`, and rigs ready to be used (FORMAT.md)."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from crowdmap_torch.io.atomic import atomic_file
from crowdmap_torch.io.documents import Document, read_json, write_json
from crowdmap_torch.io.rigs import rig_yaml
from crowdmap_torch.noise.calibration import KnownCalibration
from crowdmap_torch.ranges import Range
from crowdmap_torch.tables import Rig

FORMAT = "crowdmap-calibration"
_WRONG = {
    "mount_deg": Range(-45, 45, "degrees: a camera turned further has another mount"),
    "mount_m": Range(-10, 10, "metres: a camera further off sits on another car"),
    "clock_s": Range(-10, 10, "seconds: a clock that is later is none"),
    "focal": Range(-0.5, 1, "a share: from half the focal length to twice"),
    "principal_px": Range(-1e4, 1e4, "pixels: the middle of an image is not as far off"),
    "read_out_s": Range(-1, 1, "seconds: no picture takes longer"),
    "box": Range(-0.5, 1, "a share: from half the outline to twice"),
    "corner_px": Range(-1e3, 1e3, "pixels: corners further off are of something else"),
    "lane_m": Range(-10, 10, "metres: a marker further off is another one"),
    "height_m": Range(-100, 100, "metres: no camera is as high"),
}
"""How wrong a car can be, by parameter."""
_URDF = """<?xml version="1.0"?>
<robot name="rig">
  <link name="base_link"/>
  <link name="camera_optical"/>
  <joint name="mount" type="fixed">
    <parent link="base_link"/>
    <child link="camera_optical"/>
    <origin xyz="{} {} {}" rpy="{} {} {}"/>
  </joint>
</robot>
"""


def write_calibration(path: Path, cars: Mapping[str, Mapping[str, object]]) -> None:
    """calibration.json: what was found of every car, by name."""
    write_json(path, {"format": FORMAT, "version": 1, "cars": dict(cars)})


def read_calibration(path: Path) -> dict[str, KnownCalibration]:
    """Estimates and sigmas of every car of a calibration.json; InputError for what breaks FORMAT.md."""
    document = read_json(path)
    document.require_format(FORMAT)
    cars = document.part("cars")
    return {name: _numbers(cars.part(name)) for name in cars.content}


def _numbers(car: Document) -> KnownCalibration:
    parameters = car.part("parameters")
    found = {}
    for name in parameters.content:
        one = parameters.part(name)
        estimate = one.numbers("estimate", most=1e6)
        for value in estimate:
            if rule := name in _WRONG and _WRONG[name].fault(value):
                raise one.fault(rule, "estimate")
        sigma = one.numbers("sigma", len(estimate), most=1e6)
        if min(sigma, default=1.0) <= 0:
            raise one.fault("expected numbers above 0", "sigma")
        found[name] = (tuple(estimate), tuple(sigma))
    return found


def write_corrected_rigs(folder: Path, rigs: Sequence[tuple[str, Rig]]) -> None:
    """A folder for each car, by name: rig.yaml, and the mount in rig.urdf."""
    for name, rig in rigs:
        place = folder / folder_name(name)
        place.mkdir(parents=True, exist_ok=True)
        x, y, z = rig.T_link_camera[:3, 3].tolist()
        numbers = (x, y, z, *_roll_pitch_yaw(rig.T_link_camera[:3, :3]))
        for file, text in (
            ("rig.urdf", _URDF.format(*(repr(number) for number in numbers))),
            (
                "rig.yaml",
                rig_yaml(
                    rig.camera,
                    rig.road_normal_camera.tolist(),
                    rig.camera_height,
                    ("rig.urdf", "base_link", "camera_optical"),
                ),
            ),
        ):
            with atomic_file(place / file) as beside:
                beside.write_text(text, encoding="utf-8")


def folder_name(car: str) -> str:
    """A car's name as that of a folder: what a file system may refuse is replaced, and told apart by a number."""
    plain = re.sub(r"[^A-Za-z0-9._-]", "_", car)[:80].lstrip(".")
    if plain == car and car:
        return car
    return f"{plain or 'car'}-{hashlib.sha256(car.encode()).hexdigest()[:8]}"


def _roll_pitch_yaw(R: torch.Tensor) -> tuple[float, float, float]:
    """URDF's angles of `Rz(yaw) Ry(pitch) Rx(roll)` [rad]."""
    pitch = torch.asin(-R[2, 0].clamp(-1, 1))
    if bool(R[2, 0].abs() > 1 - 1e-12):
        # Straight up or down roll and yaw turn about one axis.
        return 0.0, float(pitch), float(torch.atan2(-R[0, 1], R[1, 1]))
    return float(torch.atan2(R[2, 1], R[2, 2])), float(pitch), float(torch.atan2(R[1, 0], R[0, 0]))
