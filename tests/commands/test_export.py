"""Maps written in the formats of others, by the command."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import pytest

from crowdmap_torch.cli import main
from crowdmap_torch.io.formats.exporters import export
from crowdmap_torch.simulate.dataset import SimulationConfig, write_dataset
from crowdmap_torch.simulate.worlds import WORLD_PRESETS


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of a simulated street."""
    out = tmp_path_factory.mktemp("sim") / "street"
    write_dataset(SimulationConfig(world=WORLD_PRESETS["street"], journeys=1, seed=1), out)
    return out / "survey"


def failure(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """The one line of a command that refuses its input."""
    assert main(["export", *map(str, arguments)]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1
    return said.err


def test_a_map_is_written_where_it_is_told(survey: Path, tmp_path: Path, capsys):
    out = tmp_path / "deep" / "street.geojson"
    assert main(["export", str(survey), "--to", "geojson", "-o", str(out)]) == 0
    assert capsys.readouterr().out == f"GeoJSON: {out}: 11 signs, 4 lane pieces\n"
    assert len(json.loads(out.read_text())["features"]) == 26
    assert [*out.parent.iterdir()] == [out]


def test_the_map_of_a_run_is_written_beside_it(survey: Path, tmp_path: Path, capsys):
    shutil.copytree(survey, tmp_path / "run" / "map")
    assert main(["export", str(tmp_path / "run"), "--to", "geojson"]) == 0
    assert (tmp_path / "run" / "map.geojson").is_file()


def test_a_file_that_exists_is_replaced_only_when_told(survey: Path, tmp_path: Path, capsys):
    out = tmp_path / "street.geojson"
    out.write_text("mine")
    assert "--overwrite" in failure(capsys, survey, "--to", "geojson", "-o", out)
    assert out.read_text() == "mine"
    assert main(["export", str(survey), "--to", "geojson", "-o", str(out), "--overwrite"]) == 0
    assert json.loads(out.read_text())["type"] == "FeatureCollection"


def test_inputs_are_not_written_over(survey: Path, tmp_path: Path, capsys):
    before = (survey / "signs.parquet").read_bytes()
    out = survey / "signs.parquet"
    assert "inside the map" in failure(capsys, survey, "--to", "geojson", "-o", out, "--overwrite")
    assert (survey / "signs.parquet").read_bytes() == before
    assert "a folder" in failure(capsys, survey, "--to", "geojson", "-o", tmp_path, "--overwrite")


def test_what_is_no_map_is_refused(tmp_path: Path, capsys):
    assert "missing" in failure(capsys, tmp_path / "nowhere", "--to", "geojson")
    assert "map.json" in failure(capsys, tmp_path, "--to", "geojson")


def test_a_format_that_nobody_knows_is_refused(survey: Path, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["export", str(survey), "--to", "crayon"])
    assert stop.value.code == 2
    assert "geojson" in capsys.readouterr().err


def test_a_missing_package_is_said_in_one_line(survey: Path, tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "crowdmap_torch.io.formats.exporters.geojson", None)
    monkeypatch.setitem(export.FORMATS, "geojson", export.ExportFormat("GeoJSON", ".x", "gis"))
    said = failure(capsys, survey, "--to", "geojson", "-o", tmp_path / "x")
    assert "which is not installed: pip install 'crowdmap_torch[gis]'" in said


def test_a_place_that_cannot_be_written_is_one_line(survey: Path, tmp_path: Path, capsys):
    (tmp_path / "file").write_text("a file where a folder is needed")
    out = tmp_path / "file" / "street.geojson"
    assert main(["export", str(survey), "--to", "geojson", "-o", str(out)]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_trajectories_of_a_run_are_files_of_a_folder(survey: Path, tmp_path: Path, capsys):
    shutil.copytree(survey.parent / "journeys", tmp_path / "run" / "journeys")
    assert main(["export", str(tmp_path / "run"), "--to", "tum"]) == 0
    (file,) = (tmp_path / "run.tum").iterdir()
    assert file.name == "journey-000.tum"
    assert "1 journeys" in capsys.readouterr().out
    assert "--overwrite" in failure(capsys, tmp_path / "run", "--to", "tum")
    assert "expected a RUN" in failure(capsys, survey, "--to", "kitti", "-o", tmp_path / "k")
    assert not (tmp_path / "k").exists()
