"""A good data set, and the same with one of the usual mistakes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from worlds.mistakes import spoiled

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.plausibility.dataset import look_over
from crowdmap_torch.plausibility.finding import Finding
from crowdmap_torch.simulate.dataset import SimulationConfig, write_dataset
from crowdmap_torch.simulate.errors import ALL, with_errors
from crowdmap_torch.simulate.vehicle import VehicleConfig
from crowdmap_torch.simulate.worlds import WORLD_PRESETS

Look = Callable[[Path], dict[str, Finding]]


def winding_street() -> SimulationConfig:
    """Four drives of a winding street, by cameras with mounts and without."""
    street = WORLD_PRESETS["street"]
    world = replace(
        street,
        length_m=150.0,
        lights_per_km=0.0,
        signs=replace(street.signs, posts_per_km=60.0),
        road=replace(street.road, heading_deg=40.0, heading_wavelength_m=150.0),
    )
    return SimulationConfig(world=world, vehicle=VehicleConfig(frame_rate_hz=10.0), journeys=4)


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Drives without a mistake, of vehicles that are as they say."""
    folder = tmp_path_factory.mktemp("plausibility") / "good"
    write_dataset(winding_street(), folder)
    return folder


@pytest.fixture(scope="session")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same by vehicles that have wrong what real ones have, twice as large."""
    folder = tmp_path_factory.mktemp("plausibility") / "fleet"
    write_dataset(with_errors(winding_street(), (ALL,), 2.0), folder)
    return folder


@pytest.fixture
def look() -> Look:
    """What is found in a data set, by kind."""

    def find(folder: Path) -> dict[str, Finding]:
        config = MapperConfig()
        dataset = load_dataset(folder)
        found = look_over(folder, dataset, config.positioning, config.sign_association)
        return {finding.kind: finding for finding in found}

    return find


@pytest.fixture
def spoil(good: Path, tmp_path: Path) -> Callable[[str], Path]:
    """A copy of the good data set with a mistake."""
    return lambda mistake: spoiled(good, tmp_path / mistake, mistake)
