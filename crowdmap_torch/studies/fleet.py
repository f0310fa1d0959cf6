"""What real fleets get wrong: each error alone, all of them together, with and without calibration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain

from crowdmap_torch.adjustment.calibration import CalibrationConfig
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.simulate.dataset import SimulationConfig
from crowdmap_torch.simulate.errors import ALL, ERRORS, VEHICLES, with_errors
from crowdmap_torch.studies.chapter import Cell, Chapter, Table
from crowdmap_torch.studies.curves import plot_bars
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.honesty import over_all_sets, values_of
from crowdmap_torch.studies.maps import OURS, in_short_turns, in_turns, our_maps
from crowdmap_torch.studies.numbers import Result, numbers, results, spread_of, weighted_mean
from crowdmap_torch.studies.recovered import recovered_table
from crowdmap_torch.studies.scale import Scale
from crowdmap_torch.studies.study import Settings, Study
from crowdmap_torch.studies.tasks import MeasureMap, Task

CALIBRATIONS: Mapping[str, MapperConfig] = {
    "off": replace(OURS, calibration=CalibrationConfig.off()),
    "on": OURS,
}
"""Configurations that are compared, by what the column `calibration` says of them; `off` is what others are held to."""
NONE = "none"
_FACTORS = (1.0, 2.0)
_COVERED = (0.9, 0.98)
"""Where the share of sign centres inside their ellipsoids is to lie."""
_RELATIVE = "map.signs.relative.total.mean"
_HEADS = "heads.signs.relative.total.mean"
_LATERAL = "map.lanes.lateral_without_shift.mean"
_NUMBERS = {
    "relative [m]": _RELATIVE,
    "absolute [m]": "map.signs.absolute.total.mean",
    "cluster heads, relative [m]": _HEADS,
    "lane lateral [m]": _LATERAL,
    "sign recall": "map.signs.recall",
    "lane precision": "map.lanes.precision",
}
_COLUMNS = (
    "error",
    "times",
    "calibration",
    *_NUMBERS,
    "inside 95 % [%]",
    "mean NEES",
    "relative / without errors",
    "lateral / without errors",
    "seeds",
)


@dataclass(frozen=True)
class Variant:
    """Drives with some of the errors, so many times as large as they are."""

    error: str
    """A name of `ERRORS`, `fleet` for all or `none`."""
    factor: float = 1.0

    def spoil(self, drives: SimulationConfig) -> SimulationConfig:
        """The same drives with the errors."""
        return with_errors(drives, () if self.error == NONE else (self.error,), self.factor)


RIGHT, FLEET = Variant(NONE), Variant(ALL)


def variants(scale: Scale) -> tuple[Variant, ...]:
    """None, each error alone, and all of them."""
    names = scale.first(ERRORS)
    alone = (Variant(name, factor) for name in names for factor in _FACTORS[: scale.fleet_factors])
    return (RIGHT, *alone, *(Variant(ALL, factor) for factor in _FACTORS[: scale.fleet_factors]))


def tasks(settings: Settings) -> Iterator[tuple[int, Task]]:
    """A map for each variant, calibration and seed: of a few drives, on a straight road, and of the fleet as a whole."""
    scale = settings.scale
    few = (
        _few_maps(scale, variant, config)
        for variant in variants(scale)
        for config in CALIBRATIONS.values()
    )
    straight = (
        _few_maps(scale, variant, config, straight=True)
        for variant in (RIGHT, FLEET)
        for config in CALIBRATIONS.values()
    )
    whole = (
        task
        for variant in (RIGHT, FLEET)
        for config in CALIBRATIONS.values()
        for task in _whole_maps(scale, variant, config)
    )
    honest = in_short_turns(4, (_honest_maps(scale),))
    return chain(
        in_short_turns(4, few), in_short_turns(4, straight), honest, in_turns(scale, whole)
    )


def chapter(settings: Settings, folder: StudyFolder) -> Chapter:
    """What each error does to the map, and what calibration takes back of it."""
    scale = settings.scale
    every = {
        (variant, name): results(_few_maps(scale, variant, config), folder)
        for variant in variants(scale)
        for name, config in CALIBRATIONS.items()
    }
    pair = [(v, name, config) for v in (RIGHT, FLEET) for name, config in CALIBRATIONS.items()]
    straight = {
        (v, name): results(_few_maps(scale, v, config, straight=True), folder)
        for v, name, config in pair
    }
    whole = {(v, name): results(_whole_maps(scale, v, config), folder) for v, name, config in pair}
    few = f"{scale.fleet_journeys} drives of {scale.fleet_vehicles} vehicles"
    return Chapter(
        text=(
            f"{few} over {scale.fleet_road.length_m:.0f} m, the same drives each time: every error alone as large as real "
            "ones are and twice as large, then all of them. Means over seeds. Inside: sign centres in their 95 % ellipsoid, "
            "of all seeds together, beside the mean normalised squared error (3 is right). Without errors: the same drives "
            "with perfect calibrations and detectors, `calibration: off`.",
        ),
        tables=(
            Table("fleet", _COLUMNS, _rows(every)),
            Table(
                "fleet-straight",
                _COLUMNS,
                _rows(straight),
                f"{few} over {scale.straight_road.length_m:.0f} m that are straight",
            ),
            Table(
                "fleet-whole",
                _COLUMNS,
                _rows(whole),
                f"{scale.journeys} drives of {VEHICLES} vehicles over {scale.road.length_m:.0f} m",
            ),
            Table(
                "fleet-honest",
                ("", "found", "asked"),
                _honest(results(_honest_maps(scale), folder)),
                f"Whether maps of {few} with all errors know how wrong they are, calibration on",
            ),
            recovered_table(
                "fleet-recovered",
                whole.get((FLEET, "on"), ()),
                f"What is found of the calibrations of these {VEHICLES} vehicles, all errors together, beside their truth",
            ),
        ),
        plots={"fleet": plot_bars(_bars(every), x="mean relative corner error [m]")},
    )


def _honest_maps(scale: Scale) -> list[MeasureMap]:
    """Maps of a few drives with all errors, many seeds."""
    return _few_maps(scale, FLEET, OURS, seeds=scale.fleet_sets)


def _honest(maps: list[Result]) -> tuple[tuple[Cell, ...], ...]:
    """What covariances are held to, over all sets."""
    return (("sets", len(maps), ""), *over_all_sets(values_of(maps), _COVERED))


def _few_maps(
    scale: Scale,
    variant: Variant,
    config: MapperConfig,
    *,
    straight: bool = False,
    seeds: int | None = None,
) -> list[MeasureMap]:
    """Maps of a few drives, seed by seed."""
    return [
        MeasureMap(
            variant.spoil(scale.fleet_drives(seed, straight=straight)),
            scale.fleet_journeys,
            config=config,
        )
        for seed in range(scale.fleet_seeds if seeds is None else seeds)
    ]


def _whole_maps(scale: Scale, variant: Variant, config: MapperConfig) -> list[MeasureMap]:
    """Maps of as many drives as figures are compared at, seed by seed; those without errors other studies have too."""
    maps = our_maps(scale, scale.journeys)[: scale.whole_fleet_seeds]
    if variant != RIGHT:
        maps = [replace(task, simulation=variant.spoil(task.simulation)) for task in maps]
    return [replace(task, config=config) for task in maps]


Found = Mapping[tuple[Variant, str], list[Result]]
"""Results by variant and calibration."""


def _rows(found: Found) -> tuple[tuple[Cell, ...], ...]:
    right = found[RIGHT, "off"]
    rows = []
    for (variant, calibration), maps in found.items():
        signs = numbers(maps, "map.uncertainty.signs")
        values = {title: spread_of(maps, path).mean for title, path in _NUMBERS.items()}
        rows.append(
            (
                variant.error,
                variant.factor if variant != RIGHT else 0.0,
                calibration,
                *values.values(),
                100 * weighted_mean(numbers(maps, "map.uncertainty.coverage"), signs),
                weighted_mean(numbers(maps, "map.uncertainty.mean_nees"), signs),
                values["relative [m]"] / spread_of(right, _RELATIVE).mean,
                values["lane lateral [m]"] / spread_of(right, _LATERAL).mean,
                len(maps),
            )
        )
    return tuple(rows)


def _bars(found: Found) -> dict[str, dict[str, tuple[float, float]]]:
    """Relative errors by variant: the heads', and with each calibration."""
    bars: dict[str, dict[str, tuple[float, float]]] = {}
    for (variant, calibration), maps in found.items():
        times = f" x {variant.factor:g}" if variant != RIGHT else ""
        group = bars.setdefault(f"{variant.error}{times}", {})
        group.setdefault("cluster heads", spread_of(maps, _HEADS).bar)
        group[f"calibration {calibration}"] = spread_of(maps, _RELATIVE).bar
    return bars


STUDY = Study("fleet", "What real fleets get wrong", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
