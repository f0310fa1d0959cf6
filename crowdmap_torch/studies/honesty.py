"""Whether the map knows how wrong it is: covariances of signs, lanes and of what all journeys share."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from scipy.stats import chi2

from crowdmap_torch.studies.chapter import Chapter, Table
from crowdmap_torch.studies.curves import Line, Panel, plot_lines
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.numbers import numbers, results
from crowdmap_torch.studies.scale import SHORT_TURNS, Scale
from crowdmap_torch.studies.study import Settings, Study
from crowdmap_torch.studies.tasks import MeasureMap, Task

COVERED = (0.92, 0.98)
"""Where the share inside the 95 % ellipsoid, or inside 1.96 sigma, is to lie."""
_CENTER_FREEDOM = 3


def tasks(settings: Settings) -> Iterator[tuple[int, Task]]:
    """One map for each seed."""
    for task in _maps(settings.scale):
        yield SHORT_TURNS + task.simulation.seed, task


def chapter(settings: Settings, folder: StudyFolder) -> Chapter:
    """Coverage over all data sets, and the shared part's normalised squared error."""
    found = results(_maps(settings.scale), folder)
    signs, coverage, nees, shared, drawn, expected, lanes, length = (
        numbers(found, path)
        for path in (
            "map.uncertainty.signs",
            "map.uncertainty.coverage",
            "map.uncertainty.mean_nees",
            "map.uncertainty.shared_nees",
            "shared.drawn_nees",
            "shared.expected_nees",
            "map.lanes.sigma_coverage",
            "map.lanes.seen_length_m",
        )
    )
    sets = len(found)
    low, high = (
        (chi2.ppf((0.025, 0.975), _CENTER_FREEDOM * sets) / sets) if sets else (float("nan"),) * 2
    )
    asked = f"{100 * COVERED[0]:.0f} to {100 * COVERED[1]:.0f} %"
    rows = (
        ("sign centres inside their 95 % ellipsoid [%]", 100 * _weighted(coverage, signs), asked),
        ("their mean normalised squared error", _weighted(nees, signs), f"{_CENTER_FREEDOM}"),
        (
            "the shared part's, mean over the data sets",
            _weighted(shared, [1.0] * sets),
            f"{low:.2f} to {high:.2f}",
        ),
        (
            "the same of the draw: mean pose errors against their true sigmas",
            _weighted(drawn, [1.0] * sets),
            "",
        ),
        (
            "the shared part's, in the mean over all draws by those sigmas",
            _weighted(expected, [1.0] * sets),
            f"{_CENTER_FREEDOM}",
        ),
        ("lane points inside 1.96 sigma [%]", 100 * _weighted(lanes, length), asked),
    )
    of_sets = tuple(
        (number, int(n), 100 * c, e, s, d, 100 * line)
        for number, (n, c, e, s, d, line) in enumerate(
            zip(signs, coverage, nees, shared, drawn, lanes, strict=True)
        )
    )
    seeds = list(range(sets))
    panels = [
        Panel("share inside 95 % [%]", [
            Line("sign centres", seeds, [100 * c for c in coverage]),
            Line("lane points", seeds, [100 * c for c in lanes]),
        ]),
        Panel("normalised squared error", [
            Line("sign centres, mean", seeds, nees),
            Line("shared part", seeds, shared),
            Line("the draw", seeds, drawn),
        ]),
    ]  # fmt: skip
    scale = settings.scale
    return Chapter(
        "honesty",
        "Does the map know how wrong it is?",
        text=(
            f"{sets} data sets of {scale.honest_journeys} journeys on {scale.short_road.length_m:.0f} m of road. The mean "
            "shift of all signs is the part that all journeys share; what is left is compared with the covariances "
            "without that part. Within one data set errors go together, as they come from the slow drift of a few "
            "journeys: it has few independent errors, however many signs stand there, and single sets scatter widely. "
            "The draw: the mean of the poses' true errors against the sigmas that they were drawn from, which is what the "
            "shared part's error comes to for one who knows everything but that mean. Over all draws: what the maps state "
            "of the shared part beside those sigmas, whatever was drawn.",
        ),
        tables=(
            Table("honesty", ("", "found", "asked"), rows),
            Table(
                "honesty-sets",
                (
                    "seed",
                    "signs",
                    "inside [%]",
                    "mean NEES",
                    "shared NEES",
                    "the draw's",
                    "lanes inside [%]",
                ),
                of_sets,
            ),
        ),
        plots={"honesty": plot_lines(panels, x="seed", y="")},
    )


def _weighted(values: list[float], weights: list[float]) -> float:
    total = sum(weights)
    return (
        sum(v * w for v, w in zip(values, weights, strict=True)) / total if total else float("nan")
    )


def _maps(scale: Scale) -> list[MeasureMap]:
    return [
        MeasureMap(
            replace(scale.short_drives(seed), journeys=scale.honest_journeys), scale.honest_journeys
        )
        for seed in range(scale.honest_sets)
    ]


STUDY = Study("honesty", "Does the map know how wrong it is?", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
