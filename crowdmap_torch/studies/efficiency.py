"""Our map beside the best linear estimator, which knows all associations, noise levels and outliers, and its bound."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from statistics import fmean

from crowdmap_torch.evaluation.signs import evaluate_signs
from crowdmap_torch.evaluation.visibility import observable_signs
from crowdmap_torch.io.documents import plain
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.simulate.dataset import SimulationConfig
from crowdmap_torch.simulate.errors import ERRORS, with_errors
from crowdmap_torch.studies.chapter import Cell, Chapter, Table
from crowdmap_torch.studies.curves import Line, Panel, plot_lines
from crowdmap_torch.studies.fleet import RIGHT, Variant
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.linear_map import linear_map
from crowdmap_torch.studies.maps import OURS, honest_maps
from crowdmap_torch.studies.measure import load_drives
from crowdmap_torch.studies.numbers import Result, numbers
from crowdmap_torch.studies.scale import SHORT_TURNS, Scale
from crowdmap_torch.studies.study import Settings, Study
from crowdmap_torch.studies.tasks import MeasureMap, Simulate, Task

ASKED = {"relative": 1.2, "absolute": 1.1}
"""Most that our corner error may be, in multiples of the linear estimator's."""
TREMBLES = (RIGHT, Variant("jitter"), Variant("jitter", 2.0))
"""Detectors whose outlines stand still, tremble, and tremble twice as much."""
_OF_POSES = ("sigmas", "outages")
_OF_CARS = tuple(name for name in ERRORS if name not in ("jitter", *_OF_POSES))
FLEETS: Mapping[str, tuple[str, ...]] = {
    "none": (),
    "of cars and detectors": _OF_CARS,
    "these, and outlines tremble": (*_OF_CARS, "jitter"),
}
"""Errors of real fleets, but for those of what is stated of poses: the linear estimator knows how far these are off."""


@dataclass(frozen=True)
class MeasureLinear(Task):
    """What the linear estimator makes of the drives."""

    simulation: SimulationConfig

    @property
    def key(self) -> str:
        """Of the dataset."""
        return f"{Simulate(self.simulation).key}-linear"

    @property
    def cost_s(self) -> float:
        """Of dense matrices of all poses of a journey."""
        return 5.0 * self.simulation.journeys

    def needs(self) -> Sequence[Task]:
        """The dataset."""
        return (Simulate(self.simulation),)

    def run(self, folder: StudyFolder) -> None:
        """Estimates the signs that count and measures them."""
        dataset = folder.dataset(self.simulation)
        drives = load_drives(dataset)
        begun = time.process_time()
        true_signs = read_map(dataset / "survey").signs
        told = drives.truth, drives.survey, true_signs, self.simulation
        found = linear_map(*told, drives.vehicles)
        observable = observable_signs(drives.truth, drives.survey.signs)
        signs = found.signs[observable[found.row]]
        own = (signs.covariance - found.shared).diagonal(dim1=1, dim2=2).sum(1)
        measured = {
            "signs": plain(evaluate_signs(signs, drives.survey.signs, observable=observable)),
            "own_sigma_m": float(own.mean().sqrt()) if len(signs) else math.nan,
            "shared_sigma_m": float(found.shared.trace().sqrt()),
            "seconds": time.process_time() - begun,
        }
        folder.write_result(self.key, plain(measured))


def tasks(settings: Settings) -> Iterator[tuple[int, Task]]:
    """Both estimates for each seed."""
    scale = settings.scale
    trembling = (pairs for _, pairs in _tremble_pairs(scale))
    fleets = (pairs for _, pairs in _fleet_pairs(scale))
    for pair in chain(_pairs(scale), *trembling, *fleets):
        for task in pair:
            yield SHORT_TURNS + 2 * task.simulation.seed, task


