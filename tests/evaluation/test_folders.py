"""The truth and the runs on disk, through `scripts/evaluate.py`."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from crowdmap_torch.evaluate import evaluate_map
from crowdmap_torch.evaluation.evidence import gather_evidence, read_map_or_journey
from crowdmap_torch.geometry import camera as camera_module
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.io.datasets import load_journey
from crowdmap_torch.io.maps import read_map, write_map
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.io.truth import read_associations, read_truth
from crowdmap_torch.simulate import WORLD_PRESETS, SimulationConfig, write_dataset
from scripts.evaluate import main


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    """Three simulated drives through a street."""
    out = tmp_path_factory.mktemp("sim") / "street"
    write_dataset(SimulationConfig(world=WORLD_PRESETS["street"], journeys=3, seed=1), out)
    return out


@pytest.fixture(scope="module")
def run(dataset: Path, tmp_path_factory) -> Path:
    """A run whose map is the survey 0.2 m up, one detection in ten associated with nothing."""
    folder = tmp_path_factory.mktemp("run")
    names = sorted(p.name for p in (dataset / "journeys").iterdir())
    hd_map = read_map(dataset / "survey")
    T = hd_map.signs.T_world_sign.clone()
    T[:, 2, 3] += 0.2
    moved = replace(hd_map, signs=replace(hd_map.signs, T_world_sign=T))
    write_map(replace(moved, provenance={"journeys": names}), folder / "map")
    tables = []
    for name in names:
        truth = pq.read_table(dataset / "survey" / "truth" / name / "signs.parquet")
        ids = [i if k % 10 else None for k, i in enumerate(truth["sign_id"].to_pylist())]
        tables.append(
            pa.table(
                {
                    "journey_id": [name] * len(ids),
                    "kind": ["sign"] * len(ids),
                    "row": truth["row"],
                    "landmark_id": pa.array(ids, pa.string()),
                }
            )
        )
        one = folder / "journeys" / name
        one.mkdir(parents=True)
        for kind in ("signs", "lanes"):
            shutil.copy(dataset / "survey" / f"{kind}.parquet", one)
    pq.write_table(pa.concat_tables(tables), folder / "associations.parquet")
    (folder / "metrics.json").write_text("{}")
    return folder


def figures_of(tmp_path: Path, *arguments: str | Path) -> dict:
    out = tmp_path / "figures.json"
    assert main([*map(str, arguments), "--json", str(out)]) == 0
    return json.loads(out.read_text())


def test_a_run_is_judged_by_the_truth(dataset, run, tmp_path, capsys):
    figures = figures_of(tmp_path, run / "map", dataset / "survey")
    assert figures["signs"]["recall"] == 1
    # A map's corners are those of the template through its width and height: equal but for
    # rounding.
    assert figures["signs"]["absolute"]["total"]["mean"] == pytest.approx(0.2, abs=1e-6)
    assert figures["signs"]["relative"]["total"]["mean"] == pytest.approx(0, abs=1e-6)
    assert 0.05 < figures["oracle"]["total"]["mean"] < 1
    assert figures["lanes"]["recall"] == 1
    assert figures["association"]["pair_precision"] == 1
    assert figures["association"]["data_loss"] == pytest.approx(0.1, abs=0.01)
    assert figures["notes"] == []
    printed = capsys.readouterr().out
    assert "oracle corner" in printed
    assert "data loss" in printed


def test_single_journeys_are_freed_of_their_true_pose_error(dataset, run, tmp_path):
    figures = figures_of(tmp_path, run / "map", dataset / "survey")["single_journey"]
    assert figures["journeys"] == 3
    # The copied survey has no pose error to take off: taking one off must show as one.
    assert figures["center"]["total"]["mean"] > 0.1


def test_true_poses_differ_from_given_ones_by_the_positioning_error(dataset):
    survey = read_survey(dataset / "survey")
    name = sorted(p.name for p in (dataset / "journeys").iterdir())[0]
    journey, _ = load_journey(dataset / "journeys" / name)
    (truth,) = read_truth(dataset / "survey", survey, [journey]).journeys
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


def test_without_a_run_associations_are_not_told(dataset, tmp_path):
    figures = figures_of(tmp_path, dataset / "survey", dataset / "survey")
    assert figures["association"] is None
    assert figures["oracle"] is not None
    assert any("associations" in note for note in figures["notes"])


def test_a_survey_without_truth_has_all_its_signs_observable(dataset, tmp_path):
    survey = tmp_path / "survey"
    shutil.copytree(dataset / "survey", survey, ignore=shutil.ignore_patterns("truth"))
    figures = figures_of(tmp_path, dataset / "survey", survey)
    assert figures["signs"]["observable"] == figures["signs"]["true_signs"]
    assert figures["oracle"] is None


def test_control_and_observable_signs_can_be_named(dataset, tmp_path):
    control = tmp_path / "control"
    hd_map = read_map(dataset / "survey")
    first = replace(hd_map, signs=hd_map.signs[torch.arange(2)], sign_id=hd_map.sign_id[:2])
    write_map(first, control)
    named = tmp_path / "ids.json"
    named.write_text(json.dumps({"here": list(hd_map.sign_id[:4]), "elsewhere": ["x"]}))
    figures = figures_of(
        tmp_path,
        dataset / "survey",
        dataset / "survey",
        "--control",
        control,
        "--observable",
        named,
    )
    assert figures["control_signs"] == 2
    assert figures["signs"]["observable"] == 2


def test_a_journey_of_a_run_can_be_judged_as_a_map(dataset, run, tmp_path):
    name = sorted(p.name for p in (run / "journeys").iterdir())[0]
    hd_map = read_map_or_journey(run / "journeys" / name)
    assert hd_map.provenance["journeys"] == [name]
    figures = figures_of(tmp_path, run / "journeys" / name, dataset / "survey")
    # A sign is observable from three journeys on.
    assert figures["signs"]["observable"] == 0


def test_journeys_in_use_are_those_of_the_map(dataset):
    survey = read_survey(dataset / "survey")
    names = sorted(p.name for p in (dataset / "journeys").iterdir())
    hd_map = replace(read_map(dataset / "survey"), provenance={"journeys": names[1:]})
    evidence = gather_evidence(hd_map, survey, dataset / "survey")
    assert evidence.truth is not None
    assert [t.journey.journey_id for t in evidence.truth.journeys] == names[1:]


def test_wrong_input_is_one_line_and_exit_code_2(dataset, tmp_path, capsys):
    other = tmp_path / "other"
    shutil.copytree(dataset / "survey", other, ignore=shutil.ignore_patterns("truth"))
    head = json.loads((other / "map.json").read_text())
    head["origin"]["lat_deg"] += 1e-6
    (other / "map.json").write_text(json.dumps(head))
    assert main([str(dataset / "survey"), str(other)]) == 2
    assert "origin" in capsys.readouterr().err
    assert main([str(tmp_path / "nowhere"), str(other)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "nowhere" in error


def test_the_truth_of_another_dataset_is_refused(dataset, tmp_path):
    survey = tmp_path / "survey"
    shutil.copytree(dataset / "survey", survey)
    name = sorted(p.name for p in (dataset / "journeys").iterdir())[0]
    journey, _ = load_journey(dataset / "journeys" / name)
    path = survey / "truth" / name / "signs.parquet"
    pq.write_table(pq.read_table(path).slice(0, 3), path)
    with pytest.raises(ValueError, match=r"signs\.parquet: 3 rows"):
        read_truth(survey, read_survey(survey), [journey])
    path.unlink()
    with pytest.raises(ValueError, match=r"signs\.parquet"):
        read_truth(survey, read_survey(survey), [journey])


def test_unknown_ids_of_the_truth_are_named(dataset):
    survey = read_survey(dataset / "survey")
    name = sorted(p.name for p in (dataset / "journeys").iterdir())[0]
    journey, _ = load_journey(dataset / "journeys" / name)
    renamed = replace(survey, sign_id=tuple(f"other-{i}" for i in survey.sign_id))
    with pytest.raises(ValueError, match="is not in the survey"):
        read_truth(dataset / "survey", renamed, [journey])


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


def test_real_surveyed_centres_are_measured_by_centre(build, real_data):
    survey = read_survey(real_data("kitti-signs/kitti-00") / "survey")
    assert not survey.signs.has_corners.any()
    signs = build.signs(survey.signs.center_world + torch.tensor([0.1, 0.0, 0.0]))
    figures = evaluate_map(
        replace(build.hd_map(signs), origin=survey.origin), survey, gate_m=2.0
    ).as_dict()
    assert figures["signs"]["recall"] == figures["signs"]["precision"] == 1
    assert figures["signs"]["absolute"]["total"]["count"] == 0
    # The shift is given in single precision.
    assert figures["signs"]["absolute_center"]["total"]["mean"] == pytest.approx(0.1, abs=1e-6)
    assert figures["lanes"] is None
