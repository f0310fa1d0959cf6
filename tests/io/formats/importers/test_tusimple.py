from __future__ import annotations

from pathlib import Path

import pytest
from worlds import foreign

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.parts import Asked
from crowdmap_torch.io.formats.importers import tusimple


def test_columns_at_rows_become_points(tmp_path: Path):
    path = foreign.write_tusimple(tmp_path / "lanes.json")
    lanes = tusimple.read((path,), Asked()).lanes
    assert lanes is not None
    assert lanes.images == foreign.IMAGES
    assert (lanes.image.tolist(), lanes.count.tolist()) == ([0], [2])
    assert lanes.px.tolist() == [[300, 420], [290.5, 440]]
    shifted = tusimple.read((path,), Asked(pixel_origin="corner")).lanes
    assert shifted is not None and shifted.px.tolist() == [[299.5, 419.5], [290, 439.5]]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{", "line 1: cannot be read as JSON"),
        ("[]", "line 1: expected a mapping"),
        ('{"lanes": []}', "line 1.raw_file: is missing"),
        (
            '{"raw_file": "a", "h_samples": [1, 2], "lanes": [[1]]}',
            r"lanes\[0\]: 1 values for 2 rows",
        ),
        (
            '{"raw_file": "a", "h_samples": [1], "lanes": [["x"]]}',
            r"lanes\[0\]\[0\]: expected a number",
        ),
        ('{"raw_file": "a", "h_samples": [1], "lanes": 3}', "lanes: expected a list"),
        (
            '{"raw_file": "a", "h_samples": [], "lanes": []}\n' * 2,
            "line 2.raw_file: 'a' is there twice",
        ),
    ],
)
def test_a_file_with_a_mistake_is_refused(tmp_path: Path, text: str, expected: str):
    (tmp_path / "lanes.json").write_text(text)
    with pytest.raises(InputError, match=expected):
        tusimple.read((tmp_path / "lanes.json",), Asked())
