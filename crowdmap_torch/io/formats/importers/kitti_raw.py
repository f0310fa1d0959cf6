"""Drives of the KITTI raw data: the folder of a drive with `oxts/`, and its day's `calib_*.txt` in the folder above.

The GPS/IMU unit's positions and angles are the poses of its link (forward, left, up); they are interpolated at the times of
the camera's images. Its angles: yaw anticlockwise from east, pitch positive nose down, roll positive left side up. The
camera is the rectified one of `--camera` (image_00 to image_03; image_02, the left colour camera, if nobody says). Its
height over the road is 1.65 m, as the data set's paper has it (Geiger et al. 2013).
"""

from __future__ import annotations

import calendar
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.io.budget import read_text
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing import headings
from crowdmap_torch.io.formats.composing.frames import at_times
from crowdmap_torch.io.formats.composing.lines import columns, read_numbers
from crowdmap_torch.io.formats.composing.parts import Asked, CarRig, Importer, Parts
from crowdmap_torch.io.formats.composing.sources import file_in, the_one

_OXTS = ("lat", "lon", "alt", "roll", "pitch", "yaw")
_ACCURACY = 23
_COUNT = 30
_CAMERAS = ("image_00", "image_01", "image_02", "image_03")
_CAMERA_HEIGHT_M = 1.65
_TIME = re.compile(r"(\d{4})-(\d\d)-(\d\d) (\d\d):(\d\d):(\d\d)\.(\d{1,9})")


def read(sources: tuple[Path, ...], asked: Asked) -> Parts:
    """Poses of one drive, and the rig if its calibration is there."""
    folder = the_one(sources, "the folder of a drive, with oxts in it")
    camera = asked.camera or "image_02"
    if camera not in _CAMERAS:
        raise InputError(f"--camera {camera}: expected one of {', '.join(_CAMERAS)}")
    clock = file_in(folder, "oxts/timestamps.txt")
    t_ns = _times(clock)
    files = sorted((folder / "oxts" / "data").glob("*.txt"))
    if len(files) != len(t_ns):
        raise InputError(f"{clock}: has {len(t_ns)} times for {len(files)} files; expected as many")
    lines = [read_numbers(path, (_COUNT,), f"{_COUNT} numbers")[0] for path in files]
    values = columns(lines, 0, _OXTS)
    sigma = columns(lines, _ACCURACY, ("pos_accuracy",))
    track, origin, _ = headings.fixes(
        folder,
        t_ns,
        values[:, :3],
        asked,
        heading=np.pi / 2 - values[:, 5],
        pitch=-values[:, 4],
        roll=values[:, 3],
        sigma_position=np.repeat(sigma, 3, axis=1),
    )
    notes: tuple[str, ...] = ()
    images = folder / camera / "timestamps.txt"
    if images.exists():
        exposed = _times(images)
        track, notes = at_times(track, exposed, np.arange(len(exposed)))
    rig = None
    if (folder.parent / "calib_cam_to_cam.txt").exists():
        rig = _rig(folder.parent, camera)
        track = replace(track, link="mount")
    return Parts(track=track, rig=rig, origin=origin, notes=notes)


def _times(path: Path) -> Int[np.ndarray, " n"]:
    found: list[int] = []
    for number, text in enumerate(read_text(path).splitlines(), start=1):
        match = _TIME.fullmatch(text.strip())
        if match is None:
            if not text.strip():
                continue
            raise InputError(f"{path}: line {number}: expected 2011-09-26 13:02:25.964389445")
        *whole, fraction = match.groups()
        found.append(calendar.timegm(tuple(map(int, whole))) * 10**9 + int(fraction.ljust(9, "0")))
        if len(found) > 1 and found[-1] <= found[-2]:
            raise InputError(
                f"{path}: line {number}: its time is not after that of the line before"
            )
    return np.array(found, dtype=np.int64)


def _rig(day: Path, camera: str) -> CarRig:
    """The rectified camera, and where it is on the GPS/IMU unit."""
    number = camera[-2:]
    cameras = _Calibration(day / "calib_cam_to_cam.txt")
    width, height = cameras.numbers(f"S_rect_{number}", 2)
    P = cameras.numbers(f"P_rect_{number}", 12).reshape(3, 4)
    T_rect_cam = np.eye(4)
    T_rect_cam[:3, :3] = cameras.numbers("R_rect_00", 9).reshape(3, 3)
    # P is K [I | t]: the rectified cameras stand beside each other.
    T_own_rect = np.eye(4)
    T_own_rect[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
    T_cam_velo = _rigid(day / "calib_velo_to_cam.txt")
    T_velo_imu = _rigid(day / "calib_imu_to_velo.txt")
    T_imu_camera = np.linalg.inv(T_own_rect @ T_rect_cam @ T_cam_velo @ T_velo_imu)
    empty = torch.zeros(0, dtype=torch.float64)
    lens = Camera(
        "brown_conrady", int(width), int(height), torch.from_numpy(P[:, :3].copy()), empty
    )
    return CarRig(f"kitti-{camera}", lens, T_imu_camera, camera_height=_CAMERA_HEIGHT_M)


class _Calibration:
    """`NAME: numbers` of a calibration file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        rows = (line.partition(":") for line in read_text(path).splitlines())
        self.content = {name.strip(): text for name, _, text in rows}

    def numbers(self, name: str, count: int) -> Float[np.ndarray, " n"]:
        """The numbers of one entry."""
        if name not in self.content:
            raise InputError(f"{self.path}: {name} is missing")
        try:
            values = np.array([float(x) for x in self.content[name].split()])
        except ValueError:
            values = np.array([np.nan])
        if len(values) != count or not np.isfinite(values).all():
            raise InputError(f"{self.path}: {name}: expected {count} finite numbers")
        return values


def _rigid(path: Path) -> Float[np.ndarray, "4 4"]:
    entries = _Calibration(path)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = entries.numbers("R", 9).reshape(3, 3), entries.numbers("T", 3)
    return T


IMPORTER = Importer(
    summary="a drive of the KITTI raw data: oxts/ and the day's calib_*.txt above; --camera image_02",
    gives=("poses", "rig"),
    tested_on="small files after the published layout",
    read=read,
)
