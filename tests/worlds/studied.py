"""Results of studies that nobody measured: every task gets the same numbers, or those of a function."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from crowdmap_torch.studies.chapter import Table
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.study import Settings
from crowdmap_torch.studies.tasks import Task


def errors(mean: float, std: float = 0.02, count: int = 10) -> dict[str, float]:
    """Figures of a set of errors."""
    return {"mean": mean, "median": mean, "p95": 2 * mean, "std": std, "count": count}


def positions(mean: float) -> dict[str, Any]:
    """Figures of positions, all of one size."""
    return {part: errors(mean) for part in ("total", "horizontal", "vertical")}


def figures(relative: float, absolute: float, *, recall: float = 0.9) -> dict[str, Any]:
    """METRICS.md's figures of a map, as a result holds them."""
    lanes = {part: errors(absolute) for part in ("lateral", "vertical", "width")}
    lanes |= {"lateral_without_shift": errors(relative), "recall": recall, "precision": 0.95}
    lanes |= {"sigma_coverage": 0.95, "seen_length_m": 100.0}
    names = {"absolute": absolute, "relative": relative}
    names |= {"absolute_center": absolute, "relative_center": relative}
    signs = {name: positions(mean) for name, mean in names.items()}
    signs |= {"recall": recall, "precision": 1.0, "observable": 10, "matched_observable": 9}
    uncertainty = {"signs": 10, "coverage": 0.95, "mean_nees": 3.0, "shared_nees": 2.0}
    return {
        "signs": signs,
        "lanes": lanes,
        "oracle": positions(absolute),
        "absolute_over_oracle": 1.0,
        "association": {"data_loss": 0.02},
        "uncertainty": uncertainty,
    }


def measured(relative: float = 0.1, absolute: float = 0.2, **others: Any) -> dict[str, Any]:
    """What `MeasureMap` leaves: the adjusted map, and cluster heads twice as far off."""
    map_figures = figures(relative, absolute)
    return {
        "map": map_figures,
        "heads": figures(2 * relative, 2 * absolute),
        "average": map_figures["signs"],
        "clusters": {"signs": 50, "left_out": 5},
        "clean": {"lane_width": errors(3 * absolute)},
        "signs": map_figures["signs"],
        "shared": {"drawn_nees": 1.0, "expected_nees": 3.0},
        "bad": [],
        "outlier_journeys": [],
        "control_points": 2,
        "seconds": {"heads": 1.0, "adjusted": 2.0},
        **others,
    }


def turned(study: Any, settings: Settings) -> list[tuple[int, Any]]:
    """The turns and the work of a study, of whatever kind its work is."""
    return list(study.tasks(settings))


def work(study: Any, settings: Settings) -> list[Any]:
    """The work of a study."""
    return [task for _, task in turned(study, settings)]


def rows(table: Table) -> list[Any]:
    """The rows of a table, of whatever kind its cells are."""
    return list(table.rows)


def fill(
    folder: StudyFolder,
    tasks: Iterable[Task],
    result: Callable[[Any], Mapping[str, Any]] = lambda task: measured(),
) -> None:
    """Writes a result for each task that leaves one, and for all that it needs."""
    for task in tasks:
        folder.write_result(task.key, result(task))
        fill(folder, task.needs(), result)
