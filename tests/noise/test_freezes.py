"""Poses that freeze while the car drives on are found, and nothing else is."""

from __future__ import annotations

import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from worlds.stop_and_go import driven

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.datasets import load_dataset, row_count
from crowdmap_torch.noise.freezes import driven_on, frozen_frames
from crowdmap_torch.noise.leaps import without_leaps

F64 = torch.float64


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("rate_hz", [5.0, 15.0, 30.0])
@pytest.mark.parametrize("turns", [True, False])
def test_frozen_frames_are_found_and_put_between(rate_hz: float, seed: int, turns: bool):
    T, t_ns = driven(rate_hz, 60.0, seed)
    first, count = len(T) // 5, round(1.5 * rate_hz)
    frozen = T.clone()
    frozen[first + 1 : first + count, :3, 3] = T[first, :3, 3]
    if not turns:
        frozen[first + 1 : first + count] = T[first]
    found = frozen_frames(frozen, t_ns)
    assert found.nonzero()[:, 0].tolist() == list(range(first + 1, first + count))
    between = driven_on(frozen, t_ns, found)
    # 12 m/s for a second and a half in a bend: a chord is off by less than half a metre.
    assert (between - T)[:, :3, 3].norm(dim=1).max() < 0.5
    assert se3.so3_log(between[:, :3, :3].mT @ T[:, :3, :3]).norm(dim=1).max() < (
        1e-9 if turns else 0.2
    )
    assert without_leaps(between, t_ns)[0] is between


@pytest.mark.parametrize("rate_hz", [2.0, 15.0])
def test_a_car_that_stands_is_not_frozen(rate_hz: float):
    T, t_ns = driven(rate_hz, 60.0, 0)
    still = T.clone()
    # No noise at a standstill: for five seconds not a digit changes.
    middle, count = len(T) // 2, round(2.5 * rate_hz)
    still[middle - count : middle + count] = T[middle]
    assert not frozen_frames(still, t_ns).any()
    assert not frozen_frames(T, t_ns).any()


def test_positions_of_the_last_fix_and_a_third_of_a_drive_are_no_freezes():
    T, t_ns = driven(10.0, 60.0, 0)
    n = len(T)
    third = T.clone()
    third[n // 3 : 2 * n // 3, :3, 3] = T[n // 3, :3, 3]
    for other in (T[torch.arange(n) // 3 * 3], third, T[:4]):
        assert not frozen_frames(other, t_ns[: len(other)]).any()


def test_what_was_detected_in_frozen_frames_is_left_out_and_counted(
    winding_folder: Path, tmp_path: Path
):
    folder = Path(shutil.copytree(winding_folder, tmp_path / "frozen"))
    path = folder / "journeys/journey-001/poses.parquet"
    table = pq.read_table(path)
    first, count = len(table) // 2, 12
    for name in ("x", "y", "z", "qx", "qy", "qz", "qw"):
        value = table.column(name).to_numpy().copy()
        value[first + 1 : first + count] = value[first]
        place = table.column_names.index(name)
        table = table.set_column(place, name, pa.array(value))
    pq.write_table(table, path)
    before, after = (load_dataset(f).journeys[1] for f in (winding_folder, folder))
    gone = torch.arange(first + 1, first + count)
    assert len(after.frame_number) == len(before.frame_number)
    for kind in ("signs", "lanes"):
        theirs, ours = getattr(before, kind), getattr(after, kind)
        kept = ~torch.isin(theirs.frame, gone)
        assert torch.equal(ours.row, theirs.row[kept])
        assert row_count(after, kind[:-1]) == row_count(before, kind[:-1])
    is_kept = ~torch.isin(before.lanes.frame, gone)
    assert torch.equal(
        after.lane_points.px, before.lane_points.px[is_kept[before.lane_points.detection]]
    )
    assert not after.leaps_m
    off = (after.T_world_camera - before.T_world_camera)[:, :3, 3].norm(dim=1)
    assert off.max() < 0.5 and not off[:first].any()
