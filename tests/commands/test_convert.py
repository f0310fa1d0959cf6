from __future__ import annotations

import re
import shlex
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from examples import own_data
from worlds import foreign

from crowdmap_torch.cli import main
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.formats.composing import registry

PAGE = Path(__file__).parents[2] / "docs" / "OWN_DATA.md"


def test_the_tutorials_commands_lead_to_a_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    page = PAGE.read_text(encoding="utf-8")
    (table,) = re.findall(r"^```csv\n(.*?)^```", page, flags=re.M | re.S)
    monkeypatch.chdir(tmp_path)
    figures = ""
    for line in re.findall(r"^\$ (.+)$", page, flags=re.M):
        name, *arguments = shlex.split(line)
        if name == "python":
            assert arguments[0] == "docs/examples/own_data.py"
            own_data.main(*map(Path, arguments[1:]))
            Path("FILES/names.csv").write_text(table)
        elif "geopackage" in arguments and find_spec("pyogrio") is None:
            continue
        else:
            assert name == "crowdmap" and main(arguments) == 0, capsys.readouterr().err
            if arguments[0] == "evaluate":
                figures = capsys.readouterr().out
    assert Path("street.osm").stat().st_size > 10_000
    # Nothing was lost on the way: what was detected is what was simulated.
    made, simulated = load_dataset("DATA"), load_dataset("STREET")
    for one, other in zip(made.journeys, simulated.journeys, strict=True):
        np.testing.assert_allclose(one.T_world_camera, other.T_world_camera, atol=1e-6)
        assert (one.t_ns - other.t_ns).abs().max() == 0
        np.testing.assert_allclose(one.signs.corners_px, other.signs.corners_px, atol=1e-3)
        assert (one.signs.shape == other.signs.shape).all()
        assert len(one.lanes) == len(other.lanes)
    figures = figures.rpartition("Signs")[2]
    assert re.search(r"recall +100\.0 %\n +precision +100\.0 %", figures)
    assert re.search(r"pair precision +100\.0 %", figures)


def test_the_tutorial_lists_every_format():
    rows = re.findall(
        r"^\| `([\w-]+)` \| (.+?) \| .+ \| (.+?) \|$", PAGE.read_text("utf-8"), flags=re.M
    )
    listed = {name: (gives, tested) for name, gives, tested in rows if "-" not in name[:1]}
    for name in registry.OWN:
        importer = registry.find(name)
        assert listed.get(name) == (", ".join(importer.gives), importer.tested_on), name
    assert set(listed) == set(registry.OWN)


def test_formats_are_listed(capsys: pytest.CaptureFixture[str]):
    assert main(["convert", "--formats"]) == 0
    said = capsys.readouterr().out
    assert all(re.search(rf"^{name} ", said, flags=re.M) for name in registry.OWN)


def test_counts_and_sizes_are_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "names.csv").write_text(
        "name,shape,width_m,height_m\nregulatory--stop--g1,octagon,0.9,0.9\n"
    )
    content = foreign.coco()
    # Crossing itself: the format's own rules leave it out.
    content["categories"][1]["name"] = "rectangle"
    content["annotations"][1]["keypoints"] = [10, 10, 2, 50, 50, 2, 50, 10, 2, 10, 40, 2]
    sources = [
        *("--from", "tum", foreign.write_tum(tmp_path / "drive.txt")),
        *("--from", "coco", foreign.write_json(tmp_path / "signs.json", content)),
    ]
    said = ["--world", "enu", "--axes", "camera", "--images", "number", "--origin", "1", "2", "3"]
    rig = foreign.write_rig(tmp_path / "car")
    out = tmp_path / "DATA"
    call = ["convert", *sources, *said, "--rig", rig, "--out", out]
    code = main([*map(str, call), "--sign-names", str(tmp_path / "names.csv")])
    assert code == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{out}: journey 'drive' with 6 frames, 1 signs, 0 lane markers"
    assert "  1 left out by FORMAT.md's rules: sign: crosses itself" in lines
    assert lines[-1].endswith("adjust: {size_classes_m: [[0.9, 0.9]]}")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "expected --from FORMAT SOURCE ... and --out DATASET"),
        (["--from", "tum", "--out", "OUT"], "--from tum: expected a file or a folder"),
        (["--from", "tum", "none.txt", "--out", "OUT"], "none.txt: the file is missing"),
        (["--from", "mut", ".", "--out", "OUT"], "format 'mut' is unknown"),
        (["--from", "tum", "OUT/a", "--out", "OUT"], "OUT/a: a source inside OUT"),
        (["--from", "tum", "a", "--out", "NEW", "--add"], "NEW/dataset.json: the file is missing"),
    ],
)
def test_a_call_with_a_mistake_is_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    expected: str,
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "OUT").mkdir()
    for path in ("OUT/a", "a"):
        (tmp_path / path).write_text("")
    assert main(["convert", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("crowdmap convert: ") and error.count("\n") == 1
    assert expected in error
