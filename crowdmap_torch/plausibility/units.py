"""In which units times and positions of a drive are: a camera takes pictures at some rate, and a car drives at some speed.

Judged from the columns of poses.parquet as they stand, so that files are judged too that are refused for what follows from
a wrong unit, such as a car that moves kilometres in a second.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from jaxtyping import Float

from crowdmap_torch.io.rigs import UNIT_TOLERANCE
from crowdmap_torch.plausibility.finding import Finding, Repair
from crowdmap_torch.plausibility.held import held_frames


@dataclass(frozen=True)
class UnitLimits:
    """What is still taken for frames of a camera on a car."""

    frame_s: tuple[float, float] = (0.004, 2.0)
    """Median time between frames."""
    fastest_mps: float = 70.0
    """Median speed of the moving part."""
    usual_mps: tuple[float, float] = (3.0, 45.0)
    """The same under the unit that is named."""
    moving: float = 0.2
    """The moving part are steps of more than this share of the longest ones (their 95th percentile)."""
    least_frames: int = 10
    rounded: float = 0.1
    """Quaternions whose lengths are this near to 1 were rounded or averaged; further off they are something else."""


TIME_UNITS = (("microseconds", 1e3), ("milliseconds", 1e6), ("seconds", 1e9))
"""What t_ns may be in, and what to multiply it by."""
LENGTH_UNITS = (("millimetres", 1e-3), ("centimetres", 1e-2), ("kilometres", 1e3))
"""What positions may be in, and what to multiply them by."""
_NUMBERS = ("x", "y", "z", "qx", "qy", "qz", "qw")


@dataclass(frozen=True)
class RawPoses:
    """Columns of poses.parquet as they stand, only that they are numbers."""

    frame: Float[np.ndarray, " f"]
    t: Float[np.ndarray, " f"]
    position: Float[np.ndarray, "f 3"]
    quaternion: Float[np.ndarray, "f 4"]


def read_raw_poses(path: Path) -> RawPoses | None:
    """Whatever numbers a file of poses has; None if a column is missing, or holds something else."""
    try:
        with pq.ParquetFile(path) as file:
            table = file.read(columns=["frame", "t_ns", *_NUMBERS])
            columns = [
                pc.cast(table.column(name), pa.float64(), safe=False).to_numpy()
                for name in ("frame", "t_ns", *_NUMBERS)
            ]
    except (pa.ArrowException, OSError, ValueError, TypeError, KeyError, OverflowError):
        return None
    if not len(columns[0]) or not all(np.isfinite(column).all() for column in columns):
        return None
    frame, t, *numbers = columns
    return RawPoses(frame, t, np.stack(numbers[:3], -1), np.stack(numbers[3:], -1))


def raw_findings(raw: RawPoses, limits: UnitLimits | None = None) -> Iterator[Finding]:
    """What is wrong with columns that may be refused for it: order, units, quaternions that were rounded."""
    limits = limits or UnitLimits()
    order = np.argsort(raw.frame, kind="stable")
    if (order != np.arange(len(order))).any():
        if not ((np.diff(raw.frame[order]) > 0).all() and (np.diff(raw.t[order]) > 0).all()):
            return
        yield Finding(
            "unsorted-frames",
            f"{int((np.diff(raw.frame) < 0).sum()) + 1} runs of frames follow one another out of order",
            "rows of poses.parquet are not sorted",
            "sort them by frame",
            repair=Repair("sort-frames"),
        )
    yield from unit_findings(raw.t[order], raw.position[order], limits)
    off = np.abs(np.sqrt(np.square(raw.quaternion).sum(-1)) - 1)
    if UNIT_TOLERANCE < off.max() < limits.rounded:
        yield Finding(
            "quaternion-length",
            f"lengths of quaternions are off 1 by up to {off.max():.2g}",
            "they were rounded or averaged, and not normalised",
            "divide each by its length",
            repair=Repair("unit-quaternions"),
        )


def unit_findings(
    t_ns: Float[np.ndarray, " f"], position: Float[np.ndarray, "f 3"], limits: UnitLimits
) -> Iterator[Finding]:
    """Whether times are in nanoseconds and positions in metres, by how long a frame and how fast the car is."""
    if len(t_ns) < limits.least_frames:
        return
    seconds = np.diff(t_ns) * 1e-9
    between = float(np.median(seconds))
    factor = 1.0
    low, high = limits.frame_s
    if not low <= between <= high:
        units = [(unit, f) for unit, f in TIME_UNITS if low <= between * f <= high]
        finding = Finding(
            "frame-times",
            f"frames are {between:.2g} s apart in the median",
            "t_ns is not in nanoseconds, or frames are missing",
            "write nanoseconds since 1970-01-01 UTC",
        )
        if units:
            unit, factor = units[0]
            cause, repair = f"t_ns is in {unit}", Repair("time-unit", (factor,))
            finding = replace(finding, cause=cause, repair=repair)
        yield finding
        if not units:
            return
    is_held = held_frames(t_ns, position)
    if is_held.any():
        yield Finding(
            "held-positions",
            f"while the car drives, {is_held.mean():.0%} of its frames are where the one before was, and then it leaps",
            "positions are those of the last fix",
            "write the place of each frame, between two fixes if need be",
            repair=Repair("between-fixes"),
        )
    speed = usual_speed((t_ns * 1e-9 * factor)[~is_held], position[~is_held], limits)
    if speed is not None and speed > limits.fastest_mps:
        low, high = limits.usual_mps
        yield _speed(speed, [(u, f) for u, f in LENGTH_UNITS if low <= speed * f <= high])


def usual_speed(
    t_s: Float[np.ndarray, " f"], position: Float[np.ndarray, "f 3"], limits: UnitLimits
) -> float | None:
    """Median speed of the moving part of a drive [m/s]; None if it does not move at all, or is too short."""
    if len(t_s) < limits.least_frames:
        return None
    seconds = np.diff(t_s)
    step = np.sqrt(np.square(np.diff(position, axis=0)).sum(-1))
    moving = (step > limits.moving * np.percentile(step, 95)) & (seconds > 0)
    return float(np.median(step[moving] / seconds[moving])) if moving.any() else None


def _speed(speed: float, units: list[tuple[str, float]]) -> Finding:
    finding = Finding(
        "speed",
        f"the car drives {speed:.3g} m/s in the median",
        "positions or times are in another unit",
        "write metres and nanoseconds",
    )
    if len(units) != 1:
        return finding
    unit, factor = units[0]
    return replace(
        finding,
        cause=f"positions are in {unit}",
        cure="write metres",
        repair=Repair("length-unit", (factor,)),
    )
