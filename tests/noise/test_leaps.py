"""Leaps of positions: how far they are, and drives that are put together again where they leap."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from worlds.drives import without_detections
from worlds.stop_and_go import driven

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.noise.leaps import largest_leap, without_leaps
from crowdmap_torch.tables import Dataset, Journey

F64 = torch.float64


def leap_of(journey: Journey) -> float:
    return float(largest_leap(journey.T_world_camera[:, :3, 3], journey.t_ns))


def moved(journey: Journey, frame: int, by: list[float]) -> Journey:
    """The journey whose positions are off from a frame on."""
    T = journey.T_world_camera.clone()
    T[frame:, :3, 3] += torch.tensor(by, dtype=T.dtype)
    return replace(journey, T_world_camera=T)


def test_ordinary_drives_do_not_leap(tiny: Dataset):
    for journey in tiny.journeys:
        assert leap_of(journey) < 0.3


@pytest.mark.parametrize("by", [[8.0, 0.0, 0.0], [0.0, -8.0, 0.0], [-6.0, 6.0, 0.0]])
def test_a_jump_in_any_direction_is_a_leap_of_its_length(tiny: Dataset, by: list[float]):
    journey = tiny.journeys[0]
    leap = leap_of(moved(journey, journey.frame_count // 2, by))
    # Less what brakes and tyres might explain, and the noise of the positions: some centimetres a frame.
    assert leap == pytest.approx(torch.tensor(by).norm().item(), abs=0.5)


def test_a_gap_in_the_frames_is_no_leap(tiny: Dataset):
    journey = tiny.journeys[0]
    kept = torch.ones(journey.frame_count, dtype=torch.bool)
    kept[journey.frame_count // 2 : journey.frame_count // 2 + 30] = False
    gapped = without_detections(journey, kept.nonzero()[:, 0])
    assert leap_of(gapped) < 0.5


def test_times_that_jitter_are_no_leap(tiny: Dataset, generator: torch.Generator):
    journey = tiny.journeys[0]
    late = 1e8 * torch.rand(journey.frame_count, generator=generator, dtype=torch.float64)
    # Still one after the other, some of them a millisecond apart.
    t_ns = (journey.t_ns + late.long()).cummax(0)[0] + 10**6 * torch.arange(journey.frame_count)
    jittered = replace(journey, t_ns=t_ns)
    assert leap_of(jittered) < 0.5
    jump = moved(jittered, journey.frame_count // 2, [8.0, 0.0, 0.0])
    # Of a step that seems to have taken a tenth of a second more, brakes explain more.
    assert leap_of(jump) == pytest.approx(8.0, abs=1.5)


def test_one_or_two_frames_do_not_leap(tiny: Dataset):
    journey = tiny.journeys[0]
    for count in (0, 1, 2):
        short = without_detections(journey, torch.arange(count))
        assert leap_of(short) == 0.0


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("rate_hz", [2.0, 10.0, 30.0])
def test_a_drive_without_leaps_stays_as_it_is(rate_hz: float, seed: int):
    T, t_ns = driven(rate_hz, 60.0, seed)
    same, lengths = without_leaps(T, t_ns)
    assert same is T and not len(lengths)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("rate_hz", [10.0, 30.0])
def test_a_drive_goes_on_where_it_leaps_and_its_mean_stays(rate_hz: float, seed: int):
    T, t_ns = driven(rate_hz, 60.0, seed)
    leapt, n = T.clone(), len(T)
    by = torch.tensor([[1.5, -1.0, 0.3], [-0.2, 2.5, -1.0]], dtype=F64)
    # While it drives, and while it stands.
    for row, leap in zip((n // 5, n // 2), by, strict=True):
        leapt[row:, :3, 3] += leap
    found, lengths = without_leaps(leapt, t_ns)
    torch.testing.assert_close(lengths, by.norm(dim=1), rtol=0, atol=0.15)
    off = (found - T)[:, :3, 3]
    # What is left is what noise of one step makes of each leap; before, it was metres.
    assert (off - off.mean(0)).norm(dim=1).max() < 0.2
    torch.testing.assert_close(found[:, :3, 3].mean(0), leapt[:, :3, 3].mean(0))
    assert torch.equal(found[:, :3, :3], T[:, :3, :3])


@pytest.mark.parametrize("behind", [4, 6, 9])
def test_a_leap_a_few_frames_from_either_end_is_one(behind: int):
    T, t_ns = driven(10.0, 60.0, 0)
    for row in (behind, len(T) - behind):
        leapt = T.clone()
        leapt[row:, :3, 3] += torch.tensor([2.0, -1.5, 0.5], dtype=F64)
        _, lengths = without_leaps(leapt, t_ns)
        assert len(lengths) == 1


def test_what_is_no_leap_of_a_receiver_is_left_alone():
    T, t_ns = driven(10.0, 60.0, 0)
    n = len(T)
    far = T.clone()
    far[n // 5 :, 0, 3] += 20.0
    # Another drive: it looks elsewhere, or is faster.
    turned = T.clone()
    turned[n // 5 :, 0, 3] += 9.0
    turned[n // 5 :, :3, :3] @= se3.so3_exp(torch.tensor([0.0, 0.0, 0.5], dtype=F64))
    faster = T.clone()
    faster[n // 5 :, :3, 3] *= 2.0
    faster[n // 5 :, 0, 3] += 9.0
    fixes = T.clone()
    fixes[:, :3, 3] = T[torch.arange(n) // 5 * 5, :3, 3]
    often = T.clone()
    often[:, 0, 3] += 1.5 * (torch.arange(n) // 10 % 2)
    for other in (far, turned, faster, fixes, often, T[:3]):
        same, lengths = without_leaps(other, t_ns[: len(other)])
        assert same is other and not len(lengths)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("rate_hz", [10.0, 30.0])
def test_noise_between_buildings_is_no_leap(rate_hz: float, seed: int):
    T, t_ns = driven(rate_hz, 60.0, seed)
    draw = torch.Generator().manual_seed(seed)
    noisy, begin = T.clone(), len(T) // 5
    noise = 0.5 * torch.randn(45, 3, generator=draw, dtype=F64)
    noisy[begin : begin + 45, :3, 3] += noise
    same, lengths = without_leaps(noisy, t_ns)
    assert same is noisy and not len(lengths)


def test_drives_are_put_together_as_they_are_read_and_say_so(winding_folder: Path, tmp_path: Path):
    folder = Path(shutil.copytree(winding_folder, tmp_path / "leapt"))
    path = folder / "journeys/journey-001/poses.parquet"
    table = pq.read_table(path)
    x = table.column("x").to_numpy().copy()
    x[len(x) // 2 :] += 2.0
    place = table.column_names.index("x")
    pq.write_table(table.set_column(place, "x", pa.array(x)), path)
    before, after = load_dataset(winding_folder), load_dataset(folder)
    assert [len(journey.leaps_m) for journey in after.journeys] == [
        int(n == 1) for n in range(len(after.journeys))
    ]
    assert after.journeys[1].leaps_m[0] == pytest.approx(2.0, abs=0.15)
    steps = [d.journeys[1].T_world_camera[:, :3, 3].diff(dim=0) for d in (before, after)]
    assert np.abs((steps[1] - steps[0]).numpy()).max() < 0.15
