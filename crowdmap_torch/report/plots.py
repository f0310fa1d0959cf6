"""Figures of a run. Every function returns a matplotlib figure that no global state knows of."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any, TypeVar, cast

import matplotlib as mpl
import numpy as np
import torch
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from torch import Tensor

from crowdmap_torch.evaluation.polyline import lane_samples
from crowdmap_torch.evaluation.signs import SignComparison
from crowdmap_torch.io.atomic import atomic_file
from crowdmap_torch.tables import Dataset, HdMap, Survey

MAP, SURVEY, BEFORE, WRONG, FAINT, INK = (
    "#2563c9",
    "#178a50",
    "#d9822b",
    "#c4342d",
    "#b8c0cc",
    "#27303d",
)
"""Colours of the map, the survey, the map before adjustment, errors, what lies behind, and text."""
SERIES = (MAP, BEFORE, SURVEY, "#8a56b8", WRONG, "#3aa0a8", "#7a8594")

_CELLS_ACROSS = 24
"""Of an image, in the plot of residuals over it."""
_LEAST_IN_A_CELL = 5
_MOST_DOTS = 20_000
_MOST_NAMED = 12
"""Journeys that a legend names."""

_STYLE: dict[Any, Any] = {
    "axes.edgecolor": "#9aa4b2",
    "axes.labelcolor": INK,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.axisbelow": True,
    "axes.grid": True,
    "font.family": "sans-serif",
    "font.size": 9,
    "grid.color": "#e7ebf0",
    "legend.fontsize": 8,
    "legend.frameon": False,
    "svg.fonttype": "none",
    # Names inside an SVG follow from this and the drawing alone: the same run gives the same file.
    "svg.hashsalt": "crowdmap",
    "text.color": INK,
    "xtick.color": "#5b6675",
    "ytick.color": "#5b6675",
}

_PAGE_COLORS = {INK: "ink", "#9aa4b2": "faint", "#e7ebf0": "line", "#5b6675": "soft"}

Plot = TypeVar("Plot", bound=Callable[..., Figure])


def styled(plot: Plot) -> Plot:
    """The same function, drawing in the style of the report whatever the style of the caller."""
    return cast(Plot, mpl.rc_context(_STYLE)(plot))


@styled
def plot_map(hd_map: HdMap, survey: Survey | None = None, *, title: str = "") -> Figure:
    """A map from above, the survey under it."""
    figure, (axes,) = new_figure(1, width=9.0, height=5.0)
    if survey is not None:
        line = survey.lane_points.lane
        _draw_lines(axes, survey.lane_points.point_world, line, SURVEY, width=2.4, alpha=0.45)
        x, y = survey.signs.center_world[:, :2].cpu().unbind(-1)
        axes.plot(x, y, "o", mfc="none", mec=SURVEY, ms=7, label="survey")
    samples = lane_samples(hd_map.lanes, 2.0)
    _draw_lines(axes, samples.point_world, samples.line, MAP, width=0.9, alpha=1.0)
    center, normal = hd_map.signs.center_world.cpu(), hd_map.signs.normal_world.cpu()
    axes.plot(center[:, 0], center[:, 1], ".", color=MAP, ms=4, label="map")
    if len(center):
        axes.quiver(
            *center[:, :2].unbind(-1), *normal[:, :2].unbind(-1), color=MAP, width=0.0015, scale=60
        )
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="east [m]", ylabel="north [m]", title=title)
    if survey is not None:
        axes.legend(loc="upper right")
    return figure


@styled
def plot_dataset(dataset: Dataset) -> Figure:
    """Drives from above, as the positioning module has them."""
    figure, (axes,) = new_figure(1, width=9.0, height=5.0)
    for journey, color in zip(dataset.journeys, cycle(SERIES)):
        x, y = journey.T_world_camera[:, :2, 3].cpu().unbind(-1)
        axes.plot(x, y, color=color, lw=1.0, label=journey.journey_id)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="east [m]", ylabel="north [m]", title=f"{len(dataset.journeys)} journeys")
    if 0 < len(dataset.journeys) <= _MOST_NAMED:
        axes.legend(loc="best")
    return figure


def plot(what: HdMap | Dataset, survey: Survey | None = None) -> Figure:
    """A map, with a survey under it, or the drives of a dataset, from above; TypeError for anything else."""
    if isinstance(what, HdMap):
        return plot_map(what, survey)
    if isinstance(what, Dataset):
        return plot_dataset(what)
    raise TypeError(f"expected a map or a dataset, found {type(what).__name__}")


def sign_errors(comparison: SignComparison, name: str) -> Float[Tensor, " k"]:
    """The `absolute` or `relative` error of each matched observable sign [m]."""
    c = comparison
    return c.error_m(name)[c.counted & c.has_relative if name == "relative" else c.counted]


@dataclass(frozen=True)
class Eigengap:
    """Eigenvalues of one graph Laplacian, and how many clusters its gap said."""

    title: str
    eigenvalue: tuple[float, ...]
    """Ascending, the smallest ones."""
    clusters: int
    """The chosen gap is between this many eigenvalues and the next one."""


@styled
def plot_eigengaps(spectra: Sequence[Eigengap]) -> Figure:
    """Eigenvalues of graph Laplacians, ascending, and the gap that was chosen."""
    figure, panels = new_figure(max(len(spectra), 1), width=9.0, height=2.9)
    for axes, spectrum in zip(panels, spectra, strict=False):
        value = np.asarray(spectrum.eigenvalue)
        number = np.arange(1, len(value) + 1)
        below = number <= spectrum.clusters
        axes.plot(number[below], value[below], ".", color=MAP, ms=5)
        axes.plot(number[~below], value[~below], ".", color=FAINT, ms=5)
        if 0 < spectrum.clusters < len(value):
            low, high = value[spectrum.clusters - 1], value[spectrum.clusters]
            axes.axhspan(low, high, color=BEFORE, alpha=0.15, lw=0)
            axes.axvline(spectrum.clusters + 0.5, color=BEFORE, lw=1.2)
            axes.annotate(
                f"gap {high - low:.2f}",
                (spectrum.clusters + 0.5, (low + high) / 2),
                xytext=(5, 0),
                textcoords="offset points",
                color=BEFORE,
                va="center",
            )
        title = f"{spectrum.title}: {spectrum.clusters} clusters"
        axes.set(xlabel="number", ylabel="eigenvalue", title=title)
    return figure


@styled
def plot_residuals(residual_px: Mapping[str, Float[Tensor, " n"]]) -> Figure:
    """The share of residuals below each size, stage by stage; further left is better."""
    figure, (axes,) = new_figure(1, width=9.0, height=3.0)
    for (stage, residual), color in zip(residual_px.items(), SERIES * 9, strict=False):
        # Exact zeros have no logarithm.
        known = residual.detach().abs()[residual.isfinite()].clamp_min(1e-3).sort().values.cpu()
        if len(known) == 0:
            continue
        rank = torch.linspace(0, len(known) - 1, min(len(known), 400)).long()
        median = float(known[(len(known) - 1) // 2])
        share = (rank + 1) / len(known)
        axes.plot(known[rank], share, color=color, label=f"{stage} (median {median:.2f} px)")
    axes.set_xscale("log")
    # Exact zeros and near zeros would take most of a logarithmic axis.
    axes.set_xlim(left=1e-2)
    axes.set(xlabel="residual [px]", ylabel="share below", ylim=(0, 1.02))
    if axes.lines:
        axes.legend(loc="upper left")
    return figure


@styled
def plot_residuals_over_image(
    px: Float[Tensor, "n 2"], residual: Float[Tensor, "n 2"], size: tuple[int, int]
) -> Figure:
    """Median residual in each cell of the image, as an arrow: a pattern is a camera that is not calibrated."""
    width, height = size
    figure, (axes,) = new_figure(1, width=6.0, height=6.0 * min(height / width, 1.5))
    px, residual = px.detach().cpu(), residual.detach().cpu()
    seen = ((px >= 0) & (px < px.new_tensor([width, height]))).all(1) & residual.isfinite().all(1)
    px, residual = px[seen], residual[seen]
    cell = width / _CELLS_ACROSS
    column, row = (px / cell).long().unbind(-1)
    key = row * _CELLS_ACROSS + column
    axes.plot(*px[:: len(px) // _MOST_DOTS + 1].unbind(-1), ",", color=FAINT)
    middle, arrow = [], []
    for k in key.unique().tolist():
        own = residual[key == k]
        if len(own) >= _LEAST_IN_A_CELL:
            middle.append(((k % _CELLS_ACROSS + 0.5) * cell, (k // _CELLS_ACROSS + 0.5) * cell))
            arrow.append(own.median(0).values.tolist())
    if arrow:
        (x, y), (u, v) = zip(*middle, strict=True), zip(*arrow, strict=True)
        longest = max(float(np.hypot(u, v).max()), 1e-9)
        drawn = axes.quiver(
            x, y, u, v, angles="xy", scale_units="xy", scale=longest / cell, color=MAP, width=0.002
        )
        axes.quiverkey(drawn, 0.88, 1.05, longest, f"{longest:.2f} px", labelpos="E")
    axes.set(xlim=(0, width), ylim=(height, 0), xlabel="u [px]", ylabel="v [px]")
    axes.set_title("median residual, projected minus detected", loc="left")
    axes.set_aspect("equal")
    return figure


def svg(figure: Figure) -> str:
    """A figure as an SVG element that can stand inside HTML."""
    buffer = io.StringIO()
    with mpl.rc_context(_STYLE):
        _lay_out(figure)
        figure.savefig(buffer, format="svg", metadata={"Date": None}, transparent=True)
    text = buffer.getvalue()
    # Inside a page colours of text and axes are the page's own, and turn with it.
    for color, name in _PAGE_COLORS.items():
        text = text.replace(color, f"var(--{name}, {color})")
    return text[text.index("<svg") :]


def write_png(figure: Figure, path: Path) -> None:
    """A figure as an image file, complete or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as beside, mpl.rc_context(_STYLE):
        _lay_out(figure)
        figure.savefig(beside, format="png", dpi=130)


