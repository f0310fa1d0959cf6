from __future__ import annotations

from pathlib import Path

import pytest

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.parts import Asked
from crowdmap_torch.io.formats.importers import culane


def test_lines_of_a_folder_become_markers_of_images(tmp_path: Path):
    (tmp_path / "clip").mkdir()
    (tmp_path / "clip" / "00030.lines.txt").write_text("1 2 3 4 5 6 \n-7.5 8 9 10\n1 1\n")
    (tmp_path / "clip" / "00000.lines.txt").write_text("")
    parts = culane.read((tmp_path,), Asked())
    assert parts.lanes is not None
    assert parts.lanes.images == ("clip/00000.jpg", "clip/00030.jpg")
    assert (parts.lanes.image.tolist(), parts.lanes.count.tolist()) == ([1, 1], [3, 2])
    assert parts.lanes.px[3:].tolist() == [[-7.5, 8], [9, 10]]
    assert parts.notes == ("1 lane markers left out: with less than two points",)


def test_a_folder_with_a_mistake_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match=r"has no files NAME\.lines\.txt"):
        culane.read((tmp_path,), Asked())
    (tmp_path / "a.lines.txt").write_text("1 2\n1 2 3\n")
    with pytest.raises(InputError, match=r"a\.lines\.txt: line 2: 3 numbers; expected pairs u v"):
        culane.read((tmp_path,), Asked())
    (tmp_path / "a.lines.txt").write_text("1 x\n")
    with pytest.raises(InputError, match=r"line 1: v: expected a finite number, found 'x'"):
        culane.read((tmp_path,), Asked())
    with pytest.raises(InputError, match="a second source"):
        culane.read((tmp_path, tmp_path), Asked())
