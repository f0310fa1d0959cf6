"""What the main job says before any work: what it refuses, in one line, and the configuration that it would use."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from worlds.runs import Said, journeys_of, spoil_pose

from crowdmap_torch.adjustment.calibration import CalibrationConfig
from crowdmap_torch.cli import main
from crowdmap_torch.config import MapperConfig, load_config


@pytest.fixture
def optimize_only(capsys: pytest.CaptureFixture) -> Callable[..., Said]:
    """`crowdmap optimize` with these options and no others."""

    def call(*options: str) -> Said:
        code = main(["optimize", *options])
        said = capsys.readouterr()
        return Said(code, said.out, said.err)

    return call


def assert_refused(said: Said, out: Path, *words: str) -> None:
    """Exit code 2, one line that says what is wrong, no map."""
    assert said.code == 2
    assert said.err.count("\n") == 1 and said.err.startswith("crowdmap optimize: ")
    assert [word for word in words if word not in said.err] == []
    assert not out.exists()


def test_a_missing_dataset_is_one_line(optimize, tmp_path: Path):
    out = tmp_path / "run"
    assert_refused(optimize(tmp_path / "none", out), out, "none", "folder is missing")


def test_a_dataset_without_its_head_is_one_line(optimize, copy: Path, tmp_path: Path):
    (copy / "dataset.json").unlink()
    assert_refused(optimize(copy, tmp_path / "run"), tmp_path / "run", "dataset.json")


@pytest.mark.parametrize("what", ["nonsense: 1", "seed: [1", "adjust: {lm: {steps: 1}}"])
def test_a_wrong_configuration_is_one_line(optimize, tiny_folder: Path, tmp_path: Path, what: str):
    config = tmp_path / "some.yaml"
    config.write_text(what)
    said = optimize(tiny_folder, tmp_path / "run", "--config", str(config))
    assert_refused(said, tmp_path / "run", "some.yaml")


def test_a_missing_configuration_is_one_line(optimize, tiny_folder: Path, tmp_path: Path):
    said = optimize(tiny_folder, tmp_path / "run", "--config", str(tmp_path / "none.yaml"))
    assert_refused(said, tmp_path / "run", "none.yaml", "the file is missing")


def test_the_configuration_is_printed_as_it_would_be_used(optimize_only, tmp_path: Path):
    config = tmp_path / "some.yaml"
    config.write_text("method: paper2017\nadjust: {tukey_c: 5.0, lane_height_sigma_m: .inf}\n")
    for options in ((), ("--config", str(config)), ("--calibration", "off")):
        said = optimize_only("--print-config", *options)
        assert (said.code, said.err) == (0, "")
        again = tmp_path / "again.yaml"
        again.write_text(said.out)
        assert optimize_only("--print-config", "--config", str(again)).out == said.out
    assert load_config(again) == MapperConfig(calibration=CalibrationConfig.off())


def test_a_folder_that_is_not_named_is_one_line(optimize_only, tiny_folder: Path):
    for given, missing in (
        ((), "DATASET is missing"),
        ((str(tiny_folder),), "--out RUN is missing"),
    ):
        said = optimize_only(*given)
        assert said.code == 2 and said.err.count("\n") == 1 and missing in said.err


def test_a_journey_that_is_not_there_is_one_line(optimize, tiny_folder: Path, tmp_path: Path):
    said = optimize(tiny_folder, tmp_path / "run", "--journeys", "journey-001,journey-9*")
    assert_refused(said, tmp_path / "run", "'journey-9*'", "journey-000, journey-001, journey-002")


def test_an_area_where_nobody_drove_is_one_line(optimize, tiny_folder: Path, tmp_path: Path):
    said = optimize(tiny_folder, tmp_path / "run", "--bbox", "9000,0,9100,50")
    assert_refused(said, tmp_path / "run", "9000,0,9100,50", "no drive comes there", "they are in")


def test_an_unknown_device_is_one_line(optimize, tiny_folder: Path, tmp_path: Path):
    said = optimize(tiny_folder, tmp_path / "run", "--device", "abacus")
    assert_refused(said, tmp_path / "run", "--device abacus", "cpu or cuda")


def test_a_survey_that_cannot_be_read_is_one_line(optimize, copy: Path, tmp_path: Path):
    (copy / "survey" / "signs.parquet").write_bytes(b"nonsense")
    said = optimize(copy, tmp_path / "run")
    assert_refused(said, tmp_path / "run", "survey", "signs.parquet", "cannot be read")


def test_a_truth_that_cannot_be_read_is_one_line(optimize, copy: Path, tmp_path: Path):
    (copy / "survey" / "truth" / "journey-001" / "poses.parquet").write_bytes(b"nonsense")
    said = optimize(copy, tmp_path / "run")
    assert_refused(said, tmp_path / "run", "truth", "poses.parquet", "cannot be read")


def test_a_survey_of_another_place_is_one_line(optimize, copy: Path, tmp_path: Path):
    head = json.loads((copy / "survey" / "map.json").read_text())
    head["origin"]["lon_deg"] += 0.001
    (copy / "survey" / "map.json").write_text(json.dumps(head))
    assert_refused(optimize(copy, tmp_path / "run"), tmp_path / "run", "expected one origin")


def test_a_bad_journey_with_strict_is_one_line(optimize, copy: Path, tmp_path: Path):
    spoil_pose(journeys_of(copy)[1])
    said = optimize(copy, tmp_path / "run", "--strict")
    assert_refused(said, tmp_path / "run", "journey-001", "poses.parquet", "'x'")


def test_journeys_that_are_all_bad_are_a_line_each_and_one_for_all(
    optimize, copy: Path, tmp_path: Path
):
    first, second, third = journeys_of(copy)
    spoil_pose(first)
    spoil_pose(second)
    (third / "lanes.parquet").unlink()
    said = optimize(copy, tmp_path / "run")
    *aside, last = said.err.splitlines()
    assert [line.split(": ")[0] for line in aside] == [
        f"set aside {journey.name}" for journey in (first, second, third)
    ]
    assert "'x'" in aside[0] and "lanes.parquet" in aside[2]
    assert_refused(replace(said, err=f"{last}\n"), tmp_path / "run", "all 3 journeys", first.name)


def test_a_calibration_that_is_not_there_is_one_line(optimize, tiny_folder: Path, tmp_path: Path):
    said = optimize(tiny_folder, tmp_path / "run", "--calibration", str(tmp_path / "nowhere"))
    assert said.code == 2 and said.err.count("\n") == 1
    assert "calibration.json" in said.err and not (tmp_path / "run").exists()


def test_control_points_of_another_place_are_one_line(optimize, copy: Path, tmp_path: Path):
    control = Path(shutil.copytree(copy / "survey", tmp_path / "control"))
    head = json.loads((control / "map.json").read_text())
    head["origin"]["lat_deg"] += 0.001
    (control / "map.json").write_text(json.dumps(head))
    said = optimize(copy, tmp_path / "run", "--control", str(control))
    assert_refused(said, tmp_path / "run", "expected one origin")


@pytest.mark.parametrize("place", [".", "..", "run", "journeys", "link"])
def test_a_run_never_overlaps_the_data_set(copy: Path, optimize: Callable[..., Said], place: str):
    before = {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()}
    link = copy.parent / "link"
    link.symlink_to(copy)
    said = optimize(copy, link if place == "link" else copy / place, "--overwrite")
    assert said.code == 2 and "overlaps the dataset" in said.err
    assert {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()} == before
