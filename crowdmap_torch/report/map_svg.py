"""The map from above as an SVG to zoom and pan: metres east to the right, north up."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from html import escape

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.evaluation.polyline import lane_samples
from crowdmap_torch.geometry import polygon
from crowdmap_torch.report.plots import BEFORE, FAINT, MAP, SURVEY, WRONG
from crowdmap_torch.report.record import RunRecord
from crowdmap_torch.tables import Survey

_LANE_STEP_M = 2.0
_PATH_STEP_M = 5.0
_NORMAL_M = 1.2
"""Length of the stroke that shows where a sign faces."""
_LANES = "#7fa3e6"
"""The map's own colour, paler, so that signs stand out."""
_RATIO = 540 / 1110
"""Height of the drawing over its width."""


def map_svg(record: RunRecord) -> str:
    """An SVG element and the controls around it; `assets.SCRIPT` moves it."""
    layers = [layer for layer in _layers(record) if layer[3]]
    turn, (x, y, width, height) = _view(record)
    groups = "".join(f'<g id="layer-{name}">{content}</g>' for name, _, _, content in layers)
    boxes = "".join(
        f'<label><input type="checkbox" value="layer-{name}" checked>'
        f'<em style="background:{color}"></em>{escape(label)}</label>'
        for name, label, color, _ in reversed(layers)
    )
    return (
        '<div class="box map">'
        f'<svg style="--k:{width / 1110:.4f}" role="img" '
        f'viewBox="{x:.2f} {y:.2f} {width:.2f} {height:.2f}" '
        'aria-label="the map from above">'
        f'<g id="world" transform="rotate({turn:.3f})">{groups}</g></svg>'
        f'<svg class="north" viewBox="-15 -15 30 30" style="transform:rotate({turn:.1f}deg)">'
        '<path d="M0 -13L4 -3L0 -5L-4 -3Z"/><text y="10" text-anchor="middle">N</text></svg>'
        f'<div class="layers">{boxes}</div>'
        '<div class="buttons"><button data-zoom="0.6" title="nearer">+</button>'
        '<button data-zoom="1.667" title="further">&minus;</button>'
        '<button data-zoom="0" title="the whole map">all</button></div>'
        '<div class="tip">drag to move, wheel to zoom, hover over a sign</div>'
        '<div class="scale"><span></span></div></div>'
    )


def _layers(record: RunRecord) -> Iterator[tuple[str, str, str, str]]:
    """Name, label, colour and content of each layer, the lowest first."""
    paths = "".join(
        f'<path d="{_polyline(_thin(path, _PATH_STEP_M))}"/>'
        for path in record.paths_world.values()
    )
    yield "paths", "journeys", FAINT, _group(paths, FAINT, 1, opacity=0.45)
    survey, hd_map = record.survey, record.hd_map
    if survey is not None:
        lines = _polylines(survey.lane_points.lane, survey.lane_points.point_world, 1.0)
        yield "survey-lanes", "survey lanes", SURVEY, _group(lines, SURVEY, 5, opacity=0.35)
    samples = lane_samples(hd_map.lanes, _LANE_STEP_M)
    lines = _polylines(samples.line, samples.point_world, 0.0)
    yield "lanes", "map lanes", _LANES, _group(lines, _LANES, 1.2)
    if survey is not None:
        yield "survey-signs", "survey signs", SURVEY, _survey_signs(survey)
    if record.map_before is not None:
        before = _dots(record.map_before.signs.center_world, BEFORE, 4.5, ring_px=1.5)
        yield "before", "cluster heads", BEFORE, before
    comparison = record.comparison
    if comparison is not None and survey is not None:
        errors = _segments(
            hd_map.signs.center_world[comparison.map_row, :2],
            survey.signs.center_world[comparison.true_row, :2],
        )
        yield "errors", "sign errors", WRONG, _group(errors, WRONG, 1.5)
    yield "signs", "map signs", MAP, _map_signs(record)


def _group(content: str, color: str, width: float, *, opacity: float = 1.0) -> str:
    if not content:
        return ""
    return (
        f'<g stroke="{color}" stroke-width="{width:g}" stroke-opacity="{opacity:g}" fill="none">'
        f"{content}</g>"
    )


def _map_signs(record: RunRecord) -> str:
    """A dot and a plate for each sign, with what it is when the pointer rests on it."""
    hd_map = record.hd_map
    signs = hd_map.signs
    titles = [
        f"{name}: {polygon.SHAPES[shape].replace('_', ' ')}, {up:.1f} m up"
        for name, shape, up in zip(
            hd_map.sign_id, signs.shape.tolist(), signs.center_world[:, 2].tolist(), strict=True
        )
    ]
    half = signs.T_world_sign[:, :2, 0] * signs.size[:, :1] / 2
    at = signs.center_world[:, :2]
    plates = _segments(at - half, at + half)
    normals = _segments(at, at + _NORMAL_M * signs.normal_world[:, :2])
    return (
        _group(plates, MAP, 3)
        + _group(normals, MAP, 1, opacity=0.8)
        + _dots(signs.center_world, MAP, 3.5, titles=titles)
    )


