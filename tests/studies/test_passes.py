"""Real drives cut into passes, alone and as crowds, on a simulated street in the same form."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.evaluation.local import read_surveyed_from
from crowdmap_torch.geometry import se3
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.optim.levenberg_marquardt import LmConfig
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.passes import COPIES, MeasureDrives, drives_of

F64 = torch.float64


@pytest.fixture
def surveyed_from(tiny_folder: Path, tmp_path: Path) -> Path:
    """The street's signs as the first drive's cameras have them by its own poses, biases and all."""
    journey, survey = load_dataset(tiny_folder).journeys[0], read_survey(tiny_folder / "survey")
    T = se3.inverse(journey.T_world_camera)
    found = {}
    for name, center in zip(survey.sign_id, survey.signs.center_world, strict=True):
        p = se3.transform(T, center.expand(len(T), 3))
        near = torch.nonzero((p[:, 2] > 5) & (p[:, 2] < 25))[:, 0].tolist()
        if near:
            found[name] = [
                {"frame": int(journey.frame_number[k]), "xyz_camera": p[k].tolist()} for k in near
            ]
    path = tmp_path / "surveyed_from.json"
    path.write_text(json.dumps({tiny_folder.name: found}))
    return path


def test_a_drive_that_comes_back_is_several(tiny_folder: Path):
    journey = load_dataset(tiny_folder).journeys[0]
    twice = journey.with_frames(torch.arange(journey.frame_count).repeat(2))
    (one,), both = drives_of(journey), drives_of(twice)
    assert one.frame_count == journey.frame_count and len(one.signs) == len(journey.signs)
    assert len(both) > 1 and sum(drive.frame_count for drive in both) == twice.frame_count
    assert len({drive.journey_id for drive in both}) == len(both)
    for name in ("signs", "lanes", "lane_points"):
        assert sum(len(getattr(d, name)) for d in both) == 2 * len(getattr(journey, name))
    last = both[-1]
    assert torch.equal(
        last.T_world_camera[last.signs.frame],
        twice.T_world_camera[-last.frame_count :][last.signs.frame],
    )


def test_drives_are_measured_in_their_own_cameras(
    tiny_folder: Path, surveyed_from: Path, folder: StudyFolder
):
    few_steps = replace(MapperConfig().adjust, lm=LmConfig(max_iterations=3))
    config = replace(MapperConfig(), adjust=few_steps)
    task = MeasureDrives(tiny_folder, surveyed_from, 2.0, "passes", config=config)
    task.run(folder)
    result = folder.read_result(task.key)
    assert result["drives"] == 3
    seen = read_surveyed_from(surveyed_from)[tiny_folder.name]
    assert {name.split("@")[0] for name in result["single"]} <= seen.keys()
    both = result["single"].keys() & result["map"].keys()
    assert both and all(0 < result["map"][name] < 2 for name in both)
    assert len(result["relative"]) == 1


def test_copies_are_as_many_drives_each_with_errors_of_its_own(
    tiny_folder: Path, surveyed_from: Path
):
    drive = load_dataset(tiny_folder).journeys[0]
    task = MeasureDrives(
        tiny_folder, surveyed_from, 2.0, "copies", "simulated", None, MapperConfig()
    )
    surveyed = read_surveyed_from(surveyed_from)[tiny_folder.name]
    ((*copies,),) = task._crowds([drive], surveyed)
    made = [task._driven(one, number) for number, one in copies]
    assert len({one.journey_id for one in made}) == COPIES
    moved = (
        torch.stack([one.T_world_camera[0, :3, 3] for one in made]) - drive.T_world_camera[0, :3, 3]
    )
    assert len({round(float(x), 6) for x in moved[:, 0]}) == COPIES
    assert 0.1 < float(moved.norm(dim=-1).mean()) < 5
    assert all(torch.equal(one.signs.corners_px, drive.signs.corners_px) for one in made)


def test_signs_are_surveyed_from_another_camera_than_the_one_that_saw_them(
    tiny_folder: Path, surveyed_from: Path
):
    drive = load_dataset(tiny_folder).journeys[0]
    surveyed = read_surveyed_from(surveyed_from)[tiny_folder.name]
    task = MeasureDrives(tiny_folder, surveyed_from, 2.0, "alone")
    beside = replace(task, seen_from=(-0.3, 0.0, 0.1))
    moved = beside._driven(drive, 0)
    place = torch.tensor((-0.3, 0.0, 0.1)).to(drive.T_world_camera)
    seen = se3.transform(drive.T_world_camera, place.expand(drive.frame_count, 3))
    assert torch.allclose(moved.T_world_camera[:, :3, 3], seen, atol=1e-9)
    assert torch.equal(moved.T_world_camera[:, :3, :3], drive.T_world_camera[:, :3, :3])
    signs = read_survey(tiny_folder / "survey").signs.center_world + 0.1
    near = task._local(signs, drive.T_world_camera, drive, surveyed)
    assert near and beside._local(signs, moved.T_world_camera, moved, surveyed) == pytest.approx(
        near
    )
    assert beside.key != task.key


def test_errors_of_different_kinds_are_different_work(tiny_folder: Path, surveyed_from: Path):
    kinds = [
        MeasureDrives(tiny_folder, surveyed_from, 2.0, crowd, errors)
        for crowd in ("alone", "passes", "copies")
        for errors in ("none", "simulated", "recorded")
    ]
    assert len({task.key for task in kinds}) == len(kinds)
