"""Positions that are noisy for a while are those of a car again, and all others stay."""

from __future__ import annotations

import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from torch import Tensor
from worlds.stop_and_go import driven

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.noise.bursts import without_bursts

F64 = torch.float64


def noise(n: int, first: int, count: int, sigma: float, seed: int) -> Tensor:
    """White noise of some frames."""
    found = torch.zeros(n, 3, dtype=F64)
    draw = torch.Generator().manual_seed(seed)
    found[first : first + count] = sigma * torch.randn(count, 3, generator=draw, dtype=F64)
    return found


def moved(T: Tensor, by: Tensor) -> Tensor:
    return se3.make(T[:, :3, :3], T[:, :3, 3] + by)


def rms(off: Tensor) -> float:
    return float(off.square().sum(1).mean().sqrt())


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("rate_hz", [2.0, 10.0, 30.0])
def test_a_quiet_drive_stays_as_it_is(rate_hz: float, seed: int):
    T, t_ns = driven(rate_hz, 60.0, seed)
    same, count = without_bursts(T, t_ns)
    assert same is T and count == 0


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("rate_hz", "sigma"), [(10.0, 0.5), (15.0, 0.3), (30.0, 0.5), (30.0, 1.0)])
def test_noise_is_smoothed_where_it_is(rate_hz: float, sigma: float, seed: int):
    T, t_ns = driven(rate_hz, 60.0, seed)
    first, count = len(T) // 5, int(3 * rate_hz)
    by = noise(len(T), first, count, sigma, seed)
    found, frames = without_bursts(moved(T, by), t_ns)
    is_noisy = by.any(1)
    off = (found - T)[:, :3, 3]
    assert rms(off[is_noisy]) < 0.45 * rms(by[is_noisy])
    # A little before and behind is smoothed as well.
    assert count <= frames <= count + 40
    assert rms(off[~is_noisy]) < 0.05
    far = (torch.arange(len(T)) < first - 20) | (torch.arange(len(T)) > first + count + 20)
    assert not off[far].any()
    assert torch.equal(found[:, :3, :3], T[:, :3, :3])


def test_a_drive_that_is_noisy_all_along_and_one_that_leaps_stay():
    T, t_ns = driven(10.0, 60.0, 0)
    n = len(T)
    leap = torch.zeros(n, 3, dtype=F64)
    leap[n // 3 :, 0] = 2.0
    spikes = torch.zeros(n, 3, dtype=F64)
    spikes[:: n // 8] = 1.5
    for by in (noise(n, 0, n, 0.4, 0), noise(n, n // 5, 2 * n // 3, 0.4, 0), leap, spikes):
        other = moved(T, by)
        same, count = without_bursts(other, t_ns)
        assert same is other and count == 0
    short, count = without_bursts(T[:10], t_ns[:10])
    assert len(short) == 10 and count == 0


def test_frames_a_moment_apart_and_gaps_are_no_matter():
    T, t_ns = driven(15.0, 60.0, 1)
    first, count = len(T) // 5, 45
    by = noise(len(T), first, count, 0.5, 2)
    kept = torch.ones(len(T), dtype=torch.bool)
    kept[first + 20 : first + 25] = False
    kept[first + count + 15 : first + count + 60] = False
    t_ns = t_ns.clone()
    t_ns[first + 3] = t_ns[first + 2] + 1000
    found, frames = without_bursts(moved(T, by)[kept], t_ns[kept])
    off = (found - T[kept])[:, :3, 3][by[kept].any(1)]
    assert frames and rms(off) < 0.6 * rms(by[by.any(1)])


def test_drives_are_smoothed_as_they_are_read_and_say_so(winding_folder: Path, tmp_path: Path):
    folder = Path(shutil.copytree(winding_folder, tmp_path / "noisy"))
    path = folder / "journeys/journey-001/poses.parquet"
    table = pq.read_table(path)
    by = noise(len(table), len(table) // 2, len(table) // 10, 0.6, 0)
    for axis, name in enumerate("xyz"):
        value = table.column(name).to_numpy() + by[:, axis].numpy()
        table = table.set_column(table.column_names.index(name), name, pa.array(value))
    pq.write_table(table, path)
    before, after = (load_dataset(f).journeys for f in (winding_folder, folder))
    assert [journey.noisy_frames > 0 for journey in after] == [n == 1 for n in range(len(after))]
    off = (after[1].T_world_camera - before[1].T_world_camera)[:, :3, 3]
    assert rms(off[by.any(1)]) < 0.4 and not after[1].leaps_m
