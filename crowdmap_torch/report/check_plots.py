"""Pictures of a drive as its files have it: what a mistake of axes, units, orders or lenses looks like."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from torch import Tensor

from crowdmap_torch.geometry import polygon
from crowdmap_torch.geometry.camera import Camera, distort
from crowdmap_torch.plausibility.consistency import ConsistencyLimits, Meeting
from crowdmap_torch.plausibility.units import RawPoses
from crowdmap_torch.report.plots import BEFORE, FAINT, INK, MAP, SURVEY, WRONG, new_figure, styled
from crowdmap_torch.tables import Journey

_WIDTH, _HEIGHT = 4.4, 3.1
"""Inches: as wide as a phone, so that text is not made smaller there."""
_ARROWS = 25
_MOST_OUTLINES = 200
_MOST_POINTS = 700
_BASELINE_M = 3.0
_SHOWN_MISS = 0.06
"""Length of the longest usual arrow, as a share of the image's width."""


@styled
def plot_way(journey: Journey, meeting: Meeting | None) -> Figure:
    """A drive from above: the way, where the camera looks along it, and where rays to signs meet."""
    figure, (axes,) = new_figure(1, width=_WIDTH, height=_HEIGHT)
    p, ahead = _places(journey), journey.T_world_camera[:, :2, 2].numpy()
    axes.plot(p[:, 0], p[:, 1], color=MAP, lw=1.6, label="way")
    some = slice(None, None, -(-len(p) // _ARROWS))
    axes.quiver(
        *(p[some, 0], p[some, 1], ahead[some, 0], ahead[some, 1]),
        color=BEFORE,
        width=0.006,
        label="camera looks",
    )
    if meeting is not None:
        place = _one_of_each(meeting, meeting.point_world)
        axes.plot(place[:, 0], place[:, 1], "s", color=SURVEY, ms=4, label="signs")
    axes.plot(*p[0, :2], "o", mfc="white", mec=INK, ms=6, label="start")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x: east [m]", ylabel="y: north [m]", title="from above")
    axes.legend(loc="best", fontsize=8)
    return figure


@styled
def plot_columns(raw: RawPoses) -> Figure:
    """What can be drawn of poses that are refused: x over y as they stand, and t_ns by row."""
    figure, (plan, time) = new_figure(2, width=_WIDTH, height=1.6 * _HEIGHT, rows=2)
    plan.plot(raw.position[:, 0], raw.position[:, 1], ".-", color=MAP, ms=2, lw=0.6)
    plan.set(xlabel="x", ylabel="y", title="positions as they stand")
    time.plot(raw.t - raw.t[0], ".", color=MAP, ms=2)
    time.set(xlabel="row", ylabel="t_ns from the first", title="times as they stand")
    return figure


@styled
def plot_motion(journey: Journey) -> Figure:
    """Speed, height, and the angle between optical axis and motion, along the way."""
    figure, (speed, angle, height) = new_figure(3, width=_WIDTH, height=1.7 * _HEIGHT, rows=3)
    p = _places(journey)
    seconds = (journey.t_ns - journey.t_ns[0]).double().numpy() * 1e-9
    step = np.sqrt(np.square(np.diff(p, axis=0)).sum(-1))
    way = np.concatenate(([0.0], np.cumsum(step)))
    between = np.maximum(np.diff(seconds), 1e-9)
    speed.plot(way[1:], step / between, color=MAP, lw=1)
    speed.set(ylabel="m/s", title="speed")
    speed.set_ylim(bottom=0)
    axis, at = _axis_to_motion(journey, p, way)
    angle.plot(at, axis, color=BEFORE, lw=1.2)
    angle.axhspan(0, 40, color=SURVEY, alpha=0.1, lw=0)
    angle.set(ylabel="degrees", ylim=(0, 180), title="optical axis off the motion (green: right)")
    height.plot(way, p[:, 2], color=MAP, lw=1.2)
    height.set(xlabel="way driven [m]", ylabel="m", title="height over the origin")
    return figure


@styled
def plot_image(journey: Journey) -> Figure:
    """All detections over the image, with its border and the horizon of the calibrated road."""
    figure, axes = _image(journey.rig.camera)
    signs = journey.signs
    some = torch.arange(0, len(signs), max(1, -(-len(signs) // _MOST_OUTLINES)))
    count = polygon.CORNER_COUNT[signs.shape[some]].tolist()
    corners = signs.corners_px[some].numpy()
    outlines = [np.concatenate((own[:n], own[:1])) for own, n in zip(corners, count, strict=True)]
    axes.add_collection(LineCollection(outlines, colors=MAP, linewidths=0.7))
    px = journey.lane_points.px
    px = px[:: max(1, -(-len(px) // _MOST_POINTS))].numpy()
    axes.plot(px[:, 0], px[:, 1], ".", color=BEFORE, ms=1.5)
    for name, color in (("signs", MAP), ("lane points", BEFORE)):
        axes.plot([], [], color=color, label=name)
    line = _horizon(journey)
    axes.plot(line[:, 0], line[:, 1], color=WRONG, lw=1.2, label="horizon by rig.yaml")
    axes.plot(*journey.rig.camera.K[:2, 2].tolist(), "+", color=INK, ms=9)
    axes.set_title("detections in the image")
    axes.legend(loc="lower left", fontsize=8, frameon=True)
    return figure


@styled
def plot_reprojection(journey: Journey, meeting: Meeting) -> Figure:
    """Where signs were detected, and an arrow to where all frames together put them."""
    figure, axes = _image(journey.rig.camera)
    some = slice(None, None, max(1, -(-len(meeting.sign) // _MOST_OUTLINES)))
    px = meeting.detected_px[some].numpy()
    off = meeting.projected_px[some].numpy() - px
    miss = np.sqrt(np.square(off).sum(-1))
    usual = float(np.median(miss))
    longest = max(float(np.percentile(miss, 90)), 1e-6)
    times = _SHOWN_MISS * journey.rig.camera.width / longest
    axes.quiver(
        *(px[:, 0], px[:, 1], off[:, 0], off[:, 1]),
        angles="xy",
        scale_units="xy",
        scale=1 / times,
        color=MAP,
        width=0.003,
    )
    axes.plot(px[:, 0], px[:, 1], ".", color=INK, ms=2)
    axes.set_title(f"re-projected signs: {usual:.1f} px off (arrows x {times:.0f})")
    return figure


@styled
def plot_scale(journey: Journey, meeting: Meeting) -> Figure:
    """How large signs are by the distances that poses say, and where signs are usual."""
    figure, (axes,) = new_figure(1, width=_WIDTH, height=0.8 * _HEIGHT)
    size = _one_of_each(meeting, meeting.size[:, None])[:, 0]
    low, high = ConsistencyLimits().usual_m
    edges = np.geomspace(min(0.05, size.min() / 1.5), max(20.0, size.max() * 1.5), 30)
    axes.axvspan(low, high, color=SURVEY, alpha=0.15, lw=0, label="usual")
    axes.hist(size, edges.tolist(), color=MAP, label="signs here")
    axes.set_xscale("log")
    axes.set(xlabel="larger side of each sign [m]", ylabel="signs", title="scale")
    axes.legend(loc="upper right", fontsize=8)
    return figure


def _image(camera: Camera):
    shape = min(max(camera.height / camera.width, 0.3), 1.5)
    figure, (axes,) = new_figure(1, width=_WIDTH, height=_WIDTH * shape + 0.5)
    w, h = camera.width, camera.height
    axes.plot([0, w, w, 0, 0], [0, 0, h, h, 0], color=FAINT, lw=1)
    axes.set(
        xlim=(-0.04 * w, 1.04 * w), ylim=(1.04 * h, -0.04 * h), xlabel="u [px]", ylabel="v [px]"
    )
    return figure, axes


def _horizon(journey: Journey) -> Float[np.ndarray, "k 2"]:
    """Where the plane through the camera that is parallel to the road cuts the image."""
    camera, n = journey.rig.camera, journey.rig.road_normal_camera
    if abs(float(n[1])) < 0.2:
        return np.full((1, 2), math.nan)
    half = 1.2 * float(camera.width / camera.K[0, 0]) / 2
    x = torch.linspace(-half, half, 60, dtype=n.dtype)
    px = distort(camera, torch.stack((x, -(n[0] * x + n[2]) / n[1]), dim=-1)).numpy()
    inside = (px >= 0) & (px <= np.array([camera.width, camera.height]))
    return np.where(inside.all(-1, keepdims=True), px, math.nan)


def _axis_to_motion(
    journey: Journey, p: Float[np.ndarray, "f 3"], way: Float[np.ndarray, " f"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """The angle between optical axis and motion [deg], and where on the way it is so."""
    after = np.searchsorted(way, way + min(_BASELINE_M, way[-1] / 10))
    has = after < len(way)
    motion = p[after[has]] - p[has]
    motion /= np.maximum(np.sqrt(np.square(motion).sum(-1, keepdims=True)), 1e-9)
    axis = journey.T_world_camera[:, :3, 2].numpy()[has]
    return np.degrees(np.arccos((axis * motion).sum(-1).clip(-1, 1))), way[has]


def _places(journey: Journey) -> Float[np.ndarray, "f 3"]:
    return journey.T_world_camera[:, :3, 3].numpy()


def _one_of_each(meeting: Meeting, values: Float[Tensor, "m k"]) -> Float[np.ndarray, "n k"]:
    """The median over the views of each sign."""
    return np.array(
        [values[meeting.sign == s].median(0).values.tolist() for s in meeting.sign.unique()]
    )
