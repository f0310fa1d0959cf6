from __future__ import annotations

from pathlib import Path

import pytest
from worlds.marked_roads import two_way_road
from worlds.packages import Bring, bringing

from crowdmap_torch.cli import main
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.exporters import export
from crowdmap_torch.io.maps import write_map

THEIRS = """
from crowdmap_torch.io.formats.exporters.export import Exporter, ExportFormat

def write(hd_map, path):
    path.write_text("\\n".join(hd_map.sign_id))
    return ("lanes: a list has no place for them",)

def fail(hd_map, path):
    path.write_text("half")
    raise OSError("the disk is full")

EXPORTER = Exporter(ExportFormat("sign list", ".list"), write)
FAILING = Exporter(ExportFormat("sign list", ".list"), fail)
"""


@pytest.fixture
def bring(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = tmp_path / "site"
    folder.mkdir()
    with bringing(folder, monkeypatch) as install:
        yield install


def test_other_packages_bring_formats(bring: Bring, tmp_path: Path, capsys):
    bring(export.GROUP, "sign-list", "their_formats:EXPORTER", THEIRS)
    assert export.names()[-1] == "sign-list"
    write_map(two_way_road(), tmp_path / "MAP")
    assert main(["export", str(tmp_path / "MAP"), "--to", "sign-list"]) == 0
    assert (tmp_path / "MAP.list").read_text().split() == ["sign-0", "sign-1", "sign-2", "sign-3"]
    said = capsys.readouterr().out
    assert said.startswith("sign list: ") and "left out: lanes: a list" in said


def test_a_format_of_another_package_leaves_nothing_half_written(bring: Bring, tmp_path: Path):
    bring(export.GROUP, "sign-list", "their_formats:FAILING", THEIRS)
    out = tmp_path / "signs.list"
    out.write_text("older")
    with pytest.raises(OSError, match="the disk is full"):
        export.export_map(two_way_road(), out, "sign-list")
    assert out.read_text() == "older"


def test_the_packages_own_formats_are_not_replaced(bring: Bring):
    bring(export.GROUP, "geojson", "their_formats:EXPORTER", THEIRS)
    assert export.form_of("geojson").title == "GeoJSON"
    assert export.names() == tuple(export.FORMATS)


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        ("their_formats:NOTHING", "cannot be loaded"),
        ("their_formats:write", "expected a .*Exporter"),
    ],
)
def test_formats_that_cannot_be_loaded_are_named(bring: Bring, target: str, expected: str):
    bring(export.GROUP, "sign-list", target, THEIRS)
    with pytest.raises(InputError, match=f"format 'sign-list': .*{expected}"):
        export.form_of("sign-list")
