"""Units of times and positions, told by how often a camera takes pictures and how fast cars are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from crowdmap_torch.plausibility.finding import Repair
from crowdmap_torch.plausibility.units import (
    RawPoses,
    UnitLimits,
    raw_findings,
    read_raw_poses,
    usual_speed,
)


def drive(speed_mps: float = 12.0, rate_hz: float = 10.0, frames: int = 60) -> RawPoses:
    k = np.arange(frames, dtype=np.float64)
    p = np.stack((k * speed_mps / rate_hz, 0.01 * np.sin(k), 0 * k), -1)
    q = np.tile([0.5, -0.5, 0.5, -0.5], (frames, 1))
    return RawPoses(k, 1.7e18 + np.rint(k * 1e9 / rate_hz), p, q)


def found(raw: RawPoses) -> list[tuple[str, Repair | None]]:
    return [(finding.kind, finding.repair) for finding in raw_findings(raw)]


@pytest.mark.parametrize("speed_mps", [0.0, 0.05, 1.5, 12.0, 33.0, 60.0])
@pytest.mark.parametrize("rate_hz", [0.6, 3.0, 15.0, 120.0])
def test_any_car_with_any_camera_is_sound(speed_mps: float, rate_hz: float) -> None:
    assert found(drive(speed_mps, rate_hz)) == []


@pytest.mark.parametrize("speed_mps", [5.0, 12.0, 33.0])
@pytest.mark.parametrize("factor", [1e3, 1e6, 1e9])
def test_a_unit_of_time_is_named(speed_mps: float, factor: float) -> None:
    raw = drive(speed_mps)
    assert found(replace(raw, t=raw.t / factor)) == [
        ("frame-times", Repair("time-unit", (factor,)))
    ]


@pytest.mark.parametrize("speed_mps", [5.0, 12.0, 33.0])
@pytest.mark.parametrize("time", [1.0, 1e3])
def test_millimetres_are_named_whatever_the_unit_of_time(speed_mps: float, time: float) -> None:
    raw = drive(speed_mps)
    named = found(replace(raw, t=raw.t / time, position=raw.position * 1e3))
    assert named[-1] == ("speed", Repair("length-unit", (1e-3,)))
    assert len(named) == (1 if time == 1 else 2)


def test_a_speed_that_several_units_explain_has_no_sure_cure() -> None:
    raw = drive(3.5)
    assert found(replace(raw, position=raw.position * 1e3)) == [("speed", None)]


def test_rows_out_of_order_are_told_from_frames_that_are_there_twice() -> None:
    raw = drive()
    order = np.roll(np.arange(len(raw.t)), 20)
    mixed = RawPoses(raw.frame[order], raw.t[order], raw.position[order], raw.quaternion[order])
    assert found(mixed) == [("unsorted-frames", Repair("sort-frames"))]
    frame = raw.frame.copy()
    frame[5] = frame[4]
    assert found(replace(mixed, frame=frame[order])) == []


def test_quaternions_that_are_rounded_are_told_from_others() -> None:
    raw = drive()
    rounded = replace(raw, quaternion=raw.quaternion * 1.005)
    assert found(rounded) == [("quaternion-length", Repair("unit-quaternions"))]
    assert found(replace(raw, quaternion=raw.quaternion * 2)) == []


def test_few_frames_say_nothing() -> None:
    raw = drive(frames=6)
    assert found(replace(raw, position=raw.position * 1e3)) == []
    assert usual_speed(raw.t * 1e-9, raw.position, UnitLimits()) is None


def test_columns_that_are_no_numbers_are_not_judged(tmp_path: Path) -> None:
    raw, path = drive(), tmp_path / "poses.parquet"
    columns = {"frame": raw.frame, "t_ns": raw.t}
    columns |= {name: raw.position[:, k] for k, name in enumerate("xyz")}
    columns |= {name: raw.quaternion[:, k] for k, name in enumerate(("qx", "qy", "qz", "qw"))}
    pq.write_table(pa.table(columns), path)
    read = read_raw_poses(path)
    assert read is not None and (read.position == raw.position).all()
    pq.write_table(pa.table({**columns, "x": ["here"] * len(raw.t)}), path)
    assert read_raw_poses(path) is None
    assert read_raw_poses(tmp_path / "none.parquet") is None
