"""Ground truth of the EuRoC MAV data sets (ASL): `timestamp [ns], x y z, qw qx qy qz`, and columns that are not used."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from crowdmap_torch.io.formats.composing.lines import columns, poses, read_numbers, times
from crowdmap_torch.io.formats.composing.parts import Asked, Importer, Parts, Track
from crowdmap_torch.io.formats.composing.sources import file_in, the_one

_NAMES = ("x", "y", "z", "qw", "qx", "qy", "qz")
_PLACE = "mav0/state_groundtruth_estimate0/data.csv"


def read(sources: tuple[Path, ...], asked: Asked) -> Parts:
    """The poses of a data.csv, or of the sequence's folder that it is in."""
    path = the_one(sources, "a data.csv or the folder of a sequence")
    path = file_in(path, _PLACE) if path.is_dir() else path
    lines = read_numbers(path, (8, 17), "8 or 17 numbers: timestamp [ns], x y z, qw qx qy qz, ...")
    numbers = columns(lines, 1, _NAMES)
    # The quaternion's real part comes first here.
    T = poses(lines, numbers[:, :3], np.roll(numbers[:, 3:], -1, axis=1))
    return Parts(track=Track(path, times(lines, 0, "ns"), T, world=None, link=None))


IMPORTER = Importer(
    summary="ground truth of EuRoC: data.csv with timestamp [ns], x y z, qw qx qy qz",
    gives=("poses",),
    tested_on="small files after the published layout",
    read=read,
)
