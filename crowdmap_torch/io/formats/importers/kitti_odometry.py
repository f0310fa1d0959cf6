"""Poses of the KITTI odometry benchmark: twelve numbers a line, the first camera's pose, and times.txt beside.

A pose is the upper three rows of T_world_camera, row by row, in metres; the world is the first pose's camera (x right, y
down, z forward). times.txt has the seconds of each line. Heading and place on the earth are not in the benchmark: forward
counts as north.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.lines import Line, columns, read_numbers, times
from crowdmap_torch.io.formats.composing.parts import Asked, Importer, Parts, Track

_POSE = tuple(f"pose[{k}]" for k in range(12))
_TOLERANCE = 1e-3


def read(sources: tuple[Path, ...], asked: Asked) -> Parts:
    """The poses of one file; its times.txt is another source, or lies beside it."""
    files = _named(sources)
    lines = read_numbers(files["poses"], (12,), "12 numbers of a pose, row by row")
    rows = columns(lines, 0, _POSE).reshape(-1, 3, 4)
    _refuse_no_rotation(lines, rows[:, :, :3])
    clock = read_numbers(files["times"], (1,), "a time in seconds")
    if len(clock) != len(lines):
        raise InputError(
            f"{files['times']}: has {len(clock)} times for the {len(lines)} poses of "
            f"{files['poses']}; expected as many"
        )
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3] = rows
    track = Track(files["poses"], times(clock, 0, "s"), T, world="rdf", link="camera")
    return Parts(track=track)


def _named(sources: tuple[Path, ...]) -> dict[str, Path]:
    """The sources by what they hold."""
    found: dict[str, Path] = {}
    for path in sources:
        kind = "times" if path.stem == "times" else "poses"
        if kind in found:
            raise InputError(f"{path}: a second file of {kind}; expected POSES.txt times.txt")
        found[kind] = path
    if "times" not in found and "poses" in found:
        found["times"] = found["poses"].with_name("times.txt")
    if "poses" not in found:
        raise InputError(f"{sources[0]}: a file of times alone; expected POSES.txt times.txt")
    return found


def _refuse_no_rotation(lines: list[Line], R: Float[np.ndarray, "n 3 3"]) -> None:
    off = np.abs(R @ R.mT - np.eye(3)).max((1, 2))
    bad = (off > _TOLERANCE) | (np.linalg.det(R) < 0)
    if bad.any():
        raise lines[int(bad.argmax())].fault(
            "its first three columns are no rotation; expected the rows of [R t], r11 r12 r13 tx r21 ..."
        )


IMPORTER = Importer(
    summary="poses of KITTI odometry: 12 numbers a line, and times.txt",
    gives=("poses",),
    tested_on="small files after the published layout",
    read=read,
)
