"""Whether the map knows how wrong it is: covariances of signs, lanes and of what all journeys share."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from scipy.stats import chi2

from crowdmap_torch.studies.chapter import Cell, Chapter, Table
from crowdmap_torch.studies.curves import Line, Panel, plot_lines
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.maps import honest_maps
from crowdmap_torch.studies.numbers import Result, numbers, results, weighted_mean
from crowdmap_torch.studies.scale import SHORT_TURNS
from crowdmap_torch.studies.study import Settings, Study
from crowdmap_torch.studies.tasks import Task

COVERED = (0.92, 0.98)
"""Where the share inside the 95 % ellipsoid, or inside 1.96 sigma, is to lie."""
_CENTER_FREEDOM = 3
_NUMBERS = {
    "signs": "map.uncertainty.signs",
    "coverage": "map.uncertainty.coverage",
    "nees": "map.uncertainty.mean_nees",
    "shared": "map.uncertainty.shared_nees",
    "drawn": "shared.drawn_nees",
    "expected": "shared.expected_nees",
    "lanes": "map.lanes.sigma_coverage",
    "length": "map.lanes.seen_length_m",
}
_COLUMNS = (
    "seed",
    "signs",
    "inside [%]",
    "mean NEES",
    "shared NEES",
    "the draw's",
    "lanes inside [%]",
)
_PERCENT = ("coverage", "lanes")
Values = Mapping[str, list[float]]
"""Of each data set, by the names of `_NUMBERS`."""


def tasks(settings: Settings) -> Iterator[tuple[int, Task]]:
    """One map for each seed."""
    for task in honest_maps(settings.scale, settings.scale.honest_sets):
        yield SHORT_TURNS + task.simulation.seed, task


def chapter(settings: Settings, folder: StudyFolder) -> Chapter:
    """Coverage over all data sets, and the shared part's normalised squared error."""
    scale = settings.scale
    found = results(honest_maps(scale, scale.honest_sets), folder)
    values = values_of(found)
    return Chapter(
        text=(
            f"{len(found)} data sets of {scale.honest_journeys} journeys on {scale.short_road.length_m:.0f} m of road. "
            "The mean shift of all signs is the part that all journeys share; what is left is compared with the covariances "
            "without that part. Within one data set errors go together, as they come from the slow drift of a few "
            "journeys: it has few independent errors, however many signs stand there, and single sets scatter widely. "
            "The draw: the mean of the poses' true errors against the sigmas that they were drawn from, which is what the "
            "shared part's error comes to for one who knows everything but that mean. Over all draws: what the maps state "
            "of the shared part beside those sigmas, whatever was drawn.",
        ),
        tables=(
            Table("honesty", ("", "found", "asked"), over_all_sets(values)),
            Table("honesty-sets", _COLUMNS, _set_by_set(values)),
        ),
        plots={"honesty": plot_lines(_panels(values), x="seed", y="")},
    )


def values_of(found: Sequence[Result]) -> Values:
    """What covariances are judged by, of each data set."""
    return {
        name: [(100 if name in _PERCENT else 1) * value for value in numbers(found, path)]
        for name, path in _NUMBERS.items()
    }


def over_all_sets(
    values: Values, covered: tuple[float, float] = COVERED
) -> tuple[tuple[Cell, ...], ...]:
    """What is judged, what was found of it in the mean over all data sets, and what is asked."""
    sets = len(values["signs"])
    low, high = chi2.ppf((0.025, 0.975), _CENTER_FREEDOM * sets) / sets if sets else 2 * (math.nan,)
    asked = f"{100 * covered[0]:.0f} to {100 * covered[1]:.0f} %"
    signs, metres, alike = values["signs"], values["length"], [1.0] * sets
    judged = (
        ("sign centres inside their 95 % ellipsoid [%]", "coverage", signs, asked),
        ("their mean normalised squared error", "nees", signs, f"{_CENTER_FREEDOM}"),
        ("the shared part's, mean over the data sets", "shared", alike, f"{low:.2f} to {high:.2f}"),
        ("the same of the draw: mean pose errors against their true sigmas", "drawn", alike, ""),
        (
            "the shared part's, in the mean over all draws by those sigmas",
            "expected",
            alike,
            f"{_CENTER_FREEDOM}",
        ),
        ("lane points inside 1.96 sigma [%]", "lanes", metres, asked),
    )
    return tuple(
        (title, weighted_mean(values[name], weight), said) for title, name, weight, said in judged
    )


def _set_by_set(values: Values) -> tuple[tuple[Cell, ...], ...]:
    columns = (values[name] for name in ("signs", "coverage", "nees", "shared", "drawn", "lanes"))
    return tuple(
        (number, int(signs), *others)
        for number, (signs, *others) in enumerate(zip(*columns, strict=True))
    )


def _panels(values: Values) -> list[Panel]:
    seeds = list(range(len(values["signs"])))
    drawn = {
        "share inside 95 % [%]": {"sign centres": "coverage", "lane points": "lanes"},
        "normalised squared error": {
            "sign centres, mean": "nees",
            "shared part": "shared",
            "the draw": "drawn",
        },
    }
    return [
        Panel(title, [Line(label, seeds, values[name]) for label, name in lines.items()])
        for title, lines in drawn.items()
    ]


STUDY = Study("honesty", "Does the map know how wrong it is?", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
