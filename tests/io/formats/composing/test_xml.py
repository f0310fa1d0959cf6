from __future__ import annotations

from pathlib import Path

import pytest

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.xml import read_xml


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("<a>", "cannot be read as XML"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>", "has a DOCTYPE"),
        ("", "cannot be read as XML"),
    ],
)
def test_what_is_no_plain_xml_is_refused(tmp_path: Path, text: str, expected: str):
    (tmp_path / "a.xml").write_text(text)
    with pytest.raises(InputError, match=expected):
        read_xml(tmp_path / "a.xml")


def test_the_root_is_given(tmp_path: Path):
    (tmp_path / "a.xml").write_text("<a><b/></a>")
    assert [e.tag for e in read_xml(tmp_path / "a.xml").iter()] == ["a", "b"]
