"""How much is simulated: the whole study, or a quick look."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import TypeVar

from crowdmap_torch.simulate.dataset import SimulationConfig
from crowdmap_torch.simulate.fleet import FleetConfig
from crowdmap_torch.simulate.positioning import POSITIONING_PRESETS
from crowdmap_torch.simulate.rigs import RigConfig
from crowdmap_torch.simulate.roads import RoadShape
from crowdmap_torch.simulate.vehicle import VehicleConfig
from crowdmap_torch.simulate.worlds import WORLD_PRESETS, WorldConfig

K = TypeVar("K")
SHORT_TURNS = 4
"""Turns between the seeds of studies on the short road: many maps of little weight, which wait for the first seeds of
the others."""


@dataclass(frozen=True)
class Scale:
    """Roads, numbers of journeys and seeds of the studies."""

    road: WorldConfig = field(default_factory=lambda: WORLD_PRESETS["suburb"])
    """Where the paper's figures are drawn."""
    short_road: WorldConfig = field(
        default_factory=lambda: replace(WORLD_PRESETS["suburb"], length_m=300.0)
    )
    """Where one thing after another is varied: many maps of it are made."""
    vehicle: VehicleConfig = field(default_factory=VehicleConfig)
    rig: RigConfig = field(default_factory=RigConfig)
    counts: tuple[int, ...] = (1, 2, 5, 10, 15, 25, 50)
    """Numbers of journeys of a curve."""
    journeys: int = 25
    """The number that figures are compared at."""
    short_journeys: int = 8
    """Journeys on the short road."""
    seeds: int = 10
    """Worlds and fleets at `journeys`."""
    curve_seeds: int = 5
    """Those of them that fewer journeys are mapped of."""
    most_seeds: int = 2
    """Those that more journeys are mapped of."""
    preset_seeds: int = 20
    """On which a positioning preset is judged."""
    other_preset_seeds: int = 5
    """For each of the presets beside it."""
    short_seeds: int = 3
    """On the short road."""
    honest_journeys: int = 10
    """Journeys on the short road whose map's covariances are judged."""
    honest_sets: int = 60
    """Data sets of them."""
    fleet_road: WorldConfig = field(
        default_factory=lambda: replace(WORLD_PRESETS["suburb"], length_m=400.0)
    )
    """Where real fleets' errors are looked at one by one."""
    straight_road: WorldConfig = field(default_factory=lambda: WORLD_PRESETS["motorway"])
    """Where little of them can be seen."""
    fleet_journeys: int = 10
    """Journeys on either."""
    fleet_vehicles: int = 4
    """That drive them in turn."""
    fleet_seeds: int = 3
    fleet_sets: int = 20
    """Seeds of theirs on which it is judged whether maps of drives with all errors know how wrong they are."""
    whole_fleet_seeds: int = 5
    """Seeds at `journeys` that are driven by a fleet with all errors."""
    fleet_factors: int = 2
    """How many of their sizes."""
    long_lengths_m: tuple[float, ...] = (1000.0, 20000.0)
    """Drives whose bias wanders, short and long."""
    long_share: float = 1.0
    """Of shorter drives as many maps are made as there is way in a long one, times this."""
    long_journeys: int = 5
    series_lengths_m: tuple[float, ...] = (
        1000.0,
        2000.0,
        5000.0,
        10000.0,
        20000.0,
        50000.0,
        100000.0,
    )
    """One drive, longer and longer."""
    linear_sets: int = 8
    """Those of them that the linear estimator is given too."""
    draws: int = 3
    """Most maps of one or two journeys of a dataset, other journeys each time."""
    noise_steps: int = 3
    """Steps of each sweep, beside the default."""
    kinds: int | None = None
    """Errors of fleets, bad drives, worse inputs and ideas of ours that a study takes one after another; None: all."""

    def drives(self, seed: int, *, positioning: str = "paper", lanes: bool = True):
        """The drives on the road; without `lanes` nothing but signs was detected, the same as with them."""
        most = max(self.counts) if seed < self.most_seeds else self.journeys
        simulation = SimulationConfig(
            world=self.road,
            vehicle=self.vehicle,
            rig=self.rig,
            positioning=POSITIONING_PRESETS[positioning],
            journeys=most,
            seed=seed,
        )
        return simulation if lanes else without_lanes(simulation)

    def first(self, kinds: Iterable[K], *, beside: int = 0) -> list[K]:
        """The kinds that a study takes, and before them so many that it holds them beside."""
        return list(islice(kinds, None if self.kinds is None else beside + self.kinds))

    def short_drives(self, seed: int) -> SimulationConfig:
        """The drives on the short road."""
        return SimulationConfig(
            world=self.short_road,
            vehicle=self.vehicle,
            rig=self.rig,
            journeys=self.short_journeys,
            seed=seed,
        )

    def fleet_drives(self, seed: int, *, straight: bool = False) -> SimulationConfig:
        """Drives of a few vehicles that come back, which get nothing wrong as yet."""
        return SimulationConfig(
            world=self.straight_road if straight else self.fleet_road,
            vehicle=self.vehicle,
            rig=self.rig,
            fleet=FleetConfig(vehicles=self.fleet_vehicles),
            journeys=self.fleet_journeys,
            seed=seed,
        )

    def long_drives(self, length_m: float, seed: int) -> SimulationConfig:
        """Drives of such a length whose bias wanders by a metre over three kilometres; of signs alone."""
        simulation = SimulationConfig(
            world=replace(self.road, length_m=length_m),
            vehicle=self.vehicle,
            rig=self.rig,
            positioning=replace(POSITIONING_PRESETS["paper"], bias_wander_m=1.0),
            journeys=self.long_journeys,
            seed=seed,
        )
        return without_lanes(simulation)


def without_lanes(simulation: SimulationConfig) -> SimulationConfig:
    """The same drives, their lane detector switched off."""
    return replace(simulation, lanes=replace(simulation.lanes, max_lanes=0))


FULL = Scale()
_HOUSES = replace(
    WORLD_PRESETS["street"],
    length_m=100.0,
    lights_per_km=0.0,
    signs=replace(WORLD_PRESETS["street"].signs, posts_per_km=60.0),
)
_FEWER = replace(_HOUSES, length_m=60.0)
QUICK = Scale(
    road=_HOUSES,
    short_road=_FEWER,
    vehicle=VehicleConfig(frame_rate_hz=5.0),
    rig=RigConfig(camera="pinhole"),
    counts=(1, 3),
    journeys=3,
    short_journeys=2,
    seeds=1,
    curve_seeds=1,
    most_seeds=0,
    preset_seeds=1,
    other_preset_seeds=1,
    short_seeds=1,
    honest_journeys=3,
    honest_sets=1,
    fleet_road=_FEWER,
    straight_road=replace(_FEWER, road=RoadShape(heading_deg=0.0, grade=0.0, bank_deg=0.0)),
    fleet_journeys=2,
    fleet_vehicles=2,
    fleet_seeds=1,
    fleet_sets=1,
    whole_fleet_seeds=1,
    fleet_factors=1,
    long_lengths_m=(60.0, 120.0),
    long_share=0.1,
    long_journeys=2,
    series_lengths_m=(60.0, 120.0),
    linear_sets=1,
    draws=1,
    noise_steps=1,
    kinds=1,
)
"""A street of a few houses; its figures say that everything runs, nothing else."""
