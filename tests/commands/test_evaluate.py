"""Figures of the folders of a dataset and a run, by the command."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from crowdmap_torch.cli import main
from crowdmap_torch.evaluation.evidence import read_map_or_journey
from crowdmap_torch.io.maps import read_map, write_map
from crowdmap_torch.simulate.dataset import SimulationConfig, write_dataset
from crowdmap_torch.simulate.worlds import WORLD_PRESETS


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
    assert main(["evaluate", *map(str, arguments), "--json", str(out)]) == 0
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


def test_wrong_input_is_one_line_and_exit_code_2(dataset, tmp_path, capsys):
    other = tmp_path / "other"
    shutil.copytree(dataset / "survey", other, ignore=shutil.ignore_patterns("truth"))
    head = json.loads((other / "map.json").read_text())
    head["origin"]["lat_deg"] += 1e-6
    (other / "map.json").write_text(json.dumps(head))
    assert main(["evaluate", str(dataset / "survey"), str(other)]) == 2
    assert "origin" in capsys.readouterr().err
    assert main(["evaluate", str(tmp_path / "nowhere"), str(other)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "nowhere" in error
