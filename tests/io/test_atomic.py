"""Files and folders are complete or not there."""

from __future__ import annotations

from pathlib import Path

import pytest

from crowdmap_torch.io.atomic import atomic_file, atomic_folder, drop_halves, scratch_folder


class InterruptedWriteError(Exception):
    """What stops the writing half way."""


def test_a_file_appears_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "new" / "file"
    with atomic_file(path) as beside:
        beside.write_text("half")
        assert not path.exists()
    assert path.read_text() == "half"
    assert [p.name for p in path.parent.iterdir()] == ["file"]


def test_an_interrupted_file_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("old")
    with pytest.raises(InterruptedWriteError), atomic_file(path) as beside:
        beside.write_text("half")
        raise InterruptedWriteError
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_appears_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "new" / "map"
    with atomic_folder(path) as beside:
        (beside / "file").write_text("new")
        assert not path.exists()
    assert (path / "file").read_text() == "new"
    assert list(path.parent.iterdir()) == [path]


def test_a_new_folder_takes_the_place_of_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "map"
    path.mkdir()
    (path / "old").write_text("old")
    with atomic_folder(path) as beside:
        (beside / "new").write_text("new")
        assert (path / "old").read_text() == "old"
    assert [p.name for p in path.iterdir()] == ["new"]
    assert list(tmp_path.iterdir()) == [path]


def test_an_interrupted_folder_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "map"
    path.mkdir()
    (path / "old").write_text("old")
    with pytest.raises(InterruptedWriteError), atomic_folder(path) as beside:
        (beside / "new").write_text("half")
        raise InterruptedWriteError
    assert [p.name for p in path.iterdir()] == ["old"]
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_renaming_puts_the_old_folder_back(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "map"
    path.mkdir()
    (path / "old").write_text("old")
    rename = Path.rename

    def fail_for_the_new_one(self: Path, target: Path) -> Path:
        if self.name.endswith(".part"):
            raise OSError("no space left")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fail_for_the_new_one)
    with pytest.raises(OSError, match="no space left"), atomic_folder(path) as beside:
        (beside / "new").write_text("new")
    assert (path / "old").read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_is_replaced_and_what_it_names_is_left_alone(tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    kept.mkdir()
    (kept / "file").write_text("kept")
    link = tmp_path / "map"
    link.symlink_to(kept)
    with atomic_folder(link) as beside:
        (beside / "file").write_text("new")
    assert (link / "file").read_text() == "new"
    assert (kept / "file").read_text() == "kept"


@pytest.mark.parametrize("atomic", [atomic_file, atomic_folder])
def test_a_full_disk_names_the_file_that_it_was_written_to(tmp_path: Path, atomic) -> None:
    path = tmp_path / "map"
    with pytest.raises(OSError, match=r"No space left on device: '.*/map'$"), atomic(path):
        raise OSError(28, "No space left on device")
    assert list(tmp_path.iterdir()) == []


def test_a_scratch_folder_disappears_however_it_ends(tmp_path: Path) -> None:
    with scratch_folder(tmp_path / "new") as beside:
        (beside / "file").write_text("half")
        (beside / "file").rename(tmp_path / "kept")
    with pytest.raises(InterruptedWriteError), scratch_folder(tmp_path / "new") as beside:
        (beside / "file").write_text("half")
        raise InterruptedWriteError
    assert [p.name for p in tmp_path.iterdir()] == ["kept"]


def test_what_a_killed_writer_left_is_dropped_and_nothing_else(tmp_path: Path) -> None:
    inside = tmp_path / "inside"
    with atomic_file(inside / "file") as beside, atomic_folder(inside / "map") as folder:
        # As they stand at the moment of a kill.
        beside.touch()
        names = beside.name, folder.name
    strangers = [inside / name for name in ("notes.part", ".notes.part", ".file.abc.part")]
    for path in strangers:
        path.touch()
    (inside / names[0]).touch()
    (inside / names[1]).mkdir()
    (inside / names[1] / "signs.parquet").touch()
    drop_halves(tmp_path)
    assert set(inside.iterdir()) == {inside / "file", inside / "map", *strangers}
