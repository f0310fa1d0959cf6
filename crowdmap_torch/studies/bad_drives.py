"""One bad drive among good ones: is it found, and what does it do to the map."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from crowdmap_torch.simulate.faults import KINDS
from crowdmap_torch.studies.chapter import Chapter, Table
from crowdmap_torch.studies.curves import plot_bars
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.maps import in_short_turns, short_maps
from crowdmap_torch.studies.numbers import Result, results, spreads
from crowdmap_torch.studies.scale import Scale
from crowdmap_torch.studies.study import Settings, Study
from crowdmap_torch.studies.tasks import MeasureMap, Task

NONE = "none"
_NUMBERS = {
    "relative [m]": "map.signs.relative.total.mean",
    "absolute [m]": "map.signs.absolute.total.mean",
    "sign recall": "map.signs.recall",
    "sign precision": "map.signs.precision",
    "lane recall": "map.lanes.recall",
    "lane precision": "map.lanes.precision",
    "lane lateral [m]": "map.lanes.lateral_without_shift.mean",
}


def tasks(settings: Settings) -> Iterator[tuple[int, Task]]:
    """A map for each fault and seed, and one without any."""
    return in_short_turns(4, (_maps(settings.scale, kind) for kind in _kinds(settings.scale)))


def chapter(settings: Settings, folder: StudyFolder) -> Chapter:
    """What each fault does, and whether the journey was named."""
    scale, rows, bars = settings.scale, [], {}
    for kind in _kinds(scale):
        found = results(_maps(scale, kind), folder)
        values = spreads(found, _NUMBERS)
        named, wrongly = _named(found)
        means = (value.mean for value in values.values())
        rows.append((kind, f"{named} of {len(found)}" if kind != NONE else "-", wrongly, *means))
        bars[kind] = {
            "relative": values["relative [m]"].bar,
            "absolute": values["absolute [m]"].bar,
        }
    columns = ("fault", "named", "others named", *_NUMBERS)
    return Chapter(
        text=(
            f"{scale.short_journeys} journeys of {scale.short_road.length_m:.0f} m, one of them spoilt. Named: listed "
            "among `suspect_journeys`; such a journey has no say in the map. Wrong positions make the mean of the "
            "journeys worse only if the journey is not named. Bars: 1-sigma over seeds.",
        ),
        tables=(Table("bad-drives", columns, tuple(rows)),),
        plots={"bad-drives": plot_bars(bars, x="mean corner error [m]")},
    )


def _kinds(scale: Scale) -> tuple[str, ...]:
    return (NONE, *scale.first(KINDS))


def _maps(scale: Scale, kind: str) -> list[MeasureMap]:
    faults = () if kind == NONE else (kind,)
    return short_maps(scale, change=lambda drives: replace(drives, bad_drives=faults))


def _named(found: list[Result]) -> tuple[int, int]:
    """Maps that named the bad drive, and good drives that were named in all of them together."""
    named = sum(set(result["bad"]) <= set(result["outlier_journeys"]) for result in found)
    wrongly = sum(len(set(result["outlier_journeys"]) - set(result["bad"])) for result in found)
    return named, wrongly


STUDY = Study("bad-drives", "Bad drives", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
