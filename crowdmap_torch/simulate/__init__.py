"""Worlds, vehicles and sensors with exact ground truth."""

from crowdmap_torch.simulate.dataset import (
    DETECTION_PRESETS,
    SimulatedJourney,
    SimulationConfig,
    make_fleet,
    make_journey,
    make_world,
    write_dataset,
)
from crowdmap_torch.simulate.positioning import PRESETS as POSITIONING_PRESETS
from crowdmap_torch.simulate.worlds import PRESETS as WORLD_PRESETS
from crowdmap_torch.simulate.worlds import World

__all__ = [
    "DETECTION_PRESETS",
    "POSITIONING_PRESETS",
    "WORLD_PRESETS",
    "SimulatedJourney",
    "SimulationConfig",
    "World",
    "make_fleet",
    "make_journey",
    "make_world",
    "write_dataset",
]
