"""Long drives: is a drive of 20 km as well described as one of 1 km, and what does a longer one take?"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.io.maps import certain_part
from crowdmap_torch.mapper import JourneyMap, build_bundle, finish_map, first_map, map_journey
from crowdmap_torch.simulate.dataset import SimulationConfig
from crowdmap_torch.studies.chapter import Cell, Chapter, Table
from crowdmap_torch.studies.curves import Line, Panel, plot_lines
from crowdmap_torch.studies.folder import StudyFolder, digest
from crowdmap_torch.studies.honesty import COVERED
from crowdmap_torch.studies.measure import Drives, load_drives, map_figures
from crowdmap_torch.studies.numbers import Result, number, numbers, results, weighted_mean
from crowdmap_torch.studies.spent import spent
from crowdmap_torch.studies.study import Settings, Study
from crowdmap_torch.studies.tasks import Simulate, Task

VARIANTS: Mapping[str, MapperConfig] = {
    "one bias": replace(
        MapperConfig(), positioning=replace(MapperConfig().positioning, wander_sigma_m=0.0)
    ),
    "bias that wanders": MapperConfig(),
}
"""Without the slow process, and with it, as is the default."""
_WITH = "bias that wanders"
EXPONENT = 1.05
"""Most that time and memory may grow by, as a power of the drive's length."""
_STAGES = ("single journeys", "first map", "adjustment", "covariances")


@dataclass(frozen=True)
class MeasureLong(Task):
    """What the map of all drives is worth in each variant, and what every stage takes."""

    simulation: SimulationConfig
    variants: tuple[str, ...] = tuple(VARIANTS)

    @property
    def key(self) -> str:
        """Of the dataset and the variants."""
        named = digest({"variants": list(self.variants)})
        return f"{Simulate(self.simulation).key}-long-{named}"

    @property
    def cost_s(self) -> float:
        """Of single journeys once, and of an adjustment for each variant."""
        driven = self.simulation.journeys * self.simulation.world.length_m / 1000
        return (2.0 + 4.0 * len(self.variants)) * driven

    def needs(self) -> Sequence[Task]:
        """The dataset."""
        return (Simulate(self.simulation),)

    @torch.no_grad()
    def run(self, folder: StudyFolder) -> None:
        """Maps the drives and measures the maps."""
        drives = load_drives(folder.dataset(self.simulation))
        journeys, stages = drives.dataset.journeys, {}
        # Of single journeys the variants say the same.
        with spent(stages, _STAGES[0]):
            maps = [map_journey(drive, n, VARIANTS[_WITH]) for n, drive in enumerate(journeys)]
        measured = {name: _mapped(drives, maps, VARIANTS[name]) for name in self.variants}
        seconds = stages[_STAGES[0]]["seconds"] + sum(
            stage["seconds"] for m in measured.values() for stage in m["stages"].values()
        )
        driven = self.simulation.journeys * self.simulation.world.length_m / 1000
        result = {
            "maps": measured,
            "single": stages[_STAGES[0]],
            "seconds": seconds,
            "driven_km": driven,
        }
        folder.write_result(self.key, result)


def _mapped(drives: Drives, maps: Sequence[JourneyMap], config: MapperConfig) -> dict:
    """Figures of the drives' map, and what its stages took."""
    dataset, stages = drives.dataset, {}
    journeys, taken = dataset.journeys, 0
    with spent(stages, "first map"):
        first = first_map(journeys, maps, config)
    with spent(stages, "adjustment"):
        bundle = build_bundle(journeys, maps, first, config)
        state = adjust.start(bundle)
        for number_of_step, after, _ in adjust.steps(bundle, state):
            state, taken = after, number_of_step + 1
    with spent(stages, "covariances"):
        result = finish_map(dataset, maps, first, bundle, state, config)
    final = certain_part(result.hd_map, config.min_confidence)
    figures = map_figures(drives, final, result.associations)
    scale = result.prior_scale.mean(0).tolist()
    values = bundle.values()
    unknowns = sum(
        len(values[name]) * bundle.variables[name].tangent_dim for name in ("sign", "size", "lane")
    )
    return {
        "map": figures,
        "stages": stages,
        "steps": taken,
        "scale": scale,
        "outlier_journeys": len(first.crowd.report.outlier_journeys),
        "unknowns": unknowns,
    }


def tasks(settings: Settings) -> Iterator[tuple[int, Task]]:
    """Drives of either length, as many kilometres of each; then one drive, longer and longer."""
    for number_, task in enumerate(_compared(settings)):
        yield number_, task
    for task in _series(settings):
        yield len(_compared(settings)), task


def _compared(settings: Settings) -> list[MeasureLong]:
    scale = settings.scale
    longest = max(scale.long_lengths_m)
    return [
        MeasureLong(scale.long_drives(length, seed))
        for length in scale.long_lengths_m
        for seed in range(max(1, round(scale.long_share * longest / length)))
    ]


