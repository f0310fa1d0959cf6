"""A scene as the payload of a page, within its budget: what is fixed first, then as many detections as there is room for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch

from crowdmap_torch import __version__
from crowdmap_torch.evaluation.polyline import lane_samples
from crowdmap_torch.evaluation.signs import SignComparison, compare_signs
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.tables import LANE_TYPES, HdMap, Lanes, Signs, Survey
from crowdmap_torch.viewer.columns import Column, column, packed
from crowdmap_torch.viewer.detections import OutcomeRows, frame_columns, outcome_columns
from crowdmap_torch.viewer.lines import simplified
from crowdmap_torch.viewer.scene import Drive, Scene

PLACE_STEP_M = 1e-3
"""Places of signs and markers are kept in whole millimetres."""
PATH_STEP_M = 1e-2
"""Those of drives in centimetres."""
LINE_TOLERANCE_M = 0.01
"""Points of markers that lie this near to the line between their neighbours are left out."""
_PATH_TOLERANCES_M = (0.05, 0.25, 1.0, 4.0)
_QUATERNION_STEP = 1 / 32767
_LANE_STEP_M = 1.0
BUDGET = 100_000
"""Bytes of a page, its code left out, for every kilometre of lane; of less than a kilometre as of one."""
_ENCODED = 4 / 3
_COUNTS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
"""Most detections of a sign by one drive, or most frames of 64, that may be kept."""


def payload_of(scene: Scene) -> bytes:
    """The payload: as much of the scene's detections as the budget has room for, said in its head."""
    budget = int(BUDGET * max(lane_km(scene), 1.0) / _ENCODED)
    finest, *coarser = _PATH_TOLERANCES_M
    head, columns = _fixed(scene, finest)
    for tolerance in coarser:
        if len(packed(head, columns)) <= 0.7 * budget:
            break
        head, columns = _fixed(scene, tolerance)
    best = _with_detections(scene, head, columns, 0)
    # What is fixed is kept in any case; of detections the most that there is room for.
    low, high = 0, len(_COUNTS) - 1
    while low < high:
        middle = (low + high + 1) // 2
        tried = _with_detections(scene, head, columns, _COUNTS[middle])
        if len(tried) <= budget:
            best, low = tried, middle
        else:
            high = middle - 1
    return best


def lane_km(scene: Scene) -> float:
    """Kilometres of lane: two markers make one; of a data set, the way that all drives went."""
    if scene.hd_map is not None and len(scene.hd_map.lanes):
        return _marker_m(scene.hd_map.lanes) / 2000
    ways = [float(_steps(drive.path_world.numpy()).sum()) for drive in scene.drives]
    if not ways:
        return 1.0
    return (sum(ways) if scene.kind == "dataset" else max(ways)) / 1000


def _marker_m(lanes: Lanes) -> float:
    samples = lane_samples(lanes, 5.0)
    same = (samples.line[1:] == samples.line[:-1]).numpy()
    return float((_steps(samples.point_world.numpy()) * same).sum())


def _steps(point: np.ndarray) -> np.ndarray:
    return np.sqrt(np.square(np.diff(point, axis=0)).sum(-1))


def _with_detections(
    scene: Scene, head: dict[str, object], columns: dict[str, Column], most: int
) -> bytes:
    told = dict(head)
    found: dict[str, Column] = {}
    if scene.outcomes is not None and scene.hd_map is not None:
        rows = OutcomeRows.of(scene)
        drawn, found = outcome_columns(scene, rows, most)
        told["fates"] = list(scene.outcomes.fate)
        told["drawn"] = [drawn, len(rows.rows)]
    elif scene.journeys:
        drawn, found = frame_columns(scene, most)
        told["drawn"] = [drawn, sum(j.frame_count for j in scene.journeys)]
    return packed(told, {**columns, **found})


