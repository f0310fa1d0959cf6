"""Refined poses of a run's journeys as trajectories: TUM and KITTI files, one a journey, for evo and its like."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.poses import LinkPoses, read_poses

_LOST = "frame numbers and sigmas: a line has no place for them"


def write_tum(run: Path, folder: Path) -> tuple[str, ...]:
    """Writes JOURNEY.tum: lines of `t x y z qx qy qz qw`, seconds since 1970 and metres."""
    for name, poses in _journeys(run):
        quaternion = se3.to_quaternion(poses.T_world_link[:, :3, :3])
        rows = zip(
            poses.t_ns.tolist(),
            poses.T_world_link[:, :3, 3].tolist(),
            quaternion.tolist(),
            strict=True,
        )
        lines = [
            # All nine decimals of a time do not fit into one floating-point number.
            f"{t // 10**9}.{t % 10**9:09d} " + " ".join(f"{number:.9f}" for number in (*p, *q))
            for t, p, q in rows
        ]
        (folder / f"{name}.tum").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return (_LOST,)


def write_kitti(run: Path, folder: Path) -> tuple[str, ...]:
    """Writes JOURNEY.kitti: lines of the twelve numbers of `[R t]`, row by row."""
    for name, poses in _journeys(run):
        rows = poses.T_world_link[:, :3].reshape(-1, 12).numpy()
        np.savetxt(folder / f"{name}.kitti", rows, fmt="%.12g")
    return ("times, " + _LOST,)


def _journeys(run: Path) -> list[tuple[str, LinkPoses]]:
    folders = sorted(path.parent for path in (run / "journeys").glob("*/poses.parquet"))
    if not folders:
        raise InputError(
            f"{run}: no journeys/ID/poses.parquet; expected a RUN of crowdmap optimize"
        )
    return [(folder.name, read_poses(folder / "poses.parquet")) for folder in folders]
