from __future__ import annotations

import shutil
from dataclasses import replace

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from worlds.drives import without_detections

from crowdmap_torch.geometry import camera as camera_module
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.io.datasets import load_journey
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.io.truth import Truth, read_associations, read_truth


def test_the_mean_error_of_a_car_that_stands_is_that_of_its_frames(tiny_truth: Truth):
    truth = tiny_truth.journeys[0]
    given = truth.journey.T_world_camera
    for frames in (1, 5):
        first = torch.zeros(frames, dtype=torch.int64)
        journey = without_detections(truth.journey, torch.arange(frames))
        stands = replace(
            truth,
            journey=journey,
            T_world_camera=truth.T_world_camera[first],
            road_normal_camera=truth.road_normal_camera[first],
            camera_height=truth.camera_height[first],
        )
        expected = (given[:frames, :3, 3] - truth.T_world_camera[0, :3, 3]).mean(0)
        assert torch.allclose(stands.mean_error_m, expected, atol=0.02)
    apart = given[:, :3, 3] - truth.T_world_camera[:, :3, 3]
    assert torch.allclose(truth.mean_error_m, apart.mean(0), atol=0.1)


def test_true_poses_differ_from_given_ones_by_the_positioning_error(tiny_folder):
    survey = read_survey(tiny_folder / "survey")
    name = sorted(p.name for p in (tiny_folder / "journeys").iterdir())[0]
    journey, _ = load_journey(tiny_folder / "journeys" / name)
    (truth,) = read_truth(tiny_folder / "survey", survey, [journey]).journeys
    shift = (truth.T_world_camera - journey.T_world_camera)[:, :3, 3].norm(dim=-1)
    # The preset's bias is 0.3 m east and north and 0.42 m up, drift 0.25 m: some decimetres, never
    # metres.
    assert 0.02 < shift.mean() < 3
    detected = truth.sign[journey.signs.row]
    # By the true pose, true signs project to where they were detected.
    known = (detected >= 0) & ~truth.sign_outlier[journey.signs.row]
    frame = journey.signs.frame[known]
    center = survey.signs.center_world[detected[known]]
    p_camera = se3.transform(se3.inverse(truth.T_world_camera)[frame], center)
    px, _ = camera_module.project(journey.rig.camera, p_camera)
    mask = polygon.corner_mask(journey.signs.shape[known])[..., None]
    seen = (journey.signs.corners_px[known] * mask).sum(1) / mask.sum(1)
    error = (px - seen).norm(dim=-1)
    # Noise of a pixel or less, and what perspective moves the mean of the corners by.
    assert error.median() < 2


def test_the_truth_of_another_dataset_is_refused(tiny_folder, tmp_path):
    survey = tmp_path / "survey"
    shutil.copytree(tiny_folder / "survey", survey)
    name = sorted(p.name for p in (tiny_folder / "journeys").iterdir())[0]
    journey, _ = load_journey(tiny_folder / "journeys" / name)
    path = survey / "truth" / name / "signs.parquet"
    pq.write_table(pq.read_table(path).slice(0, 3), path)
    with pytest.raises(ValueError, match=r"signs\.parquet: 3 rows"):
        read_truth(survey, read_survey(survey), [journey])
    path.unlink()
    with pytest.raises(ValueError, match=r"signs\.parquet"):
        read_truth(survey, read_survey(survey), [journey])


def test_unknown_ids_of_the_truth_are_named(tiny_folder):
    survey = read_survey(tiny_folder / "survey")
    name = sorted(p.name for p in (tiny_folder / "journeys").iterdir())[0]
    journey, _ = load_journey(tiny_folder / "journeys" / name)
    renamed = replace(survey, sign_id=tuple(f"other-{i}" for i in survey.sign_id))
    with pytest.raises(ValueError, match="is not in the survey"):
        read_truth(tiny_folder / "survey", renamed, [journey])


def test_associations_of_unknown_journeys_lanes_and_nulls_are_left_out(tmp_path):
    path = tmp_path / "associations.parquet"
    columns = {
        "journey_id": ["a", "b", "a", "a", "c"],
        "kind": ["sign", "sign", "lane", "sign", "sign"],
        "row": [4, 1, 0, 2, 0],
        "landmark_id": pa.array(["x", "x", "l", None, "y"], pa.string()),
    }
    pq.write_table(pa.table(columns), path)
    found = read_associations(path, ["b", "a"])
    assert found.journey.tolist() == [1, 0]
    assert found.row.tolist() == [4, 1]
    assert len(set(found.landmark.tolist())) == 1
