"""Destroys a small data set thousands of times and maps what is left: `python scripts/soak.py [--mutants 10000]`.

What fails is kept: a folder with the destroyed data set, what was said, and `failure.json` with its number, seed,
mutations and problems. `--only NUMBER` repeats one.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import NoReturn

# Before torch: a process with threads cannot be forked.
os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
import torch

from crowdmap_torch import cli, mapper
from crowdmap_torch.commands import optimize  # noqa: F401 (loaded once, for all the processes)
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.ranges import Count, CountOrNone, Seed, Share, Workers, argument
from crowdmap_torch.report import plots
from crowdmap_torch.simulate.dataset import SimulationConfig, write_dataset
from crowdmap_torch.simulate.vehicle import VehicleConfig
from crowdmap_torch.simulate.worlds import WORLD_PRESETS
from crowdmap_torch.soak.child import Outcome, run_apart
from crowdmap_torch.soak.mutations import destroy
from crowdmap_torch.soak.verdict import digest, problems

QUICK = """\
adjust: {lm: {max_iterations: 3}, covariance_samples: 4}
sign_triangulation: {fit: {rounds: 1, lm: {max_iterations: 6}, coarse_lm: {max_iterations: 3}}}
crowd: {rounds: 1}
"""
"""A configuration whose maps are as rough as they are quick: it is not the map that is judged."""
DRAWN = 0.1
"""Share of the maps whose report has its figures: they take as long as all the rest."""


@dataclass(frozen=True)
class Verdict:
    """One destroyed data set, and what came of it."""

    number: int
    mutations: list[str]
    outcome: Outcome
    problems: list[str]


def write_small_dataset(folder: Path) -> None:
    """Three drives of sixty metres of a street, with a survey and its truth."""
    street = WORLD_PRESETS["street"]
    signs = replace(street.signs, posts_per_km=60.0)
    world = replace(street, length_m=60.0, lights_per_km=0.0, signs=signs)
    vehicle = VehicleConfig(frame_rate_hz=4.0)
    write_dataset(SimulationConfig(world=world, vehicle=vehicle, journeys=3, seed=1), folder)


def soak(numbers: Sequence[int], seed: int, *, keep: Path, mapped: float = 1.0) -> list[Verdict]:
    """Destroys a data set once for each number, and what came of it; what fails is kept in a folder of `keep`.

    Only a share `mapped` of the data sets is mapped, the others are read and looked over.
    """
    torch.set_num_threads(1)
    verdicts = []
    with tempfile.TemporaryDirectory(prefix="soak-") as temporary:
        good = Path(temporary) / "good"
        write_small_dataset(good)
        for number in numbers:
            place = Path(temporary) / f"{number}"
            verdict = attempt(good, place, number, seed, mapped=mapped)
            if verdict.problems:
                _keep(place, keep / f"{seed}-{number}", verdict, seed)
            verdicts.append(verdict)
            shutil.rmtree(place, ignore_errors=True)
    return verdicts


def attempt(good: Path, place: Path, number: int, seed: int, *, mapped: float = 1.0) -> Verdict:
    """Copies the good data set to `place`, destroys the copy, maps it, and judges what came of it."""
    data, run, config = place / "data", place / "run", place / "config.yaml"
    shutil.copytree(good, data)
    config.write_text(QUICK)
    rng = np.random.default_rng([seed, number])
    arguments = ["optimize", str(data), "--out", str(run), "--workers", "1"]
    if rng.random() < 0.9:
        arguments += ["--config", str(config)]
    if rng.random() < 0.1:
        arguments += ["--strict"]
    drawings, maps = rng.random() < DRAWN, rng.random() < mapped
    done = place / "done.json"

    def ruin() -> int:
        done.write_text(json.dumps([destroy(data, rng), digest(data)]))
        return 0

    def map_it() -> int:
        if not drawings:
            plots.svg = lambda figure: ""
        if not maps:
            mapper.map_journeys = _read_only
        return cli.main(arguments)

    apart = run_apart(ruin, place)
    if apart.code:
        return Verdict(number, [], apart, [f"the mutation failed: {apart.err[-300:]}"])
    mutations, before = json.loads(done.read_text())
    outcome = run_apart(map_it, place)
    return Verdict(number, mutations, outcome, problems(data, run, outcome, before))


def _read_only(*arguments: object, **options: object) -> NoReturn:
    raise InputError("read, looked over, and not mapped")


def _keep(place: Path, folder: Path, verdict: Verdict, seed: int) -> None:
    folder.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(folder, ignore_errors=True)
    shutil.move(place, folder)
    content = {
        "seed": seed,
        "number": verdict.number,
        "mutations": verdict.mutations,
        "problems": verdict.problems,
        "exit": verdict.outcome.code,
        "seconds": verdict.outcome.seconds,
    }
    (folder / "failure.json").write_text(json.dumps(content, indent=2) + "\n")


def _verdicts(numbers: Sequence[int], options: argparse.Namespace) -> Iterator[Verdict]:
    """The verdicts of all numbers, batch by batch in as many processes as there should be."""
    size = 1 + (len(numbers) - 1) // options.processes
    batches = [numbers[k : k + min(size, 50)] for k in range(0, len(numbers), min(size, 50))]
    tasks = [(list(batch), options.seed, options.keep, options.mapped) for batch in batches]
    if options.processes == 1:
        for task in tasks:
            yield from _batch(task)
        return
    with get_context("spawn").Pool(options.processes) as pool:
        for found in pool.imap_unordered(_batch, tasks):
            yield from found


def _batch(task: tuple[list[int], int, Path, float]) -> list[Verdict]:
    numbers, seed, keep, mapped = task
    return soak(numbers, seed, keep=keep, mapped=mapped)


def main(arguments: Sequence[str] | None = None) -> int:
    """Reads the command line and soaks; 0 if everything held."""
    parser = argparse.ArgumentParser(prog="soak", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--mutants", type=argument(Count), default=10_000, metavar="N")
    parser.add_argument("--first", type=argument(CountOrNone), default=0, metavar="NUMBER")
    parser.add_argument("--only", type=argument(CountOrNone), metavar="NUMBER", help="that one")
    parser.add_argument("--seed", type=argument(Seed), default=0)
    parser.add_argument("--processes", type=argument(Workers), default=1, metavar="N")
    parser.add_argument(
        "--mapped", type=argument(Share), default=1.0, help="share that is mapped, not only read"
    )
    parser.add_argument("--keep", type=Path, default=Path("soak-failures"), metavar="FOLDER")
    options = parser.parse_args(arguments)
    options.keep = options.keep.resolve()
    numbers = range(options.first, options.first + options.mutants)
    if options.only is not None:
        numbers = range(options.only, options.only + 1)
    codes: Counter[int] = Counter()
    begun, failures = time.monotonic(), 0
    for verdict in _verdicts(numbers, options):
        codes[verdict.outcome.code] += 1
        if verdict.problems:
            failures += 1
            print(f"{verdict.number}: {verdict.mutations}: {verdict.problems}", flush=True)
        if codes.total() % 100 == 0:
            print(f"{codes.total()} in {time.monotonic() - begun:.0f} s: {dict(codes)}", flush=True)
    print(
        f"{len(numbers)} mutants in {time.monotonic() - begun:.0f} s, "
        f"exit codes {dict(codes)}: {failures} failures"
    )
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
