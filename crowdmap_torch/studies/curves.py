"""Plots of studies: errors over the number of journeys, and bars of variants side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from crowdmap_torch.report.plots import INK, SERIES, new_figure, styled
from crowdmap_torch.studies.numbers import Spread


@dataclass(frozen=True)
class Line:
    """A line of a panel; NaN where nothing is known."""

    label: str
    x: Sequence[float]
    y: Sequence[float]
    sigma: Sequence[float] | None = None
    """Half the length of the error bars."""
    style: str = "-"


def line_of(label: str, x: Sequence[float], rows: Sequence[Spread]) -> Line:
    """A line through means, with their spread."""
    return Line(label, x, [row.mean for row in rows], [row.std for row in rows])


@dataclass(frozen=True)
class Point:
    """What somebody else has measured."""

    label: str
    x: float
    y: float


@dataclass(frozen=True)
class Panel:
    """Lines in one pair of axes."""

    title: str
    lines: Sequence[Line]
    points: Sequence[Point] = ()


@styled
def plot_lines(panels: Sequence[Panel], *, x: str, y: str, rows: int = 1) -> Figure:
    """Panels of lines; a line has one colour in all of them."""
    columns = -(-len(panels) // rows)
    figure, all_axes = new_figure(len(panels), width=4.6 * columns, height=3.2 * rows, rows=rows)
    names = list(dict.fromkeys(line.label for panel in panels for line in panel.lines))
    color = {name: SERIES[k % len(SERIES)] for k, name in enumerate(names)}
    for axes, panel in zip(all_axes, panels, strict=True):
        for line in panel.lines:
            _draw(axes, line, color[line.label])
        for point in panel.points:
            axes.plot([point.x], [point.y], "*", color=INK, ms=11, label=point.label)
        axes.set(xlabel=x, ylabel=y, title=panel.title)
        axes.set_ylim(bottom=0)
        if panel.lines or panel.points:
            axes.legend(loc="best")
    return figure


@styled
def plot_bars(groups: Mapping[str, Mapping[str, tuple[float, float]]], *, x: str) -> Figure:
    """For each group bars with their 1-sigma, the first on top; a bar's name has one colour in all of them."""
    names = list(dict.fromkeys(name for bars in groups.values() for name in bars))
    each = 0.8 / max(len(names), 1)
    height = 1.0 + max(len(groups), 2) * (0.15 + 0.17 * len(names))
    figure, (axes,) = new_figure(1, width=8.0, height=height)
    place = np.arange(len(groups))
    for k, name in enumerate(names):
        mean, sigma = np.array([bars.get(name, (np.nan, np.nan)) for bars in groups.values()]).T
        at = place + (k - (len(names) - 1) / 2) * each
        axes.barh(at, mean, each, xerr=sigma, color=SERIES[k], label=name, ecolor=INK, capsize=2)
    axes.set_yticks(place, list(groups))
    axes.invert_yaxis()
    axes.set(xlabel=x)
    if names:
        axes.legend(loc="best")
    return figure


def _draw(axes: Axes, line: Line, color: str) -> None:
    x, y = np.asarray(line.x, float), np.asarray(line.y, float)
    known = np.isfinite(y)
    sigma = None if line.sigma is None else np.asarray(line.sigma, float)[known]
    axes.errorbar(
        x[known],
        y[known],
        yerr=sigma,
        fmt=line.style,
        marker="o" if line.style == "-" else "",
        ms=3.5,
        lw=1.5,
        capsize=2.5,
        color=color,
        label=line.label,
    )
