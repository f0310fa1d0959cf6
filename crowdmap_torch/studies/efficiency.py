"""Our map beside the best linear estimator, which knows all associations, noise levels and outliers, and its bound."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import fmean

from crowdmap_torch.evaluation.signs import evaluate_signs
from crowdmap_torch.evaluation.visibility import observable_signs
from crowdmap_torch.io.documents import plain
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.simulate.dataset import SimulationConfig
from crowdmap_torch.studies.chapter import Chapter, Table
from crowdmap_torch.studies.curves import Line, Panel, plot_lines
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.linear_map import linear_map
from crowdmap_torch.studies.maps import honest_maps
from crowdmap_torch.studies.measure import load_drives
from crowdmap_torch.studies.numbers import numbers
from crowdmap_torch.studies.scale import SHORT_TURNS, Scale
from crowdmap_torch.studies.study import Settings, Study
from crowdmap_torch.studies.tasks import MeasureMap, Simulate, Task

ASKED = {"relative": 1.2, "absolute": 1.1}
"""Most that our corner error may be, in multiples of the linear estimator's."""


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
        found = linear_map(drives.truth, drives.survey, true_signs, self.simulation)
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
    for pair in _pairs(settings.scale):
        for task in pair:
            yield SHORT_TURNS + 2 * task.simulation.seed, task


def chapter(settings: Settings, folder: StudyFolder) -> Chapter:
    """Errors of both estimates on the same data, and the bound."""
    done = [
        (folder.read_result(ours.key), folder.read_result(linear.key))
        for ours, linear in _pairs(settings.scale)
        if ours.is_done(folder) and linear.is_done(folder)
    ]
    ours, linear = [a for a, _ in done], [b for _, b in done]
    rows, panels = [], []
    seeds = list(range(len(done)))
    for error, most in ASKED.items():
        mine = numbers(ours, f"map.signs.{error}.total.mean")
        best = numbers(linear, f"signs.{error}.total.mean")
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
            f"{len(done)} data sets of {scale.honest_journeys} journeys on {scale.short_road.length_m:.0f} m of road. The "
            "linear estimator is told what every detection shows, which ones are outliers, all noise levels and the "
            "process that the poses' errors are drawn from; it starts at the truth and is written in dense matrices. Its "
            "covariance is the Cramer-Rao bound.",
        ),
        tables=(
            Table(
                "efficiency",
                ("corner error", "ours [m]", "linear estimator [m]", "ratio", "asked at most"),
                tuple(rows),
            ),
            Table("efficiency-bound", ("Cramer-Rao bound", "1-sigma, three axes [m]"), bound),
        ),
        plots={"efficiency": plot_lines(panels, x="seed", y="mean corner error [m]")},
    )


def _pairs(scale: Scale) -> list[tuple[MeasureMap, MeasureLinear]]:
    return [(m, MeasureLinear(m.simulation)) for m in honest_maps(scale, scale.linear_sets)]


STUDY = Study("efficiency", "How far from the best possible?", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