def pixels(figure: Figure) -> UInt8[np.ndarray, "h w 3"]:
    """A figure as an image."""
    canvas = FigureCanvasAgg(figure)
    with mpl.rc_context(_STYLE):
        _lay_out(figure)
        canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _lay_out(figure: Figure) -> None:
    """Finds once where everything is; a figure that still has this to do is drawn twice wherever it is saved."""
    if (engine := figure.get_layout_engine()) is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)


def new_figure(
    panels: int, *, width: float, height: float, rows: int = 1
) -> tuple[Figure, list[Axes]]:
    """An empty figure with panels side by side, in `rows` rows."""
    columns = -(-panels // rows)
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, [figure.add_subplot(rows, columns, k + 1) for k in range(panels)]


def _draw_lines(
    axes: Axes, point_world: Tensor, line: Tensor, color: str, *, width: float, alpha: float
) -> None:
    """Lines from above, in one collection."""
    _, count = torch.unique_consecutive(line.cpu(), return_counts=True)
    pieces = point_world[:, :2].cpu().numpy()
    parts = np.split(pieces, count.cumsum(0).numpy()[:-1]) if len(pieces) else []
    axes.add_collection(LineCollection(parts, colors=color, linewidths=width, alpha=alpha))
    axes.autoscale_view()
