"""The whole mapper on a GPU, where one is at hand: the CPU's map to a micrometre, and every time the same bits."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
import torch
from worlds.devices import FRAMES, assert_near, differences, first_frames, optimized, short
from worlds.drives import write_tiny

from crowdmap_torch import mapper
from crowdmap_torch.adjustment import adjust
from crowdmap_torch.benchmark import bundle, free_corners
from crowdmap_torch.evaluation.evaluate import evaluate_map
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.processes.sums import add_at
from crowdmap_torch.processes.threads import repeatable
from crowdmap_torch.single_journey import SingleJourneyMapper, frame_of
from crowdmap_torch.tables import Dataset, to_device

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device is there")
GPU = torch.device("cuda:0")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four short journeys of a street."""
    return write_tiny(tmp_path_factory.mktemp("cuda") / "dataset", journeys=4, length_m=120.0)


@pytest.fixture(scope="module")
def here(folder: Path) -> Dataset:
    return load_dataset(folder)


def test_optimize_makes_the_cpus_map_and_twice_the_same_bits(folder: Path, tmp_path: Path):
    runs = [("cpu", "cpu"), ("one", "cuda"), ("two", "cuda:0")]
    with warnings.catch_warnings():
        # What torch does in no fixed order it warns of.
        warnings.filterwarnings("error", message=".*deterministic.*")
        cpu, one, two = (
            read_map(optimized(folder, tmp_path / name, device)[0] / "map") for name, device in runs
        )
    assert len(cpu.signs) and len(cpu.lanes)
    assert_near(cpu.signs, one.signs)
    assert_near(cpu.lanes, one.lanes)
    covariances = cpu.shared_covariance, one.shared_covariance
    torch.testing.assert_close(*covariances, rtol=1e-6, atol=1e-6)
    assert list(differences(one.signs, two.signs)) == []
    assert list(differences(one.lanes, two.lanes)) == []


def test_a_drive_is_mapped_frame_by_frame(here: Dataset):
    made = []
    for journey in (first_frames(here), to_device(first_frames(here), GPU)):
        one = SingleJourneyMapper(journey.rig)
        labels = [one.step(frame_of(journey, i)).sign_tracklet.cpu() for i in range(FRAMES)]
        made.append((torch.cat(labels), *one.finish()))
    (labels, signs, lanes), (labels_there, signs_there, lanes_there) = made
    assert torch.equal(labels, labels_there)
    assert_near(signs, signs_there)
    assert_near(lanes, lanes_there)


def test_many_rows_are_added_up_with_the_same_bits_every_time():
    drawn = torch.Generator().manual_seed(0)
    value = torch.randn(3, 1_000_000, dtype=torch.float64, generator=drawn)
    index = torch.randint(0, 5000, (1_000_000,), generator=drawn)
    index[::2] = 7
    nothing = value.new_zeros(3, 5000)
    expected = add_at(nothing.clone(), 1, index, value)
    one, two = (add_at(nothing.to(GPU), 1, index.to(GPU), value.to(GPU)).cpu() for _ in range(2))
    assert torch.equal(one, two)
    torch.testing.assert_close(one, expected, rtol=1e-9, atol=1e-9)


def test_a_step_waits_for_few_numbers(here: Dataset):
    repeatable(GPU)
    there = to_device(here, GPU)
    maps = mapper.map_journeys(there.journeys, short())
    heads = mapper.first_map(there.journeys, maps, short())
    built = mapper.build_bundle(there.journeys, maps, heads, short())
    steps = adjust.steps(built, adjust.start(built))
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as waits:
            warnings.simplefilter("always")
            count = sum(1 for _ in steps)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    waits = [wait for wait in waits if "synchroniz" in str(wait.message)]
    assert 0 < len(waits) <= 500 * count, len(waits) / count


def test_maps_there_are_judged_beside_a_survey_here(folder: Path, here: Dataset):
    survey = read_survey(folder / "survey")
    there = to_device(here, GPU)
    maps = mapper.map_journeys(there.journeys, short())
    clusters = mapper.clusters_map(there, mapper.first_map(there.journeys, maps, short()))
    figures = evaluate_map(clusters, survey)
    assert figures.signs.absolute == evaluate_map(to_device(clusters, "cpu"), survey).signs.absolute


def test_the_race_ends_at_the_cpus_cost():
    problem = free_corners.simulate(5, 60, 8)
    on_cpu, on_gpu = (bundle.solve(problem, torch.device(name))[0] for name in ("cpu", "cuda"))
    assert on_gpu["cost"] == pytest.approx(on_cpu["cost"], rel=1e-9)
    assert on_gpu["iterations"] == on_cpu["iterations"]
