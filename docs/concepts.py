"""The pictures of docs/CONCEPTS.md, drawn from a simulated data set and the run that mapped it.

`python docs/concepts.py DATA RUN` writes them beside this file; DATA and RUN are README's.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pyarrow.parquet as pq
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.io.truth import Truth, read_truth
from crowdmap_torch.report.plots import BEFORE, FAINT, INK, MAP, SERIES, SURVEY
from crowdmap_torch.tables import HdMap, Survey

FOLDER = Path(__file__).parent
_CHI95 = 5.991**0.5
"""Half axes of the ellipse that two numbers are in with 95 %, in sigmas."""
_DRIVES = 4
"""Drives whose errors are drawn."""


def main(dataset: Path, run: Path) -> None:
    """Writes the three pictures."""
    drives = load_dataset(dataset)
    survey = read_survey(dataset / "survey")
    truth = read_truth(dataset / "survey", survey, drives.journeys)
    hd_map = read_map(run / "map")
    # The sign that most detections show.
    row = int(hd_map.signs.n_observations.argmax())
    with mpl.rc_context({"font.size": 9, "font.family": "sans-serif", "axes.titlesize": 9.5}):
        for name, figure in (
            ("errors", errors(truth)),
            ("track", track(truth, run, hd_map, row)),
            ("signs", signs(run, hd_map, survey, row)),
        ):
            FigureCanvasAgg(figure)
            figure.savefig(FOLDER / f"concepts-{name}.png", dpi=96, metadata={"Software": None})


def errors(truth: Truth) -> Figure:
    """How far given positions are east of the true ones, along the way of some drives, and each drive's mean."""
    figure = Figure((8.4, 2.7), layout="constrained")
    axes = figure.subplots()
    for one, color in zip(truth.journeys[:_DRIVES], SERIES, strict=False):
        given, true = (T[:, :3, 3] for T in (one.journey.T_world_camera, one.T_world_camera))
        way = np.append(0.0, (true[1:] - true[:-1]).norm(dim=-1).cumsum(0))
        away = (given - true)[:, 0].numpy()
        axes.plot(way, away, color=color, linewidth=1.1)
        axes.axhline(away.mean(), color=color, linewidth=0.9, linestyle=(0, (4, 3)))
    _plain(axes, "way driven [m]", "east of the truth [m]")
    axes.axhline(0, color=INK, linewidth=0.8)
    return figure


def track(truth: Truth, run: Path, hd_map: HdMap, row: int) -> Figure:
    """One sign in the images of the drive that saw it most, and the rays from where that drive's camera was."""
    table = pq.read_table(run / "sign_detections.parquet").to_pandas()
    own = table[(table.sign_id == hd_map.sign_id[row]) & ~table.given_up]
    name = own.journey_id.value_counts().index[0]
    own = own[own.journey_id == name].sort_values("frame")
    (journey,) = (one.journey for one in truth.journeys if one.journey.journey_id == name)
    figure = Figure((8.4, 2.9), layout="constrained")
    image, above = figure.subplots(1, 2)
    shades = mpl.colormaps["viridis"](np.linspace(0.1, 0.9, len(own)))
    for shade, (u, v) in zip(shades, zip(own.u, own.v, strict=True), strict=True):
        image.plot(np.append(u, u[0]), np.append(v, v[0]), color=shade, linewidth=1)
    image.invert_yaxis()
    image.set_aspect("equal", adjustable="datalim")
    image.set_title("its detections in the images of one drive")
    _plain(image, "u [px]", "v [px]")
    frames = torch.isin(journey.frame_number, torch.tensor(own.frame.to_numpy()))
    places = journey.T_world_camera[frames][:, :2, 3].numpy()
    center = hd_map.signs.center_world[row, :2].numpy()
    for shade, place in list(zip(shades, places, strict=True))[::4]:
        ray = place + 1.06 * (center - place)
        above.plot(*zip(place, ray, strict=True), color=shade, linewidth=0.9)
    above.scatter(*places.T, color=shades, s=7, zorder=3)
    plate = hd_map.signs.corners_world[row, :, :2][hd_map.signs.corner_mask[row]].numpy()
    above.plot(*plate.T, color=INK, linewidth=3, solid_capstyle="butt")
    above.set_aspect("equal", adjustable="datalim")
    above.set_title("from above: where the camera was, and its rays")
    _plain(above, "east [m]", "north [m]")
    return figure


def signs(run: Path, hd_map: HdMap, survey: Survey, row: int) -> Figure:
    """One sign as every drive has it by itself, less the drives' biases, and adjusted, beside the survey."""
    bias = {
        entry["journey_id"]: np.array(entry["bias_m"])
        for entry in json.loads((run / "metrics.json").read_text())["journeys"]
    }
    center = hd_map.signs.center_world[row].numpy()
    alone = {}
    for name in bias:
        table = pq.read_table(run / "journeys" / name / "signs.parquet")
        places = np.array(table["center"].to_pylist()).reshape(-1, 3)
        away = np.linalg.norm(places + bias[name] - center, axis=1)
        if len(away) and away.min() < 1.0:
            alone[name] = places[away.argmin()]
    true = survey.signs.center_world.numpy()
    true = true[np.linalg.norm(true - center, axis=1).argmin()]
    figure = Figure((8.4, 2.2), layout="constrained")
    given, less, adjusted = panels = figure.subplots(1, 3, sharex=True, sharey=True)
    for color, (name, place) in zip(SERIES * 9, alone.items(), strict=False):
        given.scatter(*(place - true)[:2], color=color, s=28)
        less.scatter(*(place + bias[name] - true)[:2], color=color, s=28)
    adjusted.scatter(*(center - true)[:2], color=MAP, s=34, zorder=3)
    whole = hd_map.signs.covariance[row].numpy()
    for covariance, color in ((whole, MAP), (whole - hd_map.shared_covariance.numpy(), BEFORE)):
        size, turn = np.linalg.eigh(covariance[:2, :2])
        width, height = 2 * _CHI95 * np.sqrt(np.maximum(size, 0))
        angle = np.degrees(np.arctan2(turn[1, 0], turn[0, 0]))
        place = float(center[0] - true[0]), float(center[1] - true[1])
        adjusted.add_patch(Ellipse(place, width, height, angle=angle, fill=False, color=color))
    for axes, title in zip(
        panels,
        ("every drive by itself", "less each drive's bias", "adjusted, with 95 % ellipses"),
        strict=True,
    ):
        axes.plot(0, 0, "+", color=SURVEY, markersize=13, markeredgewidth=2, zorder=4)
        axes.set_title(title)
        axes.set_aspect("equal")
        _plain(axes, "east of the survey [m]", "north [m]" if axes is given else "")
    return figure


def _plain(axes: Axes, x_label: str, y_label: str) -> None:
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(color=FAINT, linewidth=0.4)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
