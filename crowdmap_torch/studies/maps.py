"""The maps that several studies look at: many drives on one road, by the number of journeys or by what is varied."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.simulate.dataset import SimulationConfig
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.numbers import Result, results
from crowdmap_torch.studies.scale import SHORT_TURNS, Scale
from crowdmap_torch.studies.tasks import MeasureMap

OURS = MapperConfig()
PAPER = MapperConfig(method="paper2017")


def short_maps(
    scale: Scale,
    config: MapperConfig = OURS,
    change: Callable[[SimulationConfig], SimulationConfig] = lambda drives: drives,
) -> list[MeasureMap]:
    """Maps of the short road, seed by seed, of drives that `change` may worsen."""
    return [
        MeasureMap(change(scale.short_drives(seed)), scale.short_journeys, config=config)
        for seed in range(scale.short_seeds)
    ]


def honest_maps(scale: Scale, sets: int) -> list[MeasureMap]:
    """Maps of more journeys on the short road, data set by data set: for what is said of their covariances."""
    return [
        MeasureMap(
            replace(scale.short_drives(seed), journeys=scale.honest_journeys), scale.honest_journeys
        )
        for seed in range(sets)
    ]


def our_maps(scale: Scale, count: int) -> list[MeasureMap]:
    """Ours of `count` journeys, seed by seed, a few other journeys each time where they are few."""
    if count == scale.journeys:
        seeds = scale.seeds
    else:
        seeds = scale.curve_seeds if count < scale.journeys else scale.most_seeds
    draws = min(scale.draws if count <= 2 else 1, scale.journeys // count or 1)
    apart = scale.journeys // draws
    return [
        MeasureMap(scale.drives(seed), count, first=apart * draw)
        for seed in range(seeds)
        for draw in range(draws)
    ]


def paper_heads(scale: Scale, count: int, *, seeds: int | None = None) -> list[MeasureMap]:
    """The cluster heads of the paper's method, of the same signs; its lanes have no part in them.

    Of a single journey it has none: singletons are discarded.
    """
    if seeds is None:
        seeds = scale.curve_seeds if count != scale.journeys else scale.preset_seeds
    return [
        MeasureMap(scale.drives(seed, lanes=False), count, config=PAPER, adjusted=False)
        for seed in range(seeds)
    ]


def curve(
    scale: Scale, maps: Mapping[int, Sequence[MeasureMap]], folder: StudyFolder
) -> dict[int, list[Result]]:
    """Results by the number of journeys, like compared with like.

    Up to the number that counts, those of the seeds alone that are done at every number.
    """
    seeds_done = [
        {task.simulation.seed for task in tasks}
        - {task.simulation.seed for task in tasks if not task.is_done(folder)}
        for count, tasks in maps.items()
        if count <= scale.journeys
    ]
    seeds = set.intersection(*seeds_done)
    return {
        count: results(
            [t for t in tasks if count > scale.journeys or t.simulation.seed in seeds], folder
        )
        for count, tasks in maps.items()
    }


def in_short_turns(
    first: int, variants: Iterable[Sequence[MeasureMap]]
) -> Iterator[tuple[int, MeasureMap]]:
    """The maps of all variants with their turns, seed after seed from turn `first` on."""
    for maps in variants:
        for task in maps:
            yield first + SHORT_TURNS * task.simulation.seed, task


def in_turns(scale: Scale, maps: Iterable[MeasureMap]) -> Iterator[tuple[int, MeasureMap]]:
    """Each with its turn: seed after seed, those at the number of journeys that counts twice as fast as the others.

    Those of the most journeys take as long as all the others of a seed, and come last of the curves.
    """
    for task in maps:
        if task.count > scale.journeys:
            yield 2 * scale.curve_seeds + task.simulation.seed, task
        else:
            yield task.simulation.seed * (1 if task.count == scale.journeys else 2), task
