"""Good data sets that differ: worlds, cameras, speeds, noise, errors of real vehicles, little data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from crowdmap_torch.simulate.dataset import DETECTION_PRESETS, SimulationConfig, write_dataset
from crowdmap_torch.simulate.errors import ALL, with_errors
from crowdmap_torch.simulate.positioning import POSITIONING_PRESETS
from crowdmap_torch.simulate.rigs import RigConfig
from crowdmap_torch.simulate.vehicle import VehicleConfig
from crowdmap_torch.simulate.worlds import WORLD_PRESETS


def winding_street(journeys: int = 4) -> SimulationConfig:
    """Drives of a winding street, by cameras with mounts and without."""
    street = WORLD_PRESETS["street"]
    world = replace(
        street,
        length_m=150.0,
        lights_per_km=0.0,
        signs=replace(street.signs, posts_per_km=60.0),
        road=replace(street.road, heading_deg=40.0, heading_wavelength_m=150.0),
    )
    return SimulationConfig(
        world=world, vehicle=VehicleConfig(frame_rate_hz=10.0), journeys=journeys
    )


def _drives(world: str, length_m: float, seed: int, **sections) -> SimulationConfig:
    chosen = replace(WORLD_PRESETS[world], length_m=length_m)
    given = {"vehicle": VehicleConfig(frame_rate_hz=10.0), "journeys": 4, **sections}
    return SimulationConfig(world=chosen, seed=seed, **given)


def _night(config: SimulationConfig) -> SimulationConfig:
    signs, lanes = DETECTION_PRESETS["night"]
    return replace(config, signs=signs, lanes=lanes)


_LORRY = RigConfig(camera="pinhole", camera_height_m=2.7, camera_pitch_deg=6.0)
_TELE = RigConfig(focal_px=2200.0, width=1920, height=1080)

GOOD: dict[str, SimulationConfig] = {
    "street": _drives("street", 250.0, 1),
    "winding": winding_street(),
    "suburb": _drives("suburb", 400.0, 3, positioning=POSITIONING_PRESETS["consumer"]),
    "highway": _drives("highway", 900.0, 4, rig=_TELE),
    "motorway": _drives("motorway", 900.0, 5, vehicle=VehicleConfig(frame_rate_hz=20.0)),
    "hills": _drives("hills", 400.0, 6, rig=_LORRY),
    "fisheye": _drives("street", 200.0, 7, rig=RigConfig(camera="fisheye")),
    "night": _night(_drives("block", 400.0, 8)),
    "fleet": with_errors(_drives("suburb", 300.0, 9, journeys=8), (ALL,)),
    "slow camera": _drives("street", 250.0, 10, vehicle=VehicleConfig(frame_rate_hz=3.0)),
    "reversing": _drives("street", 200.0, 11),
    "no lanes": _drives("street", 200.0, 12),
    "no signs": _drives("street", 200.0, 13),
    "one drive": _drives("street", 200.0, 14, journeys=1),
}
"""By name; of some `write_good_set` changes the files."""


def write_good_set(name: str, folder: Path, seed: int | None = None) -> None:
    """Writes one of `GOOD`, or another world and other drives like it, by a seed."""
    config = GOOD[name] if seed is None else replace(GOOD[name], seed=seed)
    write_dataset(config, folder)
    if name in _AFTERWARDS:
        _AFTERWARDS[name](folder)


def _without(kind: str) -> Callable[[Path], None]:
    """Nothing of a kind was detected."""

    def change(folder: Path) -> None:
        for path in folder.glob(f"journeys/*/{kind}.parquet"):
            pq.write_table(pq.read_table(path).slice(0, 0), path)

    return change


def _reverse(folder: Path) -> None:
    """Every car stops in the middle, drives back a fifth of its frames, and goes on."""
    for journey in sorted((folder / "journeys").iterdir()):
        poses = pq.read_table(journey / "poses.parquet")
        n = len(poses)
        back = np.arange(n // 2, n // 2 - n // 5, -1)
        order = np.concatenate((np.arange(n // 2), back, np.arange(back[-1], n)))
        known = poses["frame"].to_numpy()
        step = int(np.median(np.diff(poses["t_ns"].to_numpy())))
        changed = poses.take(pa.array(order))
        for name, values in (
            ("frame", np.arange(len(order))),
            ("t_ns", poses["t_ns"][0].as_py() + step * np.arange(len(order))),
        ):
            changed = changed.set_column(changed.column_names.index(name), name, pa.array(values))
        pq.write_table(changed, journey / "poses.parquet")
        for kind in ("signs", "lanes"):
            table = pq.read_table(journey / f"{kind}.parquet")
            frame = table["frame"].to_numpy()
            new, row = np.nonzero(known[order][:, None] == frame)
            table = table.take(pa.array(row))
            table = table.set_column(table.column_names.index("frame"), "frame", pa.array(new))
            pq.write_table(table, journey / f"{kind}.parquet")


_AFTERWARDS = {"reversing": _reverse, "no lanes": _without("lanes"), "no signs": _without("signs")}
