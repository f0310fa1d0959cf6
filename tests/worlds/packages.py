"""Small packages with entry points, as if pip had installed them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

Bring = Callable[[str, str, str, str], None]
"""Installs a module `their_formats` of a text, with one entry point: group, name, target, text."""


@contextmanager
def bringing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bring]:
    def install(group: str, name: str, target: str, module: str) -> None:
        (folder / "their_formats.py").write_text(module)
        info = folder / "their_formats-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: their-formats\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[{group}]\n{name} = {target}\n")
        monkeypatch.syspath_prepend(folder)

    yield install
    sys.modules.pop("their_formats", None)
