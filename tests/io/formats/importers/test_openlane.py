from __future__ import annotations

from pathlib import Path

import pytest
from worlds import foreign

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.parts import Asked
from crowdmap_torch.io.formats.importers import openlane
from crowdmap_torch.tables import LANE_TYPES


def test_lines_of_each_image_become_markers_with_types(tmp_path: Path):
    lines = [
        {"category": category, "uv": [[300, 290.5], [420, 440]], "xyz": [[], [], []]}
        for category in (0, 1, 2, 10, 21)
    ]
    lines.append({"category": 1, "uv": [[300], [420]]})
    (tmp_path / "segment-1").mkdir()
    foreign.write_json(
        tmp_path / "segment-1" / "15.json",
        {
            "file_path": "training/segment-1/15.jpg",
            "lane_lines": lines,
            "extrinsic": [],
            "pose": [],
        },
    )
    parts = openlane.read((tmp_path,), Asked())
    assert parts.lanes is not None
    assert parts.lanes.images == ("training/segment-1/15.jpg",)
    names = [None if k < 0 else LANE_TYPES[k] for k in parts.lanes.type.tolist()]
    assert names == [None, "dashed", "solid", "double", "curb"]
    assert parts.lanes.px[:2].tolist() == [[300, 420], [290.5, 440]]
    assert len(parts.notes) == 1


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ({"file_path": "a", "lane_lines": {}}, "lane_lines: expected a list"),
        ({"lane_lines": []}, "file_path: is missing"),
        (
            {"file_path": "a", "lane_lines": [{"category": 1, "uv": [[1]]}]},
            r"lane_lines\[0\].uv: expected two",
        ),
        (
            {"file_path": "a", "lane_lines": [{"category": 1, "uv": [[1, 2], [1]]}]},
            r"lane_lines\[0\].uv: 2 columns and 1 rows",
        ),
        (
            {"file_path": "a", "lane_lines": [{"category": "x", "uv": []}]},
            "category: expected a whole",
        ),
    ],
)
def test_a_file_with_a_mistake_is_refused(tmp_path: Path, content: dict, expected: str):
    foreign.write_json(tmp_path / "a.json", content)
    with pytest.raises(InputError, match=expected):
        openlane.read((tmp_path,), Asked())


def test_images_come_once_and_there_is_one(tmp_path: Path):
    with pytest.raises(InputError, match="has no JSON files"):
        openlane.read((tmp_path,), Asked())
    for name in ("a", "b"):
        foreign.write_json(tmp_path / f"{name}.json", {"file_path": "same.jpg", "lane_lines": []})
    with pytest.raises(InputError, match=r"b\.json: file_path: 'same\.jpg' is that of another"):
        openlane.read((tmp_path,), Asked())
