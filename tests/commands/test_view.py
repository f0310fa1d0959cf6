from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

from crowdmap_torch.cli import main


def test_a_page_is_written_and_its_place_said(
    tiny_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "drives.html"
    assert main(["view", str(tiny_folder), "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"view: {out}\n"
    assert out.read_text("utf-8").startswith("<!doctype html>")
    assert main(["view", str(tiny_folder), "--out", str(out)]) == 2
    assert "exists; choose another name or give --overwrite" in capsys.readouterr().err
    assert main(["view", str(tiny_folder), "--out", str(out), "--overwrite"]) == 0


@pytest.mark.parametrize("name", ["missing", "survey/signs.parquet"])
def test_what_cannot_be_shown_is_one_line(
    tiny_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture, name: str
) -> None:
    assert main(["view", str(tiny_folder / name), "--out", str(tmp_path / "x.html")]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "is no map, run or data set" in err
    assert not (tmp_path / "x.html").exists()


def test_a_folder_is_no_page(
    tiny_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main(["view", str(tiny_folder), "--out", str(tmp_path)]) == 2
    assert "a folder; expected the name of a file" in capsys.readouterr().err


def test_a_recording_asks_for_its_package_before_anything_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("rerun", "rerun.blueprint"):
        monkeypatch.setitem(sys.modules, name, None)
    assert main(["view", str(tmp_path / "missing"), "--rerun", str(tmp_path / "x.rrd")]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "pip install 'crowdmap_torch[rerun]'" in err
    (tmp_path / "x.rrd").touch()
    assert main(["view", str(tmp_path / "missing"), "--rerun", str(tmp_path / "x.rrd")]) == 2
    assert "x.rrd: exists; choose another name" in capsys.readouterr().err


@pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="rerun-sdk is not installed")
def test_a_recording_is_written_instead_of_the_page(
    tiny_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "drives.rrd"
    assert main(["view", str(tiny_folder), "--rerun", str(out)]) == 0
    assert capsys.readouterr().out == f"recording: {out}\n"
    assert [p.name for p in tmp_path.iterdir()] == ["drives.rrd"]
