"""One mutant: copies of good inputs, destroyed at random, what a command makes of them, and what is to be said of that."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from matplotlib.figure import Figure

from crowdmap_torch import cli, mapper
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.report import plots
from crowdmap_torch.soak.child import Outcome, run_apart
from crowdmap_torch.soak.good import QUICK, Good, quick_configuration
from crowdmap_torch.soak.mutations import destroy
from crowdmap_torch.soak.verdict import (
    WRITTEN,
    digest,
    problems_of_figures,
    problems_of_limits,
    problems_of_outcome,
    problems_of_place,
    problems_of_run,
)

KINDS = {"data set": 0.45, "configuration": 0.15, "evaluation": 0.25, "calibration": 0.15}
"""What is destroyed, and how often: a data set, the file of --config, what `crowdmap evaluate` compares, and what an
earlier run found of its cars."""
_BENT = 0.2
"""Share of the data sets whose lenses bend."""
_DRAWN = 0.05
"""Share of the maps whose report has its figures: they take as long as all the rest."""


@dataclass(frozen=True)
class Verdict:
    """One mutant, and what came of it."""

    number: int
    kind: str
    mutations: list[str]
    outcome: Outcome
    problems: list[str]


@dataclass(frozen=True)
class _Trial:
    """What is destroyed, and what is run on it."""

    destroyed: tuple[Path, ...]
    """Folders, of which one is chosen."""
    command: list[str]
    judge: Callable[[Outcome], Iterable[str]]
    """What is broken of what the command wrote, where it ended well."""


def attempt(good: Good, place: Path, number: int, seed: int, *, mapped: float = 1.0) -> Verdict:
    """Copies good inputs below `place`, destroys the copies, runs a command on them, and judges what came of it.

    Of the data sets only a share `mapped` is mapped, the others are read and looked over.
    """
    rng = np.random.default_rng([seed, number])
    kind = str(rng.choice(list(KINDS), p=list(KINDS.values())))
    inputs, done = place / "inputs", place / "done.json"
    inputs.mkdir(parents=True)
    trial = _TRIALS[kind](good, inputs, rng)
    part = trial.destroyed[rng.integers(len(trial.destroyed))]
    is_drawn, is_mapped = rng.random() < _DRAWN, rng.random() < mapped

    def ruin() -> int:
        done.write_text(json.dumps([destroy(part, rng), digest(inputs)]))
        return 0

    def run() -> int:
        if not is_drawn:
            plots.svg, plots.pixels = _no_text, _no_pixels
        if not is_mapped:
            mapper.map_journeys = _read_only
        return cli.main(trial.command)

    apart = run_apart(ruin, place)
    if apart.code:
        return Verdict(number, kind, [], apart, [f"the mutation failed: {apart.err[-300:]}"])
    mutations, before = json.loads(done.read_text())
    outcome = run_apart(run, place)
    problems = [*problems_of_outcome(outcome, trial.command[0]), *problems_of_limits(outcome)]
    problems += problems_of_place(place, before)
    if outcome.code in WRITTEN:
        problems += trial.judge(outcome)
    return Verdict(number, kind, mutations, outcome, problems)


# ---- what is destroyed ----


def _data_set(good: Good, inputs: Path, rng: np.random.Generator) -> _Trial:
    data, config = inputs / "data", inputs / "quick.yaml"
    shutil.copytree(good.lens if rng.random() < _BENT else good.plain, data)
    config.write_text(QUICK)
    options = ["--config", str(config)] if rng.random() < 0.95 else []
    return _optimize(data, (data,), options, rng)


def _configuration(good: Good, inputs: Path, rng: np.random.Generator) -> _Trial:
    folder = inputs / "configuration"
    folder.mkdir()
    path = folder / "config.yaml"
    path.write_text(QUICK if rng.random() < 0.2 else quick_configuration())
    return _optimize(good.plain, (folder,), ["--config", str(path)], rng)


def _calibration(good: Good, inputs: Path, rng: np.random.Generator) -> _Trial:
    earlier, config = inputs / "earlier", inputs / "quick.yaml"
    earlier.mkdir()
    shutil.copy(good.run / "calibration.json", earlier)
    config.write_text(QUICK)
    options = ["--config", str(config), "--calibration", str(earlier)]
    return _optimize(good.plain, (earlier,), options, rng)


def _optimize(
    data: Path, destroyed: tuple[Path, ...], options: list[str], rng: np.random.Generator
) -> _Trial:
    run = destroyed[0].parents[1] / "run"
    command = ["optimize", str(data), "--out", str(run), "--workers", "1", *options]
    if rng.random() < 0.1:
        command.append("--strict")
    return _Trial(destroyed, command, lambda outcome: problems_of_run(data, run, outcome))


def _evaluation(good: Good, inputs: Path, rng: np.random.Generator) -> _Trial:
    data, run, lists = inputs / "data", inputs / "run", inputs / "lists"
    control, out = inputs / "control", inputs.parent / "figures.json"
    shutil.copytree(good.plain, data)
    shutil.copytree(good.run, run, ignore=shutil.ignore_patterns("tensorboard", "report.html"))
    shutil.copytree(good.plain / "survey", control, ignore=shutil.ignore_patterns("truth"))
    lists.mkdir()
    ids = json.loads((run / "metrics.json").read_text())["sign_corners"]
    content = {"observable": [one["sign_id"] for one in ids] + ["sign-0", "sign-1"]}
    (lists / "observable.json").write_text(json.dumps(content))
    journey = min((run / "journeys").iterdir())
    hd_map = (run / "map", run / "map", run / "map_clusters", journey)[rng.integers(4)]
    command = ["evaluate", str(hd_map), str(data / "survey"), "--json", str(out)]
    destroyed = [data / "survey", data / "survey", data, run, run]
    if rng.random() < 0.2:
        command += ["--control", str(control)]
        destroyed.append(control)
    if rng.random() < 0.2:
        command += ["--observable", str(lists / "observable.json")]
        destroyed.append(lists)
    if rng.random() < 0.2:
        command += ["--run", str(run)]
    if rng.random() < 0.2:
        command += ["--dataset", str(data)]
    return _Trial(
        tuple(destroyed), command, lambda outcome: problems_of_figures(out, hd_map, data / "survey")
    )


_TRIALS: dict[str, Callable[[Good, Path, np.random.Generator], _Trial]] = {
    "data set": _data_set,
    "configuration": _configuration,
    "evaluation": _evaluation,
    "calibration": _calibration,
}


def _no_text(figure: Figure) -> str:
    return ""


def _no_pixels(figure: Figure) -> np.ndarray:
    return np.zeros((1, 1, 3), np.uint8)


def _read_only(*arguments: object, **options: object) -> NoReturn:
    raise InputError("read, looked over, and not mapped")