def _survey_signs(survey: Survey) -> str:
    center = survey.signs.center_world
    known = survey.signs.has_corners & survey.signs.normal_world.isfinite().all(-1)
    rings = _dots(center, SURVEY, 7, ring_px=1.8, titles=survey.sign_id)
    # A plate from above is the line along its corners that are furthest apart.
    corners = survey.signs.corners_world[known][..., :2]
    if len(corners) == 0:
        return rings
    across = survey.signs.normal_world[known][:, [1, 0]] * corners.new_tensor([-1.0, 1.0])
    place = (corners * across[:, None]).sum(-1)
    row = torch.arange(len(corners), device=corners.device)
    ends = [corners[row, pick] for pick in (place.argmin(-1), place.argmax(-1))]
    return rings + _group(_segments(*ends), SURVEY, 3)


def _polylines(line: Int[Tensor, " p"], point_world: Float[Tensor, "p 3"], step_m: float) -> str:
    _, count = torch.unique_consecutive(line, return_counts=True)
    parts = point_world.split(count.tolist()) if len(point_world) else ()
    return "".join(f'<path d="{_polyline(_thin(p, step_m))}"/>' for p in parts)


def _thin(point_world: Float[Tensor, "p 3"], step_m: float) -> Float[Tensor, "q 3"]:
    """Points at least about `step_m` apart, the last one included."""
    if len(point_world) < 3 or step_m <= 0:
        return point_world
    length = (point_world[1:] - point_world[:-1]).norm(dim=-1).cumsum(0)
    number = torch.cat((length.new_zeros(1), length)).div(step_m).floor()
    keep = torch.ones_like(number, dtype=torch.bool)
    keep[1:-1] = number[1:-1] != number[:-2]
    return point_world[keep]


def _polyline(point_world: Float[Tensor, "p 3"]) -> str:
    return "M" + "L".join(f"{x:.2f} {-y:.2f}" for x, y, *_ in point_world.tolist())


def _segments(start: Float[Tensor, "n 2"], end: Float[Tensor, "n 2"]) -> str:
    pairs = zip(start.tolist(), end.tolist(), strict=True)
    strokes = "".join(f"M{a:.3f} {-b:.3f}L{c:.3f} {-d:.3f}" for (a, b), (c, d) in pairs)
    return f'<path d="{strokes}"/>' if strokes else ""


def _dots(
    center_world: Float[Tensor, "n 3"],
    color: str,
    radius_px: float,
    *,
    ring_px: float = 0.0,
    titles: Sequence[str] = (),
) -> str:
    """Dots, or rings, of the same size on the screen at every zoom (`--k` is metres a pixel)."""
    names = [f"<title>{escape(t)}</title>" for t in titles] or [""] * len(center_world)
    circles = "".join(
        f'<circle cx="{x:.3f}" cy="{-y:.3f}">{name}</circle>'
        for (x, y, _), name in zip(center_world.tolist(), names, strict=True)
    )
    # A ring is filled with nothing that shows, so that the pointer need not hit its rim.
    paint = f'fill="{color}"'
    if ring_px:
        paint = f'fill="{color}" fill-opacity="0.08" stroke="{color}" stroke-width="{ring_px:g}"'
    return f'<g {paint} style="--r:{radius_px:g}">{circles}</g>' if circles else ""


def _view(record: RunRecord) -> tuple[float, tuple[float, float, float, float]]:
    """The turn of the drawing [deg clockwise], and what it shows at first: the map with a margin.

    A road lies along the wider side of the page where that makes it at least a third larger.
    """
    parts = [record.hd_map.signs.center_world, record.hd_map.lanes.control.point_world]
    if sum(len(p) for p in parts) == 0 and record.survey is not None:
        parts = [record.survey.signs.center_world, record.survey.lane_points.point_world]
    points = torch.cat([p[:, :2].cpu() for p in parts]) * torch.tensor([1.0, -1.0])
    if len(points) == 0:
        points = torch.zeros(1, 2, dtype=torch.float64)
    level = _frame(points)
    _, _, axes = torch.linalg.svd(points - points.mean(0), full_matrices=False)
    slope = math.atan2(float(axes[0, 1]), float(axes[0, 0]))
    # Between -90 and 90 degrees, so that no map stands on its head.
    turn = -math.remainder(slope, math.pi)
    rotation = points.new_tensor(
        [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
    )
    along = _frame(points @ rotation.mT)
    return (math.degrees(turn), along) if along[2] * 1.33 < level[2] else (0.0, level)


def _frame(point: Float[Tensor, "n 2"]) -> tuple[float, float, float, float]:
    """Left, top, width and height of what shows all points of the drawing."""
    low, high = point.amin(0), point.amax(0)
    middle = (low + high) / 2
    east, north = (high - low).clamp_min(20.0).tolist()
    width = 1.1 * max(east, north / _RATIO)
    height = width * _RATIO
    return (float(middle[0]) - width / 2, float(middle[1]) - height / 2, width, height)