def chapter(settings: Settings, folder: StudyFolder) -> Chapter:
    """Errors of both estimates on the same data, and the bound."""
    ours, linear = _done(_pairs(settings.scale), folder)
    done = len(ours)
    rows, panels = [], []
    seeds = list(range(done))
    for error, most in ASKED.items():
        mine, best = _means(ours, linear, error)
        if done:
            rows.append((error, fmean(mine), fmean(best), fmean(mine) / fmean(best), most))
        lines = [Line("ours", seeds, mine), Line("linear estimator", seeds, best)]
        panels.append(Panel(f"{error} corner error", lines))
    bound = tuple(
        (what, fmean(numbers(linear, path)))
        for what, path in (
            ("centre, the shared part left out", "own_sigma_m"),
            ("shared part", "shared_sigma_m"),
        )
        if done
    )
    scale = settings.scale
    return Chapter(
        text=(
            f"{done} data sets of {scale.honest_journeys} journeys on {scale.short_road.length_m:.0f} m of road. The "
            "linear estimator is told what every detection shows, which ones are outliers, all noise levels and the "
            "process that the poses' errors are drawn from; it starts at the truth and is written in dense matrices. Its "
            "covariance is the Cramer-Rao bound.",
            f"{scale.fleet_journeys} drives over {scale.fleet_road.length_m:.0f} m whose detectors tremble, all corners "
            "of an outline alike and for some time (`study fleet`): the linear estimator weighs them by the covariance that "
            "they are drawn from. And the same drives with all that real cars and detectors have wrong: it knows how large "
            "each of these errors is in the mean, and has to find them.",
        ),
        tables=(
            Table(
                "efficiency",
                ("corner error", "ours [m]", "linear estimator [m]", "ratio", "asked at most"),
                tuple(rows),
            ),
            Table("efficiency-bound", ("Cramer-Rao bound", "1-sigma, three axes [m]"), bound),
            Table(
                "efficiency-tremble",
                (
                    *("trembles by [px]", "ours, relative [m]", "/ standing still"),
                    *("linear estimator [m]", "/ standing still", "ours / linear", "seeds"),
                ),
                _rows(folder, _tremble_pairs(scale)),
            ),
            Table(
                "efficiency-fleet",
                (
                    *("errors", "ours, relative [m]", "/ none"),
                    *("linear estimator [m]", "/ none", "ours / linear", "seeds"),
                ),
                _rows(folder, _fleet_pairs(scale)),
            ),
        ),
        plots={"efficiency": plot_lines(panels, x="seed", y="mean corner error [m]")},
    )


_Pairs = list[tuple[MeasureMap, MeasureLinear]]


def _pairs(scale: Scale) -> _Pairs:
    return [(m, MeasureLinear(m.simulation)) for m in honest_maps(scale, scale.linear_sets)]


_Spoil = Callable[[SimulationConfig], SimulationConfig]


def _few(scale: Scale, spoil: _Spoil) -> _Pairs:
    """A few drives that are spoilt so, seed by seed."""
    drives = [spoil(scale.fleet_drives(seed)) for seed in range(scale.fleet_seeds)]
    count = scale.fleet_journeys
    return [(MeasureMap(each, count, config=OURS), MeasureLinear(each)) for each in drives]


def _wrong(names: tuple[str, ...]) -> _Spoil:
    return lambda drives: with_errors(drives, names)


def _tremble_pairs(scale: Scale) -> Iterator[tuple[Cell, _Pairs]]:
    """By how far their outlines tremble."""
    for variant in scale.first(TREMBLES, beside=1):
        pairs = _few(scale, variant.spoil)
        yield pairs[0][0].simulation.signs.jitter_px, pairs


def _fleet_pairs(scale: Scale) -> Iterator[tuple[Cell, _Pairs]]:
    """By what is wrong."""
    for told, names in scale.first(FLEETS.items(), beside=1):
        yield told, _few(scale, _wrong(names))


def _done(pairs: _Pairs, folder: StudyFolder) -> tuple[list[Result], list[Result]]:
    """Results of both, of those that are done."""
    done = [
        (folder.read_result(ours.key), folder.read_result(linear.key))
        for ours, linear in pairs
        if ours.is_done(folder) and linear.is_done(folder)
    ]
    return [a for a, _ in done], [b for _, b in done]


def _means(ours: list[Result], linear: list[Result], error: str) -> tuple[list[float], list[float]]:
    """Mean corner errors of both, map by map."""
    mine = numbers(ours, f"map.signs.{error}.total.mean")
    return mine, numbers(linear, f"signs.{error}.total.mean")


def _rows(
    folder: StudyFolder, variants: Iterator[tuple[Cell, _Pairs]]
) -> tuple[tuple[Cell, ...], ...]:
    """Errors of both of each variant beside those of the first one."""
    found: list[tuple[Cell, float, float, int]] = []
    for told, pairs in variants:
        mine, best = _means(*_done(pairs, folder), "relative")
        if mine:
            found.append((told, fmean(mine), fmean(best), len(mine)))
        elif not found:
            # Without the first there is nothing to compare with.
            break
    return tuple(
        (told, mine, mine / found[0][1], best, best / found[0][2], mine / best, seeds)
        for told, mine, best, seeds in found
    )


STUDY = Study("efficiency", "How far from the best possible?", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
