"""A data set put right: a new one, complete or not there, and checked again."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from crowdmap_torch.checking import repair
from crowdmap_torch.checking.changes import CHANGES
from crowdmap_torch.checking.check import SPOILS, Check, Item, check_dataset
from crowdmap_torch.checking.repair import write_repaired
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.plausibility.finding import Repair
from crowdmap_torch.soak.mistakes import differences, grave, is_near
from crowdmap_torch.soak.spoiled import MISTAKES
from crowdmap_torch.soak.verdict import digest
from crowdmap_torch.tables import Dataset


def test_mistakes_that_hide_one_another_are_put_right_in_rounds(
    drives: Dataset, spoil, tmp_path: Path
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
    assert is_near(differences(drives, mended.check.dataset), "row-by-row")
    assert digest(bad) == before


def test_what_rounding_has_lost_is_told_and_not_taken_for_another_mistake(
    spoil, tmp_path: Path
) -> None:
    bad = spoil("rounded")
    mended = write_repaired(bad, tmp_path / "new", check_dataset(bad))
    assert grave(mended.check) == {"rounded-rotations"}


def test_tracks_that_a_writer_made_fractions_of_are_whole_again(
    drives: Dataset, winding_pair: Path, tmp_path: Path
) -> None:
    """As data frames have whole numbers of which one is unknown: NaN, and all of them double."""
    bad = Path(shutil.copytree(winding_pair, tmp_path / "bad"))
    for path in bad.glob("journeys/*/signs.parquet"):
        table = pq.read_table(path)
        track = np.arange(len(table), dtype=float)
        track[::3] = np.nan
        at = table.column_names.index("track")
        pq.write_table(table.set_column(at, "track", pa.array(track)), path)
    mended = write_repaired(bad, tmp_path / "new", check_dataset(bad))
    assert mended.check.is_sound, mended.check.items
    for path in (tmp_path / "new").glob("journeys/*/signs.parquet"):
        track = pq.read_table(path)["track"]
        assert track.type == pa.int64()
        known = np.arange(len(track)) % 3 > 0
        assert track.is_valid().to_pylist() == known.tolist()
        assert track.drop_null().to_pylist() == np.flatnonzero(known).tolist()
    assert is_near(differences(drives, mended.check.dataset), "row-by-row")


def _scaled(folder: Path, factor: float) -> None:
    for path in folder.glob("journeys/*/poses.parquet"):
        table = pq.read_table(path)
        for name in "xyz":
            values = pa.array(table[name].to_numpy() * factor)
            table = table.set_column(table.column_names.index(name), name, values)
        pq.write_table(table, path)


NORMALS = Item(SPOILS, "road-normal", "it points up", "upwards", "turn it round", repairs=tuple(
    (name, Repair("turn-normal")) for name in ("journey-000", "journey-001")
))  # fmt: skip
UPWARDS = Check((NORMALS,), None, ())


def test_a_place_that_is_taken_or_inside_is_refused(winding_pair: Path, tmp_path: Path) -> None:
    bad = Path(shutil.copytree(winding_pair, tmp_path / "bad"))
    for place in (tmp_path, bad / "new", bad):
        with pytest.raises(InputError, match="--fix"):
            write_repaired(bad, place, UPWARDS)


def test_nothing_is_left_of_a_repair_that_fails(
    winding_pair: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(task: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setitem(CHANGES, "turn-normal", fails)
    with pytest.raises(OSError, match="No space"):
        write_repaired(winding_pair, tmp_path / "new", UPWARDS)
    assert not [*tmp_path.iterdir()]


def test_what_does_not_help_is_done_once(winding_pair: Path, tmp_path: Path, monkeypatch) -> None:
    calls = []
    monkeypatch.setitem(CHANGES, "turn-normal", lambda task: calls.append(task.journey))
    monkeypatch.setattr(repair, "check_dataset", lambda *_: UPWARDS)
    mended = write_repaired(winding_pair, tmp_path / "new", UPWARDS)
    assert mended.changes == () and not mended.check.is_sound
    assert calls == ["journey-000", "journey-001"]


def test_every_repair_that_a_finding_asks_for_is_there() -> None:
    source = Path(repair.__file__).parents[1]
    named = set()
    for path in (*(source / "plausibility").glob("*.py"), *(source / "checking").glob("*.py")):
        text = path.read_text(encoding="utf-8")
        named |= {*re.findall(r'Repair\(\s*"([\w-]+)"', text)}
    assert named == CHANGES.keys()


def test_links_inside_a_data_set_stay_links(
    winding_pair: Path, tmp_path: Path, monkeypatch
) -> None:
    bad = Path(shutil.copytree(winding_pair, tmp_path / "bad"))
    monkeypatch.setattr(repair, "check_dataset", lambda *_: Check((), None, ()))
    poses = bad / "journeys" / "journey-000" / "lanes.parquet"
    shutil.move(poses, poses.with_name("kept.parquet"))
    poses.symlink_to("kept.parquet")
    write_repaired(bad, tmp_path / "new", UPWARDS)
    assert (tmp_path / "new" / poses.relative_to(bad)).is_symlink()
