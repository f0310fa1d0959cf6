"""Everything that is wrong with a data set is named, and nothing else."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from crowdmap_torch.checking import repair
from crowdmap_torch.checking.check import NOTE, SPOILS, STOPS, Check, check_dataset
from crowdmap_torch.checking.repair import write_repaired
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.soak.mistakes import differences, grave, is_near, names
from crowdmap_torch.soak.spoiled import MISTAKES, spoiled
from crowdmap_torch.tables import Dataset


def test_a_good_data_set_has_nothing_that_stops_or_spoils_a_map(winding_folder: Path) -> None:
    check = check_dataset(winding_folder)
    assert check.is_sound and not grave(check)
    assert check.dataset is not None and len(check.dataset.journeys) == 4


OF_MANY = ("antenna", "no-lens")
"""Mistakes that two drives do not show; they are not put right."""


@pytest.mark.parametrize("name", ["kitti-00", "kitti-05", "kitti-06", "kitti-08"])
def test_real_drives_have_nothing_that_stops_or_spoils_a_map(
    real_data: Callable[[str], Path], name: str
) -> None:
    assert not grave(check_dataset(real_data(f"kitti-signs/{name}")))


@pytest.mark.parametrize("mistake", sorted(MISTAKES))
def test_a_mistake_is_named_by_its_cause_alone_and_put_right(
    winding_folder: Path,
    winding_pair: Path,
    drives: Dataset,
    mistake: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    good = winding_folder if mistake in OF_MANY else winding_pair
    bad = spoiled(good, tmp_path / "bad", mistake)
    check = check_dataset(bad)
    expected = MISTAKES[mistake]
    assert names(check, mistake), check.items
    has_repair = any(item.repairs for item in check.items)
    assert has_repair == expected.is_cured
    if not expected.is_cured:
        return
    # That what came of it is checked again has a test of its own.
    monkeypatch.setattr(repair, "check_dataset", lambda *_: Check((), None, ()))
    new = tmp_path / "new"
    mended = write_repaired(bad, new, check)
    assert mended.changes
    away = differences(drives, load_dataset(new))
    assert is_near(away, mistake), away


def test_three_broken_files_are_three_findings_with_all_their_rows(
    winding_folder: Path, tmp_path: Path, set_values
) -> None:
    bad = Path(shutil.copytree(winding_folder, tmp_path / "bad"))
    nan = float("nan")
    set_values(bad / "journeys/journey-000/poses.parquet", "x", {3: nan, 9: nan, 11: nan})
    set_values(bad / "journeys/journey-001/signs.parquet", "frame", {0: 10**6, 5: 10**6})
    (bad / "journeys/journey-002/lanes.parquet").unlink()
    check = check_dataset(bad)
    found = {i.file: (i.severity, i.kind, i.rows) for i in check.items if i.severity != NOTE}
    assert found == {
        "journeys/journey-000/poses.parquet": (STOPS, "not-finite", (3, 9, 11)),
        "journeys/journey-001/signs.parquet": (STOPS, "unknown-frame", (0, 5)),
        "journeys/journey-002/lanes.parquet": (STOPS, "missing", ()),
    }
    assert check.unseen == ("journey-000", "journey-001", "journey-002")
    assert check.items[0].place == "journeys/journey-000/poses.parquet, rows 3, 9, 11"


def test_mistakes_of_some_journeys_are_found_beside_files_that_are_refused(
    spoil, set_values
) -> None:
    bad = spoil("anticlockwise")
    set_values(bad / "journeys/journey-001/poses.parquet", "qw", {0: 2.0})
    check = check_dataset(bad)
    found = {(i.severity, i.kind): i.journeys for i in check.items if i.severity != NOTE}
    assert found == {
        (STOPS, "quaternion-length"): ("journey-001",),
        (SPOILS, "anticlockwise"): ("journey-000",),
    }
