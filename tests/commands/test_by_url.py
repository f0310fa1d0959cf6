"""Data sets are mapped and checked by their URLs as in their folders."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from worlds.object_store import object_store

from crowdmap_torch.cli import main
from crowdmap_torch.soak.spoiled import spoiled

if TYPE_CHECKING:
    from worlds.runs import Said


def test_the_map_is_the_same_and_the_run_keeps_the_url_without_its_keys(
    small: Path, rough: Path, tmp_path: Path, optimize: Callable[..., Said]
) -> None:
    assert optimize(small, tmp_path / "here", "--config", str(rough)).code == 0
    with object_store(small.parent) as (url, _):
        said = optimize(url.format(small.name), tmp_path / "there", "--config", str(rough))
    assert said.code == 0 and "secret" not in said.out + said.err
    for name in ("signs.parquet", "lanes.parquet"):
        one, other = (tmp_path / run / "map" / name for run in ("here", "there"))
        assert one.read_bytes() == other.read_bytes()
    place = json.loads((tmp_path / "there" / "run.json").read_text())["dataset"]
    assert place == f"s3://maps/{small.name}"
    figures = [
        json.loads((tmp_path / run / "metrics.json").read_text()) for run in ("here", "there")
    ]
    assert figures[0]["survey"] == figures[1]["survey"] is not None
    written = [path for path in (tmp_path / "there").rglob("*") if path.is_file()]
    assert not [path for path in written if b"secret" in path.read_bytes()]


def test_a_drive_that_is_set_aside_is_named_by_the_url(
    copy: Path, tmp_path: Path, optimize: Callable[..., Said]
) -> None:
    (copy / "journeys" / "journey-001" / "poses.parquet").unlink()
    said = optimize(f"local://{copy}", tmp_path / "run", "--strict")
    missing = f"local://{copy}/journeys/journey-001/poses.parquet: the file is missing"
    copying, refused = said.err.splitlines()
    assert said.code == 2 and copying == f"copying local://{copy}" and missing in refused
    said = optimize("local:///nowhere", tmp_path / "run", "--quiet")
    assert said.code == 2 and said.err.count("\n") == 1
    assert "local:///nowhere: the dataset's folder is missing" in said.err
    assert not (tmp_path / "run" / "map").exists()


def test_a_check_names_the_url_and_mends_a_copy(
    winding_pair: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    bad = spoiled(winding_pair, tmp_path / "bad", "centimetres-high")
    report, new = tmp_path / "found.json", tmp_path / "new"
    assert main(["check", f"local://{bad}", "--json", str(report)]) == 4
    said = capsys.readouterr()
    assert f"local://{bad}: 2 journeys can be used" in said.out
    assert f"local://{bad}: a finding stops or spoils a map" in said.err
    assert json.loads(report.read_text())["dataset"] == f"local://{bad}"
    before = {path: path.read_bytes() for path in bad.rglob("*") if path.is_file()}
    assert main(["check", f"local://{bad}", "--fix", str(new)]) == 0
    assert main(["check", str(new)]) == 0
    assert {path: path.read_bytes() for path in bad.rglob("*") if path.is_file()} == before
