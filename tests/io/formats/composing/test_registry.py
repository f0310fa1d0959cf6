from __future__ import annotations

from pathlib import Path

import pytest
from worlds.packages import Bring, bringing

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing import registry
from crowdmap_torch.io.formats.composing.parts import Importer


@pytest.fixture
def bring(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with bringing(tmp_path, monkeypatch) as install:
        yield install


THEIRS = """
from crowdmap_torch.io.formats.composing.parts import Importer, Parts
IMPORTER = Importer("theirs", ("poses",), "nothing", lambda sources, asked: Parts())
"""


def test_every_format_of_the_package_has_an_importer():
    for name in registry.OWN:
        importer = registry.find(name)
        assert isinstance(importer, Importer) and importer.gives, name
        assert importer.tested_on in ("real files", "small files after the published layout")


def test_other_packages_bring_formats(bring: Bring):
    bring(registry.GROUP, "their-log", "their_formats:IMPORTER", THEIRS)
    assert registry.names()[-1] == "their-log"
    assert registry.find("their-log").summary == "theirs"


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        ("their_formats:NOTHING", "cannot be loaded"),
        ("no_such_module:IMPORTER", "cannot be loaded"),
        ("their_formats:Parts", "is a type; expected a .*Importer"),
    ],
)
def test_formats_that_cannot_be_loaded_are_named(bring: Bring, target: str, expected: str):
    bring(registry.GROUP, "their-log", target, THEIRS)
    with pytest.raises(InputError, match=f"format 'their-log': .*{expected}"):
        registry.find("their-log")


def test_a_format_that_nobody_brings_is_named_with_those_that_there_are():
    with pytest.raises(InputError, match=r"format 'tmu' is unknown; expected one of .*tum"):
        registry.find("tmu")