def _fixed(scene: Scene, path_tolerance: float) -> tuple[dict[str, object], dict[str, Column]]:
    """Head and columns of everything but detections."""
    hd_map, survey = scene.hd_map, scene.survey
    columns: dict[str, Column] = {}
    head: dict[str, object] = {
        "kind": scene.kind,
        "title": scene.title,
        "subtitle": scene.subtitle,
        "version": __version__,
        "origin": [scene.origin.lat_deg, scene.origin.lon_deg, scene.origin.height_m],
        "shapes": list(polygon.SHAPES),
        "templates": _templates(),
        "lane_types": list(LANE_TYPES),
        "type_names": list(scene.type_names if hd_map is None else hd_map.type_names),
        "drives": [_told(drive) for drive in scene.drives],
        "notes": list(scene.notes),
        "precision": {"place_m": PLACE_STEP_M / 2, "line_m": LINE_TOLERANCE_M},
    }
    if hd_map is not None:
        head["sign_id"], head["lane_id"] = list(hd_map.sign_id), list(hd_map.lane_id)
        head["shared_covariance"] = hd_map.shared_covariance.flatten().tolist()
        head["provenance"] = {k: v for k, v in hd_map.provenance.items() if isinstance(v, str)}
        columns |= dict(_map_columns("", hd_map))
    if scene.map_before is not None:
        head["before_id"] = list(scene.map_before.sign_id)
        columns |= dict(_map_columns("before.", scene.map_before))
    if survey is not None:
        head["survey_id"] = list(survey.sign_id)
        columns |= dict(_survey_columns(survey))
        if hd_map is not None:
            columns |= dict(_error_columns(hd_map, compare_signs(hd_map.signs, survey.signs)))
    columns |= dict(_drive_columns(scene.drives, path_tolerance))
    return head, columns


def _templates() -> list[list[float]]:
    """Corners of each shape for width and height one, x right and y up."""
    every = torch.arange(len(polygon.SHAPES))
    count = polygon.corner_count(every).tolist()
    return [
        corners[:n].flatten().tolist()
        for corners, n in zip(polygon.template(every), count, strict=True)
    ]


def _told(drive: Drive) -> dict[str, object]:
    told: dict[str, object] = {"id": drive.journey_id, "frames": len(drive.frame_number)}
    told |= {"vehicle": drive.vehicle} if drive.vehicle else {}
    told |= {"image": list(drive.image)} if drive.image else {}
    told |= {"remark": drive.remark} if drive.remark else {}
    if drive.bias is not None and np.isfinite(drive.bias).all():
        told["bias"] = [round(x, 4) for x in drive.bias]
        if drive.bias_sigma is not None and np.isfinite(drive.bias_sigma).all():
            told["bias_sigma"] = [round(x, 4) for x in drive.bias_sigma]
    if len(drive.t_ns):
        told["begin_s"] = int(drive.t_ns[0]) // 10**9
        told["end_s"] = int(drive.t_ns[-1]) // 10**9
    way = _steps(drive.path_world.numpy())
    told["length_m"] = round(float(way.sum()), 1)
    return told


