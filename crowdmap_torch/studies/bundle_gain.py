"""Cluster heads against the adjusted map: the paper's bundle adjustment took 5 to 10 % off the error."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from crowdmap_torch.studies import paper
from crowdmap_torch.studies.chapter import Chapter, Table
from crowdmap_torch.studies.curves import plot_bars
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.maps import in_turns, our_maps, paper_heads
from crowdmap_torch.studies.numbers import numbers, results, spread
from crowdmap_torch.studies.scale import Scale
from crowdmap_torch.studies.study import Settings, Study
from crowdmap_torch.studies.tasks import MeasureMap, Task

_ERRORS = ("relative", "absolute")


def tasks(settings: Settings) -> Iterator[tuple[int, Task]]:
    """Both methods at the number of journeys that counts."""
    scale = settings.scale
    yield from in_turns(scale, our_maps(scale, scale.journeys))
    for task in _paper_maps(scale):
        yield 2 * task.simulation.seed + 1, task


def chapter(settings: Settings, folder: StudyFolder) -> Chapter:
    """What adjustment makes of each method's cluster heads."""
    scale = settings.scale
    made = {
        "ours": results(our_maps(scale, scale.journeys), folder),
        "paper2017": results(_paper_maps(scale), folder),
    }
    rows, bars = [], {}
    for method, found in made.items():
        for error in _ERRORS:
            before, after = (
                numbers(found, f"{stage}.signs.{error}.total.mean") for stage in ("heads", "map")
            )
            gain = spread([1 - b / a for a, b in zip(before, after, strict=True)])
            a, b = spread(before), spread(after)
            rows.append((method, error, a.mean, b.mean, gain.mean, gain.low, gain.high, gain.count))
            bars[f"{method}, {error}"] = {"cluster heads": a.bar, "adjusted": b.bar}
    low, high = paper.BUNDLE_GAIN
    columns = (
        "method",
        "error",
        "heads [m]",
        "adjusted [m]",
        "share taken off",
        "least",
        "most",
        "seeds",
    )
    return Chapter(
        text=(
            f"{scale.journeys} journeys. The paper: {low:.0%} to {high:.0%} of the error, within the error margins. "
            "paper2017 has signs alone here, without lanes.",
        ),
        tables=(Table("bundle-gain", columns, tuple(rows)),),
        plots={"bundle-gain": plot_bars(bars, x="mean corner error [m]")},
    )


def _paper_maps(scale: Scale) -> list[MeasureMap]:
    heads = paper_heads(scale, scale.journeys, seeds=scale.curve_seeds)
    return [replace(task, adjusted=True) for task in heads]


STUDY = Study("bundle-gain", "What bundle adjustment gains", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
