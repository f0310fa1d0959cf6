from __future__ import annotations

import json
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.tables import Dataset
from crowdmap_torch.viewer.sources import read_scene


def test_a_run_shows_its_drives_before_and_after(
    run_folder: Path, tiny: Dataset, tiny_result: MapResult
) -> None:
    scene = read_scene(run_folder)
    assert scene.kind == "run" and scene.notes == ()
    assert scene.hd_map is not None and scene.map_before is not None and scene.survey is not None
    assert [d.journey_id for d in scene.drives] == [j.journey_id for j in tiny.journeys]
    drive, journey = scene.drives[0], tiny.journeys[0]
    assert drive.given_world is not None and drive.bias is not None
    moved = (drive.path_world - drive.given_world).mean(0)
    # A bias is what is added to the given positions, in the mean along the way.
    refined = tiny_result.poses[0][:, :3, 3] - journey.T_world_camera[:, :3, 3]
    assert torch.allclose(moved, refined.mean(0), atol=0.02)
    camera = journey.rig.camera
    assert drive.image == (camera.width, camera.height) and drive.vehicle == journey.vehicle
    assert scene.outcomes is not None
    assert len(scene.outcomes.rows) == sum(len(j.signs) for j in tiny.journeys)


def test_the_map_of_a_run_shows_the_run(run_folder: Path) -> None:
    assert read_scene(run_folder / "map").kind == "run"


def test_a_map_alone_is_a_map(run_folder: Path, tmp_path: Path) -> None:
    shutil.copytree(run_folder / "map", tmp_path / "alone")
    scene = read_scene(tmp_path / "alone")
    assert scene.kind == "map" and scene.drives == () and scene.outcomes is None


def test_a_survey_whose_signs_are_places_alone_is_shown(run_folder: Path, tmp_path: Path) -> None:
    """As a Lanelet2 map of others gives it: the centres of its signs, or lanes and no file of signs."""
    places = tmp_path / "places"
    shutil.copytree(run_folder / "map", places)
    table = pq.read_table(places / "signs.parquet")
    nothing = pa.nulls(len(table), table.schema.field("corners").type)
    at = table.column_names.index("corners")
    pq.write_table(table.set_column(at, "corners", nothing), places / "signs.parquet")
    scene = read_scene(places)
    assert scene.hd_map is None and scene.survey is not None
    assert len(scene.survey.sign_id) == len(table)
    assert any("the centre alone is known" in note for note in scene.notes)
    (places / "signs.parquet").unlink()
    scene = read_scene(places)
    assert scene.survey is not None and scene.survey.lane_id and not scene.survey.sign_id


def test_a_map_that_is_broken_is_not_taken_for_a_survey(run_folder: Path, tmp_path: Path) -> None:
    shutil.copytree(run_folder / "map", tmp_path / "broken")
    path = tmp_path / "broken" / "signs.parquet"
    table = pq.read_table(path)
    wrong = pa.array([-1.0] * len(table), table.schema.field("confidence").type)
    at = table.column_names.index("confidence")
    pq.write_table(table.set_column(at, "confidence", wrong), path)
    with pytest.raises(InputError, match="confidence"):
        read_scene(tmp_path / "broken")


def test_a_data_set_shows_its_drives(tiny_folder: Path, tiny: Dataset) -> None:
    scene = read_scene(tiny_folder)
    assert scene.kind == "dataset" and len(scene.journeys) == len(tiny.journeys)
    assert scene.survey is not None and scene.hd_map is None


def test_a_run_whose_data_set_is_gone_says_so(run_folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "elsewhere" / "run"
    shutil.copytree(run_folder, run)
    (run / "sign_detections.parquet").unlink()
    scene = read_scene(run)
    assert all(drive.given_world is None for drive in scene.drives)
    assert any("give --dataset" in note for note in scene.notes)
    assert any("sign_detections.parquet" in note for note in scene.notes)


def test_a_data_set_of_another_run_is_refused_or_left_out(
    run_folder: Path, tiny_folder: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    shutil.copytree(tiny_folder, other)
    shutil.rmtree(next(iter((other / "journeys").iterdir())))
    run = tmp_path / "run"
    shutil.copytree(run_folder, run)
    (run / "run.json").write_text(json.dumps({"dataset": "../other"}))
    scene = read_scene(run)
    assert any("the data set is left out" in note for note in scene.notes)
    with pytest.raises(InputError, match=r"journey\.json: the file is missing"):
        read_scene(run, dataset=other)


@pytest.mark.parametrize("name", ["nothing", "empty"])
def test_what_is_neither_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"is no map, run or data set; expected a folder with"):
        read_scene(tmp_path / name)
