"""Lane width with and without the online road normal (IV-C)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.studies.chapter import Chapter, Table
from crowdmap_torch.studies.curves import plot_bars
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.numbers import numbers, results, spread
from crowdmap_torch.studies.scale import SHORT_TURNS, Scale
from crowdmap_torch.studies.study import Settings, Study
from crowdmap_torch.studies.tasks import MeasureMap, Task


def _with(road: str, lane: str) -> MapperConfig:
    default = MapperConfig()
    return replace(
        default,
        road=replace(default.road, method=road),
        lane=replace(default.lane, method=lane),
    )


VARIANTS: Mapping[str, MapperConfig] = {
    "the paper's lanes, calibration alone": _with("calibration", "paper2017"),
    "the paper's lanes, the paper's normal": _with("paper2017", "paper2017"),
    "our lanes, calibration alone": _with("calibration", "surface"),
    "our lanes, our normal, causal": _with("causal", "surface"),
    "our lanes, our normal": _with("smoothed", "surface"),
}
"""Lanes on one plane a frame (`paper2017`) or on the road that the car drove, and where the normal comes from."""
_WITHOUT = {
    "the paper's lanes, the paper's normal": "the paper's lanes, calibration alone",
    "our lanes, our normal, causal": "our lanes, calibration alone",
    "our lanes, our normal": "our lanes, calibration alone",
}
"""What each is compared with."""
_STAGES = {
    "single journeys": "clean.lane_width",
    "markers of all journeys": "heads.lanes.width",
    "adjusted": "map.lanes.width",
}


def tasks(settings: Settings) -> Iterator[tuple[int, Task]]:
    """A map for each variant and seed."""
    for config in VARIANTS.values():
        for task in _maps(settings.scale, config):
            yield 2 + SHORT_TURNS * task.simulation.seed, task


def chapter(settings: Settings, folder: StudyFolder) -> Chapter:
    """Errors of the lane width after each stage."""
    widths: dict[str, dict[str, tuple[float, float]]] = {}
    seeds: dict[str, int] = {}
    for name, config in VARIANTS.items():
        maps = _maps(settings.scale, config)
        made, alone = (
            results(maps, folder),
            results([j for m in maps for j in m.journeys()], folder),
        )
        seeds[name] = len(made)
        widths[name] = {}
        for stage, path in _STAGES.items():
            found = alone if stage == "single journeys" else made
            row = spread(numbers(found, f"{path}.mean"))
            widths[name][stage] = (row.mean, row.std)
    rows = []
    for name, stages in widths.items():
        base = widths.get(_WITHOUT.get(name, ""))
        for stage, (mean, std) in stages.items():
            share = mean / base[stage][0] if base else float("nan")
            rows.append((name, stage, mean, std, share, seeds[name]))
    columns = (
        "variant",
        "after",
        "width error [m]",
        "1-sigma",
        "of that by calibration alone",
        "seeds",
    )
    scale = settings.scale
    return Chapter(
        "road-normal",
        "The road normal",
        text=(
            f"Mean error of the lane width; {scale.short_journeys} journeys of {scale.short_road.length_m:.0f} m. Each "
            "car is loaded in its own way, up to a degree, and pitches as it drives. Adjustment sees the lanes in the "
            "images again and mends part of what a wrong normal has done.",
        ),
        tables=(Table("road-normal", columns, tuple(rows)),),
        plots={"road-normal": plot_bars(widths, x="mean error of lane width [m]")},
    )


def _maps(scale: Scale, config: MapperConfig) -> list[MeasureMap]:
    return [
        MeasureMap(scale.short_drives(seed), scale.short_journeys, config=config)
        for seed in range(scale.short_seeds)
    ]


STUDY = Study("road-normal", "The road normal", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