def _series(settings: Settings) -> list[MeasureLong]:
    scale = settings.scale
    return [
        MeasureLong(replace(scale.long_drives(length, 0), journeys=1), (_WITH,))
        for length in scale.series_lengths_m
    ]


def chapter(settings: Settings, folder: StudyFolder) -> Chapter:
    """Errors and honesty by length and variant, and what a drive takes by its length."""
    scale = settings.scale
    wander = scale.long_drives(1000.0, 0).positioning
    rows = [
        row
        for length in scale.long_lengths_m
        for row in _rows(
            length,
            results(
                [t for t in _compared(settings) if t.simulation.world.length_m == length], folder
            ),
        )
    ]
    series = [
        (task.simulation.world.length_m / 1000, folder.read_result(task.key))
        for task in _series(settings)
        if folder.has_result(task.key)
    ]
    low, high = (100 * share for share in COVERED)
    return Chapter(
        text=(
            f"{scale.long_journeys} drives, signs alone, whose bias wanders by {wander.bias_wander_m:g} m (1-sigma by axis) "
            f"over {wander.bias_wander_length_m / 1000:g} km, beside the constant one and the drift of `paper`.",
            "Relative errors are those within 150 m. The share of centres inside their 95 % ellipsoids, without what all "
            f"share, is to be {low:.0f} to {high:.0f} %. Seconds are of a core, memory the most that the process held.",
            "One drive, longer and longer, with the default configuration: exponents of time and memory by its length, of "
            f"which {EXPONENT:g} is the most that is asked for.",
        ),
        tables=(
            Table("long", _COLUMNS, tuple(rows)),
            Table("long-series", ("km", *_SERIES), tuple(_series_rows(series))),
        ),
        plots={"long": plot_lines(_panels(series), x="km", y="")},
    )


_COLUMNS = (
    "drives",
    "variant",
    "maps",
    "relative [m]",
    "inside [%]",
    "mean NEES",
    "sigma of the wander, times that given",
    "core seconds a km",
    "memory [MB]",
)
_SERIES = (
    "single journey [s]",
    "first map [s]",
    "adjustment [s]",
    "a step of it [s]",
    "covariances [s]",
    "memory [MB]",
    "unknowns of landmarks",
)


def _rows(length_m: float, found: Sequence[Result]) -> Iterator[tuple[Cell, ...]]:
    """One row for each variant."""
    for name in VARIANTS:
        made = [result["maps"][name] for result in found if name in result["maps"]]
        signs = numbers(made, "map.uncertainty.signs")
        driven = sum(number(result, "driven_km") for result in found)

        def mean(path: str, made=made, signs=signs) -> float:
            return weighted_mean(numbers(made, path), signs)

        took = sum(stage["seconds"] for m in made for stage in m["stages"].values())
        took += sum(number(result, "single.seconds") for result in found)
        peaks = [stage["peak_mb"] for m in made for stage in m["stages"].values()]
        scale = [m["scale"][3] for m in made if len(m["scale"]) > 3]
        yield (
            f"{length_m / 1000:g} km",
            name,
            len(made),
            mean("map.signs.relative.total.mean"),
            100 * mean("map.uncertainty.coverage"),
            mean("map.uncertainty.mean_nees"),
            float(np.mean(scale)) if scale else math.nan,
            took / driven if driven else math.nan,
            max(peaks, default=math.nan),
        )


def _series_rows(series: Sequence[tuple[float, Result]]) -> Iterator[tuple[Cell, ...]]:
    """What every length takes, and the exponents at the end."""
    taken = [_taken(result) for _, result in series]
    for (km, _), row in zip(series, taken, strict=True):
        yield (f"{km:g}", *row)
    if len(series) > 1:
        log = np.log([km for km, _ in series])
        slopes = [float(np.polyfit(log, np.log(column), 1)[0]) for column in np.array(taken).T]
        yield ("exponent", *slopes)


def _taken(result: Result) -> tuple[float, ...]:
    made = result["maps"][_WITH]
    stages = {_STAGES[0]: result["single"], **made["stages"]}
    single, first, adjustment, covariances = (stages[name]["seconds"] for name in _STAGES)
    peak = max(stage["peak_mb"] for stage in stages.values())
    step = adjustment / made["steps"]
    return single, first, adjustment, step, covariances, peak, float(made["unknowns"])


def _panels(series: Sequence[tuple[float, Result]]) -> list[Panel]:
    km = [length for length, _ in series]
    columns = list(zip(*(_taken(result) for _, result in series), strict=True))
    if not columns:
        columns = [()] * len(_SERIES)
    by_name = {name: list(column) for name, column in zip(_SERIES, columns, strict=True)}
    memory = by_name.pop("memory [MB]")
    unknowns = by_name.pop("unknowns of landmarks")
    lines = [Line(name, km, values) for name, values in by_name.items()]
    return [
        Panel("core seconds", lines),
        Panel("most memory [MB]", [Line("memory", km, memory)]),
        Panel("unknowns of landmarks", [Line("unknowns", km, unknowns)]),
    ]


STUDY = Study("long", "Long drives", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
