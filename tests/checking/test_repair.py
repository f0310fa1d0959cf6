"""A data set put right: a new one, complete or not there, and checked again."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from crowdmap_torch.checking import repair
from crowdmap_torch.checking.changes import CHANGES
from crowdmap_torch.checking.check import Check, check_dataset
from crowdmap_torch.checking.repair import write_repaired
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.soak.mistakes import differences, is_near
from crowdmap_torch.soak.spoiled import MISTAKES
from crowdmap_torch.soak.verdict import digest


def test_mistakes_that_hide_one_another_are_put_right_in_rounds(
    winding_folder: Path, spoil, tmp_path: Path
) -> None:
    bad = spoil("unsorted")
    for mistake in ("w-x-y-z", "millimetres", "milliseconds", "row-by-row"):
        # Of a set that is refused the loader gives nothing, so what needs it comes first.
        if mistake == "millimetres":
            _scaled(bad, 1e3)
        else:
            MISTAKES[mistake].make(bad)
    before = digest(bad)
    mended = write_repaired(bad, tmp_path / "new", check_dataset(bad))
    assert mended.check.is_sound, mended.check.items
    assert len(mended.changes) == 5
    assert is_near(differences(winding_folder, tmp_path / "new"), "row-by-row")
    assert digest(bad) == before


def _scaled(folder: Path, factor: float) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    for path in folder.glob("journeys/*/poses.parquet"):
        table = pq.read_table(path)
        for name in "xyz":
            values = pa.array(table[name].to_numpy() * factor)
            table = table.set_column(table.column_names.index(name), name, values)
        pq.write_table(table, path)


def test_a_place_that_is_taken_or_inside_is_refused(spoil, tmp_path: Path) -> None:
    bad = spoil("w-x-y-z")
    check = check_dataset(bad)
    for place in (tmp_path, bad / "new", bad):
        with pytest.raises(InputError, match="--fix"):
            write_repaired(bad, place, check)


def test_nothing_is_left_of_a_repair_that_fails(
    spoil, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bad = spoil("normal-up")
    check = check_dataset(bad)

    def fails(task: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setitem(CHANGES, "turn-normal", fails)
    with pytest.raises(OSError, match="No space"):
        write_repaired(bad, tmp_path / "new", check)
    assert [path.name for path in tmp_path.iterdir()] == [bad.name]


def test_what_does_not_help_is_done_once(spoil, tmp_path: Path, monkeypatch) -> None:
    bad = spoil("normal-up")
    check, calls = check_dataset(bad), []
    monkeypatch.setitem(CHANGES, "turn-normal", lambda task: calls.append(task.journey))
    monkeypatch.setattr(repair, "check_dataset", lambda *_: check)
    mended = write_repaired(bad, tmp_path / "new", check)
    assert mended.changes == () and not mended.check.is_sound
    assert len(calls) == len(set(calls)) == 4


def test_every_repair_that_a_finding_asks_for_is_there() -> None:
    source = Path(repair.__file__).parents[1]
    named = set()
    for path in (*(source / "plausibility").glob("*.py"), *(source / "checking").glob("*.py")):
        text = path.read_text(encoding="utf-8")
        named |= {*re.findall(r'Repair\(\s*"([\w-]+)"', text)}
    assert named == CHANGES.keys()


def test_links_inside_a_data_set_stay_links(spoil, tmp_path: Path, monkeypatch) -> None:
    bad = spoil("w-x-y-z")
    monkeypatch.setattr(repair, "check_dataset", lambda *_: Check((), None, ()))
    poses = bad / "journeys" / "journey-000" / "lanes.parquet"
    shutil.move(poses, poses.with_name("kept.parquet"))
    poses.symlink_to("kept.parquet")
    write_repaired(bad, tmp_path / "new", check_dataset(bad))
    assert (tmp_path / "new" / poses.relative_to(bad)).is_symlink()
