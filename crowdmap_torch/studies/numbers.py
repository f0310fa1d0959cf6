"""Numbers of results put together: means over maps and seeds, with their spread."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.tasks import Task

Result = Mapping[str, Any]


@dataclass(frozen=True)
class Spread:
    """A mean over maps, and how much they differ; NaN of nothing."""

    mean: float
    std: float
    """1-sigma over the maps."""
    low: float
    high: float
    count: int

    @property
    def bar(self) -> tuple[float, float]:
        """Mean and 1-sigma, as they are drawn."""
        return self.mean, self.std


def results(tasks: Iterable[Task], folder: StudyFolder) -> list[Result]:
    """What is measured of `tasks`, in their order."""
    return [folder.read_result(task.key) for task in tasks if folder.has_result(task.key)]


def number(result: Result, path: str) -> float:
    """A number by its path of keys with dots between; NaN where it is unknown."""
    value: Any = result
    for key in path.split("."):
        if value is None or key not in value:
            return math.nan
        value = value[key]
    return math.nan if value is None else float(value)


def numbers(found: Sequence[Result], path: str) -> list[float]:
    """The number of each result."""
    return [number(result, path) for result in found]


def spread(values: Sequence[float]) -> Spread:
    """Mean and spread of what is known."""
    known = np.array([v for v in values if math.isfinite(v)])
    if len(known) == 0:
        return Spread(math.nan, math.nan, math.nan, math.nan, 0)
    return Spread(
        float(known.mean()), float(known.std()), float(known.min()), float(known.max()), len(known)
    )


def spread_of(found: Sequence[Result], path: str) -> Spread:
    """Mean and spread of the number at a path."""
    return spread(numbers(found, path))


def spreads(found: Sequence[Result], paths: Mapping[str, str]) -> dict[str, Spread]:
    """Mean and spread of the number at each path, by its title."""
    return {title: spread_of(found, path) for title, path in paths.items()}


def pooled_std(found: Sequence[Result], path: str) -> float:
    """1-sigma over the landmarks of all maps together, from each map's own mean, spread and count."""
    mean, std, count = (
        np.array(numbers(found, f"{path}.{part}")) for part in ("mean", "std", "count")
    )
    known = np.isfinite(mean) & np.isfinite(std) & (count > 0)
    if not known.any():
        return math.nan
    mean, std, count = mean[known], std[known], count[known]
    middle = np.average(mean, weights=count)
    return math.sqrt(float(np.average(std**2 + (mean - middle) ** 2, weights=count)))


def weighted_mean(values: Sequence[float], weights: Sequence[float]) -> float:
    """The mean of values that count differently, those left out that are unknown (NaN); NaN of nothing."""
    known = [(v, w) for v, w in zip(values, weights, strict=True) if not math.isnan(v)]
    total = sum(w for _, w in known)
    return sum(v * w for v, w in known) / total if total else math.nan


def seconds(found: Sequence[Result]) -> float:
    """Seconds of a core that the results took."""
    total = 0.0
    for result in found:
        spent = result["seconds"]
        total += sum(spent.values()) if isinstance(spent, Mapping) else float(spent)
    return total
