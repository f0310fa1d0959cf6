"""A few surveyed signs pin the map: what nobody can average away is then gone too."""

from __future__ import annotations

from collections.abc import Iterator

from crowdmap_torch.studies.chapter import Chapter, Table
from crowdmap_torch.studies.curves import plot_bars
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.numbers import number, results
from crowdmap_torch.studies.scale import Scale
from crowdmap_torch.studies.study import Settings, Study
from crowdmap_torch.studies.tasks import MeasureMap, Task

PER_KM = 5
_PINNED = {
    "with [m]": "map.signs.absolute.total.mean",
    "horizontal [m]": "map.signs.absolute.horizontal.mean",
    "vertical [m]": "map.signs.absolute.vertical.mean",
    "relative [m]": "map.signs.relative.total.mean",
    "lane lateral [m]": "map.lanes.lateral.mean",
}
"""Numbers of the map with control signs."""


def tasks(settings: Settings) -> Iterator[tuple[int, Task]]:
    """For each seed the map without control signs and the one with them."""
    for free, pinned in _pairs(settings.scale):
        for task in (free, pinned):
            yield 2 * task.simulation.seed + 1, task


def chapter(settings: Settings, folder: StudyFolder) -> Chapter:
    """Errors with and without, seed by seed."""
    scale, rows, bars = settings.scale, [], {}
    for free, pinned in _pairs(scale):
        found = results((free, pinned), folder)
        if len(found) < 2:
            continue
        without = number(found[0], _PINNED["with [m]"])
        pinned = {title: number(found[1], path) for title, path in _PINNED.items()}
        signs, others = (
            round(number(found[1], path))
            for path in ("control_points", "map.signs.absolute.total.count")
        )
        seed = free.simulation.seed
        rows.append((seed, signs, without, *pinned.values(), others))
        bars[f"seed {seed}"] = {"without": (without, 0.0), "with": (pinned["with [m]"], 0.0)}
    columns = ("seed", "control signs found", "absolute without [m]", *_PINNED, "other signs")
    return Chapter(
        text=(
            f"{scale.journeys} journeys, {PER_KM} surveyed signs to a kilometre, far from each other; they are left "
            "out of all figures.",
        ),
        tables=(Table("control", columns, tuple(rows)),),
        plots={"control": plot_bars(bars, x="mean absolute corner error [m]")},
    )


def _pairs(scale: Scale) -> list[tuple[MeasureMap, MeasureMap]]:
    signs = max(round(PER_KM * scale.road.length_m / 1000), 1)
    drives = [scale.drives(seed) for seed in range(scale.curve_seeds)]
    return [
        (MeasureMap(d, scale.journeys), MeasureMap(d, scale.journeys, control=signs))
        for d in drives
    ]


STUDY = Study("control", "Control signs", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
