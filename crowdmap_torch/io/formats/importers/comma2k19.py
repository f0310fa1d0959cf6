"""Drives of comma2k19: the folder of a segment with `global_pose/`, arrays of the camera's places and turns, earth-centred.

`frame_orientations` turn the device's axes (forward, right, down) to the earth's, real part first; `frame_gps_times` are
GPS weeks and seconds. The camera is the EON's: 1164 x 874 px with a focal length of 910 px (comma2k19's own tools), no
distortion. How the device looks at the road is taken from its own motion: the road lies along the mean direction of travel,
level across on average. How high it is does not stand there: `--camera-height` says it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.io.budget import file_size
from crowdmap_torch.io.errors import InputError, one_line
from crowdmap_torch.io.formats.composing import headings
from crowdmap_torch.io.formats.composing.axes import link_camera
from crowdmap_torch.io.formats.composing.lines import rotations
from crowdmap_torch.io.formats.composing.parts import Asked, CarRig, Importer, Parts, Track
from crowdmap_torch.io.formats.composing.sources import file_in, the_one
from crowdmap_torch.io.formats.geodesy import geodetic_from_ecef
from crowdmap_torch.tables import Origin

_FOCAL_PX, _WIDTH, _HEIGHT = 910.0, 1164, 874
_GPS_EPOCH_S, _WEEK_S = 315_964_800, 604_800
_LEAP_S = 18
"""What GPS time is ahead of UTC since 2017, before comma2k19 was recorded."""
_MOST_BYTES = 2**30
_MOVING_MPS = 3.0
"""Slower than this nobody can tell the direction of travel from noise."""


def read(sources: tuple[Path, ...], asked: Asked) -> Parts:
    """Poses and rig of one segment."""
    folder = the_one(sources, "the folder of a segment, with global_pose in it")
    position = read_array(folder, "global_pose/frame_positions", 3)
    quaternion = read_array(folder, "global_pose/frame_orientations", 4)
    clock = read_array(folder, "global_pose/frame_gps_times", 2)
    if not len(position) == len(quaternion) == len(clock):
        raise InputError(
            f"{folder / 'global_pose'}: {len(position)} positions, {len(quaternion)} orientations and "
            f"{len(clock)} times; expected as many of each"
        )
    length = np.sqrt(np.square(quaternion).sum(-1))
    if (off := np.abs(length - 1) > 1e-2).any():
        row = int(off.argmax())
        raise InputError(
            f"{folder / 'global_pose/frame_orientations'}: row {row} has length {length[row]:.4g}"
        )
    t_ns = utc_ns(folder, clock)
    T = np.tile(np.eye(4), (len(position), 1, 1))
    # The quaternion's real part comes first here.
    T[:, :3, :3], T[:, :3, 3] = rotations(np.roll(quaternion, -1, axis=1)), position
    origin = asked.origin or Origin(*geodetic_from_ecef(position[0]).tolist())
    track = headings.earth_centred(folder, t_ns, T, origin, link="mount")
    T_link_camera = link_camera("frd", (0.0, 0.0, 0.0))
    K = [[_FOCAL_PX, 0, _WIDTH / 2], [0, _FOCAL_PX, _HEIGHT / 2], [0, 0, 1]]
    empty = torch.zeros(0, dtype=torch.float64)
    lens = Camera("brown_conrady", _WIDTH, _HEIGHT, torch.tensor(K, dtype=torch.float64), empty)
    normal = T_link_camera[:3, :3].T @ _road_normal(track)
    rig = CarRig("eon", lens, T_link_camera, road_normal_camera=normal)
    return Parts(track=track, rig=rig, origin=origin)


def read_array(folder: Path, name: str, columns: int) -> Float[np.ndarray, "n k"]:
    """One of a segment's arrays of so many columns."""
    path = file_in(folder, name)
    file_size(path, _MOST_BYTES)
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: cannot be read as a NumPy array ({one_line(error)})") from error
    if (
        values.ndim != 2
        or values.shape[1] != columns
        or values.dtype.kind != "f"
        or not len(values)
    ):
        raise InputError(
            f"{path}: an array {values.dtype} {list(values.shape)}; expected float rows of {columns}"
        )
    if (bad := ~np.isfinite(values).all(-1)).any():
        raise InputError(f"{path}: row {int(bad.argmax())} is not finite; expected finite numbers")
    return values.astype(np.float64)


def utc_ns(folder: Path, week_and_second: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
    """Unix time of a segment's frames, one after the other."""
    week, second = week_and_second.T
    whole = (_GPS_EPOCH_S - _LEAP_S + week.astype(np.int64) * _WEEK_S) * 10**9
    t_ns = whole + np.rint(second * 1e9).astype(np.int64)
    if (stays := np.diff(t_ns) <= 0).any():
        row = int(stays.argmax()) + 1
        path = folder / "global_pose" / "frame_gps_times"
        raise InputError(f"{path}: row {row}: its time is not after that of the row before")
    return t_ns


def _road_normal(track: Track) -> Float[np.ndarray, " 3"]:
    """The unit normal to the road, downwards, in the device's axes."""
    R, seconds = track.T_world_link[:, :3, :3], track.t_ns * 1e-9
    velocity = np.gradient(track.T_world_link[:, :3, 3], seconds - seconds[0], axis=0)
    speed = np.sqrt(np.square(velocity).sum(-1))
    moving = speed > _MOVING_MPS
    if not moving.any():
        raise InputError(
            f"{track.source}: the car never drives faster than {_MOVING_MPS:g} m/s: which way the device "
            "looks at the road cannot be told; give a rig by --rig and the poses as another format"
        )
    ahead = (R[moving].mT @ (velocity[moving] / speed[moving, None])[..., None])[..., 0].mean(0)
    ahead /= np.sqrt(np.square(ahead).sum())
    down = -R[moving, 2].mean(0)
    normal = down - (down @ ahead) * ahead
    return normal / np.sqrt(np.square(normal).sum())


IMPORTER = Importer(
    summary="a segment of comma2k19: global_pose/; with --camera-height",
    gives=("poses", "rig"),
    tested_on="real files",
    read=read,
)