def _map_columns(prefix: str, hd_map: HdMap) -> Iterator[tuple[str, Column]]:
    signs, lanes = hd_map.signs, hd_map.lanes
    yield from _plates(f"{prefix}sign", signs)
    upper = signs.covariance[:, *np.triu_indices(3)]
    yield f"{prefix}sign.covariance", column(upper, 0)
    point, sigma, count = [], [], []
    samples = lane_samples(lanes, _LANE_STEP_M)
    for mine in _rows_by_line(samples.line.numpy(), len(lanes)):
        line, of_line = samples.point_world.numpy()[mine], samples.sigma.numpy()[mine]
        kept = simplified(line, LINE_TOLERANCE_M)
        point.append(line[kept])
        sigma.append(of_line[kept])
        count.append(len(kept))
    yield f"{prefix}lane.type", column(lanes.type)
    yield f"{prefix}lane.count", column(np.array(count, dtype=int))
    yield f"{prefix}lane.point", column(_stacked(point), PLACE_STEP_M, "rows")
    if prefix:
        return
    yield "lane.sigma", column(np.concatenate([np.zeros(0), *sigma]), PLACE_STEP_M, "rows")
    for name, table in (("sign", signs), ("lane", lanes)):
        yield f"{name}.journeys", column(table.n_journeys)
        yield f"{name}.observations", column(table.n_observations)
        yield f"{name}.first_s", column(table.first_seen_ns // 10**9)
        yield f"{name}.last_s", column(table.last_seen_ns // 10**9)
        yield f"{name}.confidence", column(table.confidence, 1e-4)


def _plates(prefix: str, signs: Signs) -> Iterator[tuple[str, Column]]:
    yield f"{prefix}.shape", column(signs.shape)
    yield f"{prefix}.type", column(signs.type)
    yield f"{prefix}.center", column(signs.center_world, PLACE_STEP_M)
    rotation = se3.to_quaternion(signs.T_world_sign[:, :3, :3])
    yield f"{prefix}.quaternion", column(rotation, _QUATERNION_STEP)
    yield f"{prefix}.size", column(signs.size, PLACE_STEP_M)


def _survey_columns(survey: Survey) -> Iterator[tuple[str, Column]]:
    signs = survey.signs
    yield "survey.shape", column(signs.shape)
    yield "survey.center", column(signs.center_world, PLACE_STEP_M)
    # Corners from the centre; all zero where none were surveyed.
    away = (signs.corners_world - signs.center_world[:, None]).nan_to_num(0.0)
    yield "survey.corner", column(away, PLACE_STEP_M)
    lane, point = survey.lane_points.lane.numpy(), survey.lane_points.point_world.numpy()
    lines = (point[mine] for mine in _rows_by_line(lane, len(survey.lane_id)))
    lines = [line[simplified(line, LINE_TOLERANCE_M)] for line in lines]
    yield "survey.lane.type", column(survey.lane_type)
    yield "survey.lane.count", column(np.array([len(line) for line in lines], dtype=int))
    yield "survey.lane.point", column(_stacked(lines), PLACE_STEP_M, "rows")


def _error_columns(hd_map: HdMap, comparison: SignComparison) -> Iterator[tuple[str, Column]]:
    """Of every sign of the map its surveyed one (-1: duplicate, -2: false), and by how much it is off."""
    error = np.zeros((len(hd_map.signs), 3))
    off, row = np.full(len(error), -1.0), comparison.map_row.numpy()
    error[row] = comparison.center_error_world[:, 0].numpy()
    off[row] = comparison.error_m("absolute").numpy()
    yield "sign.true", column(comparison.match.true_of_map)
    yield "sign.error", column(error, PLACE_STEP_M)
    yield "sign.error_m", column(off, PLACE_STEP_M)


def _drive_columns(drives: Sequence[Drive], tolerance: float) -> Iterator[tuple[str, Column]]:
    for name, paths in (
        ("path", [drive.path_world for drive in drives]),
        ("given", [drive.given_world for drive in drives]),
    ):
        lines = [np.zeros((0, 3)) if path is None else path.numpy() for path in paths]
        lines = [line[simplified(line, tolerance)] for line in lines]
        if any(len(line) for line in lines):
            yield f"{name}.count", column(np.array([len(line) for line in lines], dtype=int))
            yield f"{name}.point", column(_stacked(lines), PATH_STEP_M, "rows")


def _rows_by_line(line: np.ndarray, lines: int) -> list[np.ndarray]:
    """The rows of each of so many lines, in their order."""
    ends = np.bincount(line, minlength=lines).cumsum()
    return np.split(np.argsort(line, kind="stable"), ends[:-1])[:lines]


def _stacked(lines: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.zeros((0, 3)), *lines])
