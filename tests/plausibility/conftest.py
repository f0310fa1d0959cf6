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
from crowdmap_torch.simulate.vehicle import VehicleConfig
from crowdmap_torch.simulate.worlds import WORLD_PRESETS

Look = Callable[[Path], dict[str, Finding]]


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four drives of a winding street, by cameras with mounts and without."""
    street = WORLD_PRESETS["street"]
    world = replace(
        street,
        length_m=150.0,
        lights_per_km=0.0,
        signs=replace(street.signs, posts_per_km=60.0),
        road=replace(street.road, heading_deg=40.0, heading_wavelength_m=150.0),
    )
    config = SimulationConfig(world=world, vehicle=VehicleConfig(frame_rate_hz=10.0), journeys=4)
    folder = tmp_path_factory.mktemp("plausibility") / "good"
    write_dataset(config, folder)
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
