"""`crowdmap check` as a person calls it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from crowdmap_torch.cli import main
from crowdmap_torch.soak.spoiled import spoiled


def check(*arguments: object) -> int:
    return main(["check", *map(str, arguments)])


def test_a_good_data_set_ends_with_0(winding_pair: Path, tmp_path: Path, capsys) -> None:
    new = tmp_path / "new"
    assert check(winding_pair, "--fix", new) == 0
    said = capsys.readouterr()
    assert "2 journeys can be used" in said.out and not said.err
    assert f"nothing to put right: {new} is not written" in said.out and not new.exists()


def test_findings_are_told_with_their_cures_written_and_put_right(
    winding_pair: Path, tmp_path: Path, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("crowdmap_torch.report.check.MOST_JOURNEYS", 0)
    bad = spoiled(winding_pair, tmp_path / "bad", "centimetres-high")
    report, page, new = (tmp_path / name for name in ("found.json", "found.html", "new"))
    assert check(bad, "--json", report) == 4
    said = capsys.readouterr()
    assert "likely cause: road.height_m is in centimetres" in said.out
    assert "[--fix does it]" in said.out and said.err.count("\n") == 1
    (finding,) = [f for f in json.loads(report.read_text())["findings"] if f["severity"] != "note"]
    assert (finding["kind"], finding["severity"], finding["fix"]) == (
        "camera-height",
        "spoils",
        True,
    )
    assert finding["codes"] == []
    assert len(finding["journeys"]) == 2 and finding["cure"]

    assert check(bad, "--json", report, "--html", page, "--fix", new) == 0
    said = capsys.readouterr()
    assert "road.height_m times 0.01" in said.out and not said.err
    fix = json.loads(report.read_text())["fix"]
    assert fix["is_sound"] and fix["dataset"] == str(new) and len(fix["changes"]) == 1
    assert "road.height_m is in centimetres" in page.read_text()


@pytest.mark.parametrize("option", ["--json", "--html", "--fix"])
def test_nothing_is_written_into_the_data_set(tiny_folder: Path, option: str, capsys) -> None:
    before = sorted(tiny_folder.rglob("*"))
    assert check(tiny_folder, option, tiny_folder / "out") == 2
    assert "choose" in capsys.readouterr().err
    assert sorted(tiny_folder.rglob("*")) == before


def test_a_folder_that_is_none_is_one_line_and_exit_code_2(tmp_path: Path, capsys) -> None:
    assert check(tmp_path / "none") == 2
    said = capsys.readouterr().err
    assert said.startswith("crowdmap check: ") and said.count("\n") == 1


def test_a_data_set_without_a_journey_that_can_be_used_is_still_told(
    tmp_path: Path, capsys
) -> None:
    (tmp_path / "data" / "journeys" / "one").mkdir(parents=True)
    page = tmp_path / "page.html"
    assert check(tmp_path / "data", "--html", page) == 4
    out = capsys.readouterr().out
    assert "0 journeys can be used, 1 have files that are refused" in out
    for name in ("dataset.json", "one/journey.json", "poses.parquet", "lanes.parquet"):
        assert name in out
    assert page.exists()
