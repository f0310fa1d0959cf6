"""Small inputs that are right, as many as are destroyed: data sets, a configuration, and the folder of a run."""

from __future__ import annotations

import gc
import io
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path

import yaml

from crowdmap_torch import cli
from crowdmap_torch.config import MapperConfig, as_dict, changed
from crowdmap_torch.simulate.dataset import SimulationConfig, write_dataset
from crowdmap_torch.simulate.rigs import RigConfig
from crowdmap_torch.simulate.vehicle import VehicleConfig
from crowdmap_torch.simulate.worlds import WORLD_PRESETS
from crowdmap_torch.soak.verdict import PROGRESS

QUICK = """\
adjust: {lm: {max_iterations: 2}}
sign_triangulation: {fit: {rounds: 1, lm: {max_iterations: 4}, coarse_lm: {max_iterations: 2}}}
crowd: {rounds: 1}
"""
"""A configuration whose maps are as rough as they are quick: it is not the map that is judged."""


@dataclass(frozen=True)
class Good:
    """Folders of inputs that are right; copies of them are destroyed."""

    plain: Path
    """A data set that is quick to map: cameras without distortion, two frames a second."""
    lens: Path
    """One whose lenses bend, with four frames a second."""
    run: Path
    """RUN of the first."""


def write_good(folder: Path) -> Good:
    """Writes them all; what a run loads and prepares is there for every fork of this process."""
    plain, lens, run = folder / "plain", folder / "lens", folder / "run"
    write_street(plain, length_m=50.0, frame_rate_hz=2.0, seed=2)
    write_street(lens, camera="brown", length_m=60.0, frame_rate_hz=4.0, seed=1)
    (folder / "quick.yaml").write_text(QUICK)
    map_here(plain, run, folder / "quick.yaml")
    return Good(plain, lens, run)


def map_here(data: Path, run: Path, config: Path) -> None:
    """Maps a data set in this process, so that forks of it need not load and prepare what it did.

    RuntimeError if anything is said but how far it is: it would not be said again.
    """
    said = io.StringIO()
    with redirect_stdout(io.StringIO()), redirect_stderr(said):
        options = ("--out", str(run), "--config", str(config), "--workers", "1")
        code = cli.main(["optimize", str(data), *options])
    if code or any(not PROGRESS.match(line) for line in said.getvalue().splitlines()):
        raise RuntimeError(f"a good data set is not mapped well: {code}, {said.getvalue()}")
    # What is alive now stays: forks need not write into its pages to count who holds it.
    gc.collect()
    gc.freeze()


def write_street(
    folder: Path, *, length_m: float, frame_rate_hz: float, seed: int, camera: str = "pinhole"
) -> None:
    """Three drives of some metres of a street, with a survey and its truth."""
    street = WORLD_PRESETS["street"]
    signs = replace(street.signs, posts_per_km=60.0)
    config = SimulationConfig(
        world=replace(street, length_m=length_m, lights_per_km=0.0, signs=signs),
        vehicle=VehicleConfig(frame_rate_hz=frame_rate_hz),
        rig=RigConfig(camera=camera),
        journeys=3,
        seed=seed,
    )
    write_dataset(config, folder)


def quick_configuration() -> str:
    """`QUICK` with every default filled in, so that every number there is can be changed."""
    config = changed(MapperConfig(), yaml.safe_load(QUICK), where="quick")
    return yaml.safe_dump(as_dict(config), sort_keys=False)
