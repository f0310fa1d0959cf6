"""Each idea beyond the paper switched off in turn."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.studies.chapter import Chapter, Table
from crowdmap_torch.studies.curves import plot_bars
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.maps import OURS, in_short_turns, short_maps
from crowdmap_torch.studies.numbers import results, spreads
from crowdmap_torch.studies.scale import Scale
from crowdmap_torch.studies.study import Settings, Study
from crowdmap_torch.studies.tasks import Task


def _adjusted_with(**changes: float) -> MapperConfig:
    return replace(OURS, adjust=replace(OURS.adjust, **changes))


VARIANTS: Mapping[str, MapperConfig] = {
    "ours": OURS,
    "association by the epipolar cost alone": replace(
        OURS,
        sign_association=replace(OURS.sign_association, method="paper2017"),
        lane_association=replace(OURS.lane_association, method="paper2017"),
    ),
    "signs one by one, poses as they are": replace(
        OURS, sign_triangulation=replace(OURS.sign_triangulation, method="paper2017")
    ),
    "road normal from calibration": replace(OURS, road=replace(OURS.road, method="calibration")),
    "lanes on one plane a frame": replace(OURS, lane=replace(OURS.lane, method="paper2017")),
    "clusters and biases of the paper": replace(
        OURS, crowd=replace(OURS.crowd, method="paper2017")
    ),
    "biases from mean differences": replace(
        OURS, crowd=replace(OURS.crowd, align=replace(OURS.crowd.align, method="paper2017"))
    ),
    "nothing brought back": replace(
        OURS, complete_tracks=replace(OURS.complete_tracks, reach_m=0.0)
    ),
    "adjustment without drift": _adjusted_with(drift_spacing_m=1e6),
    "adjustment without lanes": _adjusted_with(max_ground_distance_m=0.0),
    "adjustment without innovations": _adjusted_with(innovation_chance=0.0),
    "adjustment without Tukey and innovations": _adjusted_with(tukey_c=1e3, innovation_chance=0.0),
    "all of the paper": MapperConfig(method="paper2017"),
}
"""What is switched off, by what the configuration can say."""
_NUMBERS = {
    "relative [m]": "map.signs.relative.total.mean",
    "absolute / oracle": "map.absolute_over_oracle",
    "cluster heads, relative [m]": "heads.signs.relative.total.mean",
    "sign recall": "map.signs.recall",
    "sign precision": "map.signs.precision",
    "data loss": "map.association.data_loss",
    "lane recall": "map.lanes.recall",
    "lane precision": "map.lanes.precision",
    "lane lateral [m]": "map.lanes.lateral_without_shift.mean",
    "lane width [m]": "map.lanes.width.mean",
}


def variants(scale: Scale) -> dict[str, MapperConfig]:
    """Ours, and those beside it."""
    return dict(scale.first(VARIANTS.items(), beside=1))


def tasks(settings: Settings) -> Iterator[tuple[int, Task]]:
    """A map for each variant and seed."""
    return in_short_turns(
        2, (short_maps(settings.scale, c) for c in variants(settings.scale).values())
    )


def chapter(settings: Settings, folder: StudyFolder) -> Chapter:
    """The figures of each variant."""
    rows, bars = [], {}
    for name, config in variants(settings.scale).items():
        found = results(short_maps(settings.scale, config), folder)
        values = spreads(found, _NUMBERS)
        rows.append((name, *(value.mean for value in values.values()), len(found)))
        bars[name] = {
            "relative corner error": values["relative [m]"].bar,
            "lane width": values["lane width [m]"].bar,
        }
    scale = settings.scale
    return Chapter(
        text=(
            f"{scale.short_journeys} journeys of {scale.short_road.length_m:.0f} m; everything else stays ours. Means "
            "over seeds, bars 1-sigma over them.",
        ),
        tables=(Table("ablation", ("without", *_NUMBERS, "seeds"), tuple(rows)),),
        plots={"ablation": plot_bars(bars, x="mean error [m]")},
    )


STUDY = Study("ablation", "Each idea switched off", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
