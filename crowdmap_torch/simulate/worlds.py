"""Worlds to drive in: a road, its markers, its signs and its traffic lights."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from jaxtyping import Float

from crowdmap_torch.ranges import LengthOrNone, Range, Rate, Settings, Span, Speed
from crowdmap_torch.simulate.city import city_markers, city_signs
from crowdmap_torch.simulate.markers import Markers, Strip, lay_markers
from crowdmap_torch.simulate.recordings import Recording
from crowdmap_torch.simulate.roads import Road, RoadShape, block_road, open_road
from crowdmap_torch.simulate.routes import drive_route
from crowdmap_torch.simulate.signposts import SignConfig, WorldSigns, put_up_signs
from crowdmap_torch.simulate.street_grid import CityConfig, StreetGrid, street_grid
from crowdmap_torch.tables import Origin

ORIGIN = Origin(32.9, -117.2, 120.0)
"""Where worlds are that are no maps."""
RUN_IN_M = 40.0
"""An open road is this much longer than a drive: journeys start at differing stations."""


Lanes = Annotated[int, Range(0, 20, "lanes of a road")]


@dataclass(frozen=True)
class WorldConfig(Settings):
    """The kind of world: how long, how wide, how often."""

    name: str
    length_m: Annotated[float, Range(50, 1e6, "metres of a drive: 50 m to 1,000 km")] = 1000.0
    """Length of one drive; a block's circumference."""
    closed: bool = False
    road: RoadShape = field(default_factory=RoadShape)
    signs: SignConfig = field(default_factory=SignConfig)
    lane_width_m: Span = (3.3, 3.6)
    """Least and largest; one road has one width."""
    lanes_ahead: Lanes = 2
    """Lanes in the direction of the stations."""
    lanes_back: Lanes = 2
    """Lanes against it; none on one side of a divided highway."""
    dash_m: LengthOrNone = 4.0
    """Painted part of a dashed marker."""
    gap_m: LengthOrNone = 5.0
    lights_per_km: Rate = 2.0
    """Traffic lights, where cars may have to stop."""
    crossings_per_km: Rate = 0.0
    """Roads that cross, whose markers run square to ours."""
    exits_per_km: Rate = 0.0
    """Exits on the right: the edge marker splits off."""
    speed_mps: Speed = 12.0
    """Cruising speed of the cars there."""
    both_directions: bool = False
    """True: every second journey drives against the stations."""
    city: CityConfig = field(default_factory=CityConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.lanes_ahead < 1 or (self.both_directions and self.lanes_back < 1):
            raise ValueError("no lane to drive in: expected at least one in each driven direction")


CITY = WorldConfig(
    name="city",
    length_m=8000.0,
    road=RoadShape(grade=0.025, grade_wavelength_m=400),
    signs=SignConfig(posts_per_km=16.0, opposite_share=1.0),
    lights_per_km=2.0,
    speed_mps=11.0,
    city=CityConfig(square_m=4000.0),
)
"""Streets that cross on a square of 4 km; each drive takes a route of its own."""
WORLD_PRESETS: dict[str, WorldConfig] = {
    "street": WorldConfig(
        name="street",
        length_m=250.0,
        road=RoadShape(heading_deg=15, heading_wavelength_m=300, grade=0.01, bank_deg=1.0),
        signs=SignConfig(posts_per_km=36.0, opposite_share=0.2),
        lanes_back=1,
        lights_per_km=4.0,
        speed_mps=11.0,
    ),
    "suburb": WorldConfig(name="suburb"),
    "highway": WorldConfig(
        name="highway",
        road=RoadShape(
            heading_deg=12, heading_wavelength_m=1200, grade=0.015, grade_wavelength_m=800
        ),
        signs=SignConfig(
            posts_per_km=14.0, opposite_share=0.1, gantries_per_km=3.0, shared_share=0.15
        ),
        lane_width_m=(3.5, 3.7),
        lanes_ahead=3,
        lanes_back=0,
        lights_per_km=0.0,
        exits_per_km=1.0,
        speed_mps=25.0,
    ),
    "motorway": WorldConfig(
        name="motorway",
        road=RoadShape(heading_deg=0.0, grade=0.0, bank_deg=0.0),
        signs=SignConfig(
            posts_per_km=14.0, opposite_share=0.1, gantries_per_km=3.0, shared_share=0.15
        ),
        lane_width_m=(3.5, 3.7),
        lanes_ahead=3,
        lanes_back=0,
        lights_per_km=0.0,
        speed_mps=30.0,
    ),
    "hills": WorldConfig(
        name="hills",
        road=RoadShape(
            heading_deg=28,
            heading_wavelength_m=350,
            grade=0.06,
            grade_wavelength_m=260,
            bank_deg=4.0,
            bank_wavelength_m=200,
        ),
        signs=SignConfig(posts_per_km=28.0),
        lanes_ahead=1,
        lanes_back=1,
        lights_per_km=1.0,
    ),
    "block": WorldConfig(
        name="block",
        length_m=800.0,
        closed=True,
        road=RoadShape(grade=0.012, bank_deg=1.0),
        signs=SignConfig(posts_per_km=22.0, opposite_share=1.0, back_to_back_share=0.3),
        lanes_ahead=1,
        lanes_back=1,
        lights_per_km=5.0,
        speed_mps=9.0,
        both_directions=True,
    ),
}
"""Worlds of one road."""


@dataclass(frozen=True)
class World:
    """Everything that stays where it is."""

    config: WorldConfig
    road: Road
    markers: Markers
    signs: WorldSigns
    lane_centres: dict[int, tuple[float, ...]]
    """Offsets of the lanes' middles by direction of travel (1, -1), the innermost first."""
    lights: Float[np.ndarray, " l"]
    """Stations of the traffic lights."""
    origin: Origin = ORIGIN
    """Where it is on the earth."""
    recordings: tuple[Recording, ...] = ()
    """Drives that are driven again; none: cars drive along the road."""
    is_map: bool = False
    """Whether its markers are those of a map, which do not follow the stations."""
    streets: StreetGrid | None = None
    """Of a city, whose drives take routes of their own; `road` and `lights` are those of one."""


def build_world(config: WorldConfig, rng: np.random.Generator) -> World:
    """The world of a configuration and a seed."""
    width = rng.uniform(*config.lane_width_m)
    if config.city.square_m:
        return _city(config, width, rng)
    if config.closed:
        road = block_road(config.road, config.length_m, rng)
        signs_from, signs_to = 0.0, road.length
    else:
        road = open_road(config.road, config.length_m + RUN_IN_M + 60.0, rng)
        signs_from, signs_to = 15.0, config.length_m + 15.0
    # Offsets of a divided road count from the middle of its lanes, others from the double line.
    middle = 0.0 if config.lanes_back else config.lanes_ahead * width / 2
    centres = {1: tuple(middle - width * (k + 0.5) for k in range(config.lanes_ahead))}
    if config.lanes_back:
        centres[-1] = tuple(width * (k + 0.5) for k in range(config.lanes_back))
    right = middle - width * config.lanes_ahead
    left = middle + width * config.lanes_back
    lights = _spread(config.lights_per_km, road, rng, margin=0.12)
    crossings = _spread(config.crossings_per_km, road, rng, margin=0.2)
    strips = _strips(config, road, width, middle, crossings, rng)
    return World(
        config=replace(config, length_m=road.length if config.closed else config.length_m),
        road=road,
        markers=lay_markers(road, strips, dash_m=config.dash_m, gap_m=config.gap_m),
        signs=put_up_signs(
            road,
            config.signs,
            rng,
            stations=(signs_from, signs_to),
            edges=(right, left),
            lane_centres=centres,
        ),
        lane_centres=centres,
        lights=lights,
    )


def _city(config: WorldConfig, width: float, rng: np.random.Generator) -> World:
    ground_rng, sign_rng, route_rng = rng.spawn(3)
    grid = street_grid(
        config.city,
        config.road,
        ground_rng,
        lane_width=width,
        lanes=config.lanes_ahead,
        lights_per_km=config.lights_per_km,
    )
    first = drive_route(grid, config.length_m, route_rng, changes_per_km=0.0)
    return World(
        config=config,
        road=first.road,
        markers=city_markers(grid, dash_m=config.dash_m, gap_m=config.gap_m),
        signs=city_signs(grid, config.signs, sign_rng),
        lane_centres={1: (0.0,)},
        lights=first.lights,
        streets=grid,
    )


def on_route(world: World, rng: np.random.Generator, *, changes_per_km: float) -> World:
    """A city as one drive passes it: along a route of its own; any other world as it is."""
    if world.streets is None:
        return world
    length = world.config.length_m + RUN_IN_M + 60.0
    route = drive_route(world.streets, length, rng, changes_per_km=changes_per_km)
    return replace(world, road=route.road, lights=route.lights)


def _strips(
    config: WorldConfig,
    road: Road,
    width: float,
    middle: float,
    crossings: Float[np.ndarray, " c"],
    rng: np.random.Generator,
) -> list[Strip]:
    """The markers of a road's cross-section, interrupted where other roads cross."""
    section = [(middle, "double" if config.lanes_back else "solid", False)]
    for lanes, side in ((config.lanes_ahead, -1), (config.lanes_back, 1)):
        for k in range(1, lanes + 1):
            edge = "curb" if config.speed_mps < 20 and side == 1 else "solid"
            kind = "dashed" if k < lanes else edge
            section.append((middle + side * k * width, kind, side == 1))
    half_gap = 7.0
    cuts = [0.0, *(c + e for c in crossings for e in (-half_gap, half_gap)), road.length]
    strips = []
    for offset, kind, is_oncoming in section:
        for first, last in zip(cuts[::2], cuts[1::2], strict=True):
            strips.append(Strip(kind, (first, last), offset, is_oncoming=is_oncoming))
    outer = [offset for offset, _, _ in section]
    for crossing in crossings:
        for side, lanes in ((-1, config.lanes_ahead), (1, config.lanes_back)):
            # A stop line across the lanes that lead to the crossing.
            place = crossing + side * (half_gap - 0.5)
            if lanes:
                across = middle + side * lanes * width
                strips.append(Strip("solid", (place, place), middle, across, crosses=True))
        for shift, kind in ((-3.5, "solid"), (0.0, "dashed"), (3.5, "solid")):
            for side, edge in ((-1, min(outer)), (1, max(outer))):
                start = edge + side * 4.0
                strips.append(
                    Strip(
                        kind,
                        (crossing + shift, crossing + shift),
                        start,
                        start + side * 20.0,
                        crosses=True,
                    )
                )
    for exit_station in _spread(config.exits_per_km, road, rng, margin=0.25):
        edge = min(outer)
        strips.append(Strip("solid", (exit_station, exit_station + 120.0), edge - 0.35, edge - 9.0))
    return strips


def _spread(
    per_km: float, road: Road, rng: np.random.Generator, *, margin: float
) -> Float[np.ndarray, " c"]:
    """Stations spread along the road, away from its ends by a share of its length."""
    count = round(per_km * road.length / 1000)
    spacing = (1 - 2 * margin) / max(count, 1)
    places = margin + spacing * (np.arange(count) + rng.uniform(0.2, 0.8, count))
    return np.sort(places * road.length)
