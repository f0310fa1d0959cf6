from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.scale import QUICK
from crowdmap_torch.studies.study import Settings


@pytest.fixture
def settings() -> Settings:
    """The quick scale with two seeds, and all kinds, of everything."""
    seeds = ("seeds", "curve_seeds", "preset_seeds", "short_seeds", "honest_sets", "linear_sets")
    return Settings(replace(QUICK, kinds=None, **dict.fromkeys(seeds, 2)), None)


@pytest.fixture
def folder(tmp_path: Path) -> StudyFolder:
    """An empty one."""
    return StudyFolder(tmp_path / "study")
