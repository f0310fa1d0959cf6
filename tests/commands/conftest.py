"""The main job, called as the command line does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from worlds.runs import Said


@pytest.fixture
def optimize(capsys: pytest.CaptureFixture) -> Callable[..., Said]:
    """Maps a data set into a folder, one journey at a time."""
    from worlds.runs import Said

    from crowdmap_torch.cli import main

    def call(dataset: Path, out: Path, *options: str) -> Said:
        code = main(["optimize", str(dataset), "--out", str(out), "--workers", "1", *options])
        said = capsys.readouterr()
        return Said(code, said.out, said.err)

    return call
