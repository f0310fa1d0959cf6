from __future__ import annotations

import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from crowdmap_torch.cli import main


def simulate(*arguments: object) -> int:
    return main(["simulate", *map(str, arguments)])


def test_every_number_of_a_preset_is_an_option(tmp_path: Path, capsys):
    out = tmp_path / "data"
    options = "--world street --length-m 100 --journeys 2 --bias-e-m 7 --no-sigmas --missed 0.5"
    assert simulate(out, *options.split(), "--bad-drives", "jump") == 0
    assert "2 journeys" in capsys.readouterr().out
    settings = json.loads((out / "survey" / "map.json").read_text())["provenance"]["settings"]
    assert settings["positioning"]["bias_e_m"] == 7 and not settings["positioning"]["sigmas"]
    assert settings["world"]["length_m"] == 100 and settings["signs"]["missed"] == 0.5
    bad = json.loads((out / "survey" / "truth" / "bad_drives.json").read_text())
    assert list(bad.values()) == ["jump"]
    poses = pq.read_table(out / "journeys" / "journey-000" / "poses.parquet")
    assert "sigma_e" not in poses.column_names


def test_errors_of_real_fleets_are_a_preset_whose_numbers_are_options(tmp_path: Path):
    out = tmp_path / "data"
    options = "--world street --length-m 100 --journeys 2 --frame-rate-hz 5 --errors mounts,clocks"
    assert simulate(out, *options.split(), "--error-factor", 2, "--clock-error-s", 0.001) == 0
    settings = json.loads((out / "survey" / "map.json").read_text())["provenance"]["settings"]
    assert settings["fleet"]["mount_error_deg"] == 0.4 and settings["fleet"]["vehicles"] == 8
    assert settings["fleet"]["clock_error_s"] == 0.001 and settings["fleet"]["focal_error"] == 0
    vehicles = json.loads((out / "survey" / "truth" / "vehicles.json").read_text())
    assert len(vehicles) == 8 and vehicles["vehicle-a"]["clock_s"] != 0


@pytest.mark.parametrize(
    "options",
    [
        ["--journeys", "0"],
        ["--seed", "9" * 5000],
        ["--seed", "-1"],
        ["--length-m", "nan"],
        ["--pixel-noise-px", "inf"],
        ["--frame-rate-hz", "0"],
        ["--range-m", "80", "12"],
        ["--bad-drives", "flat-tyre"],
        ["--errors", "rust"],
        ["--clock-error-s", "2"],
        ["--camera", "lomo"],
    ],
    ids=lambda options: " ".join(options)[:30],
)
def test_wrong_options_are_one_line_and_exit_code_2(tmp_path: Path, capsys, options):
    try:
        code = simulate(tmp_path / "data", "--world", "street", *options)
    except SystemExit as ended:
        code = ended.code
    assert code == 2
    error = capsys.readouterr().err
    assert error.startswith("crowdmap simulate: ") and error.count("\n") == 1
    assert not (tmp_path / "data").exists()


def test_existing_output_is_refused(tmp_path: Path, capsys):
    (tmp_path / "data").mkdir()
    assert simulate(tmp_path / "data", "--world", "street") == 2
    assert "--overwrite" in capsys.readouterr().err
