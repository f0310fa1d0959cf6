"""A good data set, and the same with one of the usual mistakes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.plausibility.dataset import look_over
from crowdmap_torch.plausibility.finding import Finding
from crowdmap_torch.simulate.dataset import write_dataset
from crowdmap_torch.simulate.errors import ALL, with_errors
from crowdmap_torch.soak.spoiled import spoiled
from crowdmap_torch.soak.varied import winding_street

Look = Callable[[Path], dict[str, Finding]]


@pytest.fixture
def good(winding_pair: Path) -> Path:
    """Drives without a mistake, of vehicles that are as they say."""
    return winding_pair


@pytest.fixture(scope="session")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same by vehicles that have wrong what real ones have, twice as large."""
    folder = tmp_path_factory.mktemp("plausibility") / "fleet"
    write_dataset(with_errors(winding_street(journeys=2), (ALL,), 2.0), folder)
    return folder


@pytest.fixture
def look() -> Look:
    """What is found in a data set, by kind."""

    def find(folder: Path) -> dict[str, Finding]:
        config = MapperConfig()
        dataset = load_dataset(folder)
        found = look_over(folder, dataset, config.positioning, config.sign_association)
        return {finding.kind: finding for finding in found.findings}

    return find


@pytest.fixture
def spoil(good: Path, tmp_path: Path) -> Callable[[str], Path]:
    """A copy of the good data set with a mistake."""
    return lambda mistake: spoiled(good, tmp_path / mistake, mistake)
