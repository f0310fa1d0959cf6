"""Lane width with and without the online road normal (IV-C)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.studies.chapter import Chapter, Table
from crowdmap_torch.studies.curves import plot_bars
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.maps import OURS, in_short_turns, short_maps
from crowdmap_torch.studies.numbers import results, spread_of
from crowdmap_torch.studies.study import Settings, Study
from crowdmap_torch.studies.tasks import Task


def _with(road: str, lane: str) -> MapperConfig:
    return replace(OURS, road=replace(OURS.road, method=road), lane=replace(OURS.lane, method=lane))


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
_ALONE = "single journeys"
_STAGES = {
    _ALONE: "clean.lane_width",
    "markers of all journeys": "heads.lanes.width",
    "adjusted": "map.lanes.width",
}


def tasks(settings: Settings) -> Iterator[tuple[int, Task]]:
    """A map for each variant and seed."""
    return in_short_turns(2, (short_maps(settings.scale, c) for c in VARIANTS.values()))


def chapter(settings: Settings, folder: StudyFolder) -> Chapter:
    """Errors of the lane width after each stage."""
    widths: dict[str, dict[str, tuple[float, float]]] = {}
    seeds: dict[str, int] = {}
    for name, config in VARIANTS.items():
        maps = short_maps(settings.scale, config)
        made = results(maps, folder)
        alone = results([j for m in maps for j in m.journeys()], folder)
        seeds[name] = len(made)
        widths[name] = {
            stage: spread_of(alone if stage == _ALONE else made, f"{path}.mean").bar
            for stage, path in _STAGES.items()
        }
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
        text=(
            f"Mean error of the lane width; {scale.short_journeys} journeys of {scale.short_road.length_m:.0f} m. Each "
            "car is loaded in its own way, up to a degree, and pitches as it drives. Adjustment sees the lanes in the "
            "images again and mends part of what a wrong normal has done.",
        ),
        tables=(Table("road-normal", columns, tuple(rows)),),
        plots={"road-normal": plot_bars(widths, x="mean error of lane width [m]")},
    )


STUDY = Study("road-normal", "The road normal", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
