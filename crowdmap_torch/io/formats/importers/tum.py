"""Trajectories of the form that evo, ORB-SLAM and others write (TUM): `t x y z qx qy qz qw`, seconds and metres."""

from __future__ import annotations

from pathlib import Path

from crowdmap_torch.io.formats.composing.lines import columns, poses, read_numbers, times
from crowdmap_torch.io.formats.composing.parts import Asked, Importer, Parts, Track
from crowdmap_torch.io.formats.composing.sources import the_one

_NAMES = ("x", "y", "z", "qx", "qy", "qz", "qw")


def read(sources: tuple[Path, ...], asked: Asked) -> Parts:
    """The poses of one file; which way its axes point is for the command line to say."""
    path = the_one(sources, "a text file of t x y z qx qy qz qw")
    lines = read_numbers(path, (8,), "8 numbers t x y z qx qy qz qw")
    numbers = columns(lines, 1, _NAMES)
    T = poses(lines, numbers[:, :3], numbers[:, 3:])
    return Parts(track=Track(path, times(lines, 0, "s"), T, world=None, link=None))


IMPORTER = Importer(
    summary="a trajectory: t x y z qx qy qz qw, seconds and metres (TUM, evo, ORB-SLAM)",
    gives=("poses",),
    tested_on="small files after the published layout",
    read=read,
)
