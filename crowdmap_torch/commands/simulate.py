"""Writes a simulated dataset with exact ground truth: `crowdmap simulate OUT --world suburb --seed 0`.

`--map` takes a map for the world: a map's or survey's folder, a file of Lanelet2 (.osm) or OpenDRIVE (.xodr), or a
dataset, whose survey is driven along with its own poses and rigs.
Every number of the presets is an option; `--help` lists them with their meaning.
"""

from __future__ import annotations

import argparse
import inspect
import sys
import time
import typing
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import numpy as np

from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.errors import input_read
from crowdmap_torch.io.formats.composing.map_files import map_of_file
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.ranges import Count, Factor, Seed, argument, field_texts, hints
from crowdmap_torch.simulate.dataset import DETECTION_PRESETS, SimulationConfig, write_dataset
from crowdmap_torch.simulate.errors import ALL, ERRORS, with_errors
from crowdmap_torch.simulate.faults import KINDS
from crowdmap_torch.simulate.fleet import FleetConfig
from crowdmap_torch.simulate.lane_perception import LaneDetectionConfig
from crowdmap_torch.simulate.map_worlds import map_world
from crowdmap_torch.simulate.positioning import POSITIONING_PRESETS, PositioningConfig
from crowdmap_torch.simulate.recordings import Recording, recordings
from crowdmap_torch.simulate.rigs import RigConfig
from crowdmap_torch.simulate.roads import RoadShape
from crowdmap_torch.simulate.sign_detections import SignDetectionConfig
from crowdmap_torch.simulate.signposts import SignConfig
from crowdmap_torch.simulate.street_grid import CityConfig
from crowdmap_torch.simulate.vehicle import VehicleConfig
from crowdmap_torch.simulate.worlds import CITY, WORLD_PRESETS, World, WorldConfig

