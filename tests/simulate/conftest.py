from __future__ import annotations

from dataclasses import replace

import pytest

from crowdmap_torch.simulate.dataset import SimulationConfig, make_fleet, make_world
from crowdmap_torch.simulate.fleet import Vehicle
from crowdmap_torch.simulate.worlds import WORLD_PRESETS, World


@pytest.fixture(scope="session")
def suburb_config() -> SimulationConfig:
    return SimulationConfig(world=replace(WORLD_PRESETS["suburb"], length_m=500.0), journeys=2)


@pytest.fixture(scope="session")
def suburb(suburb_config: SimulationConfig) -> World:
    return make_world(suburb_config)


@pytest.fixture(scope="session")
def fleet(suburb_config: SimulationConfig) -> tuple[Vehicle, ...]:
    return make_fleet(suburb_config)
