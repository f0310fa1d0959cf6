"""Pixel noise, biases, outliers and missed detections swept, one at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

from crowdmap_torch.simulate.dataset import SimulationConfig
from crowdmap_torch.studies.chapter import Chapter, Table
from crowdmap_torch.studies.curves import Panel, line_of, plot_lines
from crowdmap_torch.studies.folder import StudyFolder
from crowdmap_torch.studies.maps import in_short_turns, short_maps
from crowdmap_torch.studies.numbers import results, spreads
from crowdmap_torch.studies.scale import Scale
from crowdmap_torch.studies.study import Settings, Study
from crowdmap_torch.studies.tasks import MeasureMap, Task


@dataclass(frozen=True)
class Sweep:
    """One thing that is varied."""

    unit: str
    default: float
    """The value that the presets have."""
    values: tuple[float, ...]
    change: Callable[[SimulationConfig, float], SimulationConfig]


def _pixels(simulation: SimulationConfig, factor: float) -> SimulationConfig:
    signs, lanes = simulation.signs, simulation.lanes
    return replace(
        simulation,
        signs=replace(signs, pixel_noise_px=factor * signs.pixel_noise_px),
        lanes=replace(lanes, lane_noise_px=factor * lanes.lane_noise_px),
    )


def _bias(simulation: SimulationConfig, factor: float) -> SimulationConfig:
    p = simulation.positioning
    bias = {f"bias_{axis}_m": factor * getattr(p, f"bias_{axis}_m") for axis in "enu"}
    return replace(simulation, positioning=replace(p, **bias))


def _outliers(simulation: SimulationConfig, share: float) -> SimulationConfig:
    return replace(
        simulation,
        signs=replace(simulation.signs, outliers=share),
        lanes=replace(simulation.lanes, lane_point_outliers=share),
    )


def _missed(simulation: SimulationConfig, share: float) -> SimulationConfig:
    return replace(
        simulation,
        signs=replace(simulation.signs, missed=share),
        lanes=replace(simulation.lanes, missed_lanes=share),
    )


SWEEPS: Mapping[str, Sweep] = {
    "pixel noise": Sweep("times the default", 1.0, (2.0, 4.0, 0.5), _pixels),
    "biases of the journeys": Sweep("times the default", 1.0, (4.0, 2.0, 0.5), _bias),
    "outliers": Sweep("share of corners and lane points", 0.01, (0.1, 0.2, 0.05), _outliers),
    "missed detections": Sweep("share", 0.06, (0.5, 0.7, 0.3), _missed),
}
"""Signs and lanes are worsened alike; the default differs a little between them (outliers 0.03, missed 0.08 of lanes).

The values in the order in which they are tried.
"""
_NUMBERS = {
    "relative [m]": "map.signs.relative.total.mean",
    "absolute [m]": "map.signs.absolute.total.mean",
    "oracle [m]": "map.oracle.total.mean",
    "cluster heads, relative [m]": "heads.signs.relative.total.mean",
    "sign recall": "map.signs.recall",
    "sign precision": "map.signs.precision",
    "data loss": "map.association.data_loss",
    "lane recall": "map.lanes.recall",
    "lane precision": "map.lanes.precision",
    "lane lateral [m]": "map.lanes.lateral_without_shift.mean",
}
_LINES = {
    "relative": "relative [m]",
    "absolute": "absolute [m]",
    "oracle": "oracle [m]",
    "lane lateral": "lane lateral [m]",
}


def tasks(settings: Settings) -> Iterator[tuple[int, Task]]:
    """A map for each value and seed; that of the defaults counts for every sweep."""
    scale = settings.scale
    swept = ((sweep, value) for sweep in _sweeps(scale).values() for value in _values(scale, sweep))
    return in_short_turns(4, (_maps(scale, sweep, value) for sweep, value in swept))


def chapter(settings: Settings, folder: StudyFolder) -> Chapter:
    """Figures over each sweep."""
    scale, rows, panels = settings.scale, [], []
    for name, sweep in _sweeps(scale).items():
        values = sorted(_values(scale, sweep))
        found = [results(_maps(scale, sweep, value), folder) for value in values]
        measured = [spreads(maps, _NUMBERS) for maps in found]
        for value, maps, row in zip(values, found, measured, strict=True):
            rows.append((name, value, *(column.mean for column in row.values()), len(maps)))
        lines = [
            line_of(label, values, [row[title] for row in measured])
            for label, title in _LINES.items()
        ]
        panels.append(Panel(f"{name} ({sweep.unit})", lines))
    return Chapter(
        text=(
            f"{scale.short_journeys} journeys of {scale.short_road.length_m:.0f} m, one thing varied at a time, signs "
            "and lanes alike. Bars: 1-sigma over seeds.",
        ),
        tables=(Table("noise", ("sweep", "value", *_NUMBERS, "seeds"), tuple(rows)),),
        plots={"noise": plot_lines(panels, x="", y="mean error [m]", rows=2)},
    )


def _sweeps(scale: Scale) -> dict[str, Sweep]:
    return dict(scale.first(SWEEPS.items()))


def _values(scale: Scale, sweep: Sweep) -> tuple[float, ...]:
    return (sweep.default, *sweep.values[: scale.noise_steps])


def _maps(scale: Scale, sweep: Sweep, value: float) -> list[MeasureMap]:
    if value == sweep.default:
        return short_maps(scale)
    return short_maps(scale, change=lambda drives: sweep.change(drives, value))


STUDY = Study("noise", "Worse detections, worse positions", tasks, chapter)
add_arguments, run = STUDY.add_arguments, STUDY.run