_WORLDS = {**WORLD_PRESETS, CITY.name: CITY}
_GROUPS = {
    "world": WorldConfig,
    "road": RoadShape,
    "city": CityConfig,
    "roadside": SignConfig,
    "vehicle": VehicleConfig,
    "rig": RigConfig,
    "fleet": FleetConfig,
    "positioning": PositioningConfig,
    "signs": SignDetectionConfig,
    "lanes": LaneDetectionConfig,
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `crowdmap simulate` takes."""
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the dataset")
    parser.add_argument("--world", choices=sorted(_WORLDS), default="suburb")
    parser.add_argument(
        "--map",
        type=Path,
        metavar="MAP",
        help="the world is a map: a folder, a .osm or .xodr file, or a dataset with a survey, whose poses are driven again",
    )
    parser.add_argument("--journeys", type=argument(Count), default=25)
    parser.add_argument("--seed", type=argument(Seed), default=0)
    parser.add_argument(
        "--world-seed", type=argument(Seed), help="seed of the world alone, if not --seed"
    )
    parser.add_argument("--positioning", choices=sorted(POSITIONING_PRESETS), default="paper")
    parser.add_argument("--detection", choices=sorted(DETECTION_PRESETS), default="day")
    parser.add_argument(
        "--bad-drives",
        default="",
        metavar="KIND,...",
        help=f"spoils one journey for each: {', '.join(KINDS)}",
    )
    parser.add_argument(
        "--errors",
        default="",
        metavar="NAME,...",
        help=f"what real vehicles get wrong, at the size they do: {ALL} for all of {', '.join(ERRORS)}",
    )
    parser.add_argument(
        "--error-factor",
        type=argument(Factor),
        default=1.0,
        metavar="N",
        help="the errors of --errors are this many times as large",
    )
    parser.add_argument("--overwrite", action="store_true", help="replaces a dataset in OUT")
    for name, config in _GROUPS.items():
        group = parser.add_argument_group(name, inspect.getdoc(config))
        kinds, texts = hints(config), field_texts(config)
        for f in fields(config):
            if f.name == "name" or is_dataclass(kinds[f.name]):
                continue
            option = "--" + f.name.replace("_", "-")
            group.add_argument(
                option,
                dest=f"{name}.{f.name}",
                default=None,
                help=texts.get(f.name, "").replace("%", "%%") or None,
                **_kind(kinds[f.name]),
            )


def run(options: argparse.Namespace) -> None:
    """Writes the dataset into `options.out`."""
    with input_read():
        config = _configuration(options)
        begun = time.perf_counter()
        world = None if options.map is None else _map_world(options.map, config)
        built = write_dataset(
            config,
            options.out,
            world=world,
            overwrite=options.overwrite,
            on_journey=_progress(options.journeys),
        )
    print(
        f"{options.out}: {options.journeys} journeys, {len(built.signs)} signs, "
        f"{len(built.markers)} lane markers in {time.perf_counter() - begun:.1f} s"
    )


def _map_world(path: Path, config: SimulationConfig) -> World:
    """The world that a map is, with drives if it is the survey of a dataset."""
    rng = np.random.default_rng([config.seed if config.world_seed is None else config.world_seed])
    drives: tuple[Recording, ...] = ()
    if (path / "dataset.json").is_file():
        drives = recordings(load_dataset(path).journeys)
        path = path / "survey"
    hd_map = map_of_file(path) if path.is_file() else read_map(path)
    return map_world(
        hd_map,
        config.world.signs,
        rng,
        recordings=drives,
        dash_m=config.world.dash_m,
        gap_m=config.world.gap_m,
    )


def _configuration(options: argparse.Namespace) -> SimulationConfig:
    """The presets, with the errors that are asked for and all that options say of single numbers."""
    signs, lanes = DETECTION_PRESETS[options.detection]
    config = SimulationConfig(
        world=_WORLDS[options.world],
        positioning=POSITIONING_PRESETS[options.positioning],
        signs=signs,
        lanes=lanes,
        journeys=options.journeys,
        seed=options.seed,
        world_seed=options.world_seed,
        bad_drives=_named(options.bad_drives),
    )
    if errors := _named(options.errors):
        config = with_errors(config, errors, options.error_factor)
    world = config.world
    sections = ("vehicle", "rig", "fleet", "positioning", "signs", "lanes")
    return replace(
        config,
        world=_changed(
            world,
            options,
            "world",
            road=_changed(world.road, options, "road"),
            city=_changed(world.city, options, "city"),
            signs=_changed(world.signs, options, "roadside"),
        ),
        **{name: _changed(getattr(config, name), options, name) for name in sections},
    )


def _named(text: str) -> tuple[str, ...]:
    return tuple(name for name in text.split(",") if name)


def _kind(hint: object) -> dict:
    """How argparse reads a field of this type."""
    if hint is bool:
        return {"action": argparse.BooleanOptionalAction}
    if hint is str:
        return {"metavar": "TEXT"}
    inside = typing.get_args(hint)[0]
    if typing.get_origin(inside) is tuple:
        kinds = typing.get_args(inside)
        return {"type": argument(kinds[0]), "nargs": len(kinds), "metavar": ("LEAST", "MOST")}
    return {"type": argument(hint), "metavar": "N"}


def _changed(config, options: argparse.Namespace, group: str, **changes):
    """The configuration with what the command line says of it."""
    for f in fields(config):
        value = getattr(options, f"{group}.{f.name}", None)
        if value is not None:
            changes[f.name] = tuple(value) if isinstance(value, list) else value
    return replace(config, **changes)


def _progress(journeys: int):
    """A line that counts journeys on a terminal; nothing elsewhere."""
    if not sys.stderr.isatty():
        return lambda index: None

    def show(index: int) -> None:
        end = "\n" if index + 1 == journeys else ""
        print(f"\rjourney {index + 1}/{journeys}", end=end, file=sys.stderr, flush=True)

    return show
