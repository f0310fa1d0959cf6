"""The main job, called as the command line does."""

from __future__ import annotations

import shutil
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


@pytest.fixture
def copy(tiny_folder: Path, tmp_path: Path) -> Path:
    """A data set, to be spoilt."""
    return Path(shutil.copytree(tiny_folder, tmp_path / "dataset"))


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three drives that are mapped in a second."""
    from worlds.drives import write_tiny

    return write_tiny(tmp_path_factory.mktemp("small") / "dataset", frame_rate_hz=3.0, length_m=60)


@pytest.fixture(scope="session")
def rough(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configuration that takes few steps."""
    from worlds.runs import ROUGH

    path = tmp_path_factory.mktemp("config") / "rough.yaml"
    path.write_text(ROUGH)
    return path
