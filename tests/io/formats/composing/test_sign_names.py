from __future__ import annotations

from pathlib import Path

import pytest

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.sign_names import SignName, read_sign_names
from crowdmap_torch.simulate.signposts import CODES, PANEL_CODES


def test_the_packages_table_knows_what_the_simulator_puts_up():
    names = read_sign_names()
    for shape, codes in (*CODES.items(), ("rectangle", PANEL_CODES)):
        for code in codes:
            assert names[code].shape == polygon.SHAPES.index(shape)
            assert names[code].code == code
    assert names["octagon"] == SignName(polygon.OCTAGON, None)
    assert names["regulatory--stop--g1"].code == "regulatory--stop--g1"
    assert names["regulatory--no-entry--g1"].shape is None


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("n.csv", "name,shape,code,width_m,height_m\nA,pentagon,US:S1-1,0.7,0.8\nB,none,,,\n"),
        (
            "n.yaml",
            "A: {shape: pentagon, code: 'US:S1-1', width_m: 0.7, height_m: 0.8}\nB: {shape: none}\n",
        ),
    ],
)
def test_a_users_table_adds_to_it_and_changes_it(tmp_path: Path, file: str, text: str):
    (tmp_path / file).write_text(text.replace("A", "octagon"))
    names = read_sign_names(tmp_path / file)
    assert names["octagon"] == SignName(polygon.PENTAGON, "US:S1-1", (0.7, 0.8))
    assert names["B"] == SignName(None, "B")
    assert names["diamond"].shape == polygon.DIAMOND


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("name,form\nA,octagon\n", "column 'form' is unknown"),
        ("name,code\nA,octagon\n", "column 'shape' is missing"),
        ("name,shape\nA,round\n", r"line 2: shape 'round' is unknown; expected one of triangle"),
        ("name,shape\nA,octagon\nA,octagon\n", "line 3: name 'A' is there twice"),
        ("name,shape,width_m\nA,octagon,1\n", "line 2: expected both width_m and height_m"),
        ("name,shape,width_m,height_m\nA,octagon,0,1\n", "width_m: expected metres above 0"),
    ],
)
def test_a_table_with_a_mistake_is_refused(tmp_path: Path, text: str, expected: str):
    (tmp_path / "n.csv").write_text(text)
    with pytest.raises(InputError, match=expected):
        read_sign_names(tmp_path / "n.csv")


def test_a_yaml_with_a_mistake_is_refused(tmp_path: Path):
    (tmp_path / "n.yaml").write_text("A: {shape: round}\n")
    with pytest.raises(InputError, match=r"n\.yaml: A\.shape: shape 'round' is unknown"):
        read_sign_names(tmp_path / "n.yaml")
