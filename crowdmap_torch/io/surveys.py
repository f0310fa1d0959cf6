"""Surveys on disk: maps of which only places must be known (FORMAT.md)."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.budget import reading
from crowdmap_torch.io.datasets import read_origin
from crowdmap_torch.io.documents import Document
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.landmarks import center_of, read_corners, read_normals, read_sigma
from crowdmap_torch.io.map_heads import read_map_head
from crowdmap_torch.io.tiled_sheets import TiledFile, landmark_file, opened
from crowdmap_torch.tables import LANE_TYPES, Survey, SurveyLanePoints, SurveySigns


def read_survey(path: Path | str) -> Survey:
    """A survey; either of its two files may be missing. InputError for what breaks FORMAT.md."""
    folder = Path(path)
    with reading(inside=folder):
        return _read_survey(folder)


def _read_survey(folder: Path) -> Survey:
    head = read_map_head(folder)
    signs_path, lanes_path = survey_files(folder, head)
    sign_id, signs = read_surveyed_signs(signs_path) if signs_path else ((), _no_signs())
    lane_id, lane_type, lane_points = (), _integers(), _no_points()
    if lanes_path:
        lane_id, lane_type, lane_points = read_surveyed_lanes(lanes_path)
    return Survey(
        origin=read_origin(head),
        sign_id=sign_id,
        signs=signs,
        lane_id=lane_id,
        lane_type=lane_type,
        lane_points=lane_points,
    )


def survey_files(
    folder: Path, head: Document
) -> tuple[Path | TiledFile | None, Path | TiledFile | None]:
    """Its files of signs and of lanes, None for one that is not there; InputError if there is neither."""
    sources = [landmark_file(folder, head, kind) for kind in ("signs", "lanes")]
    signs, lanes = (
        source if isinstance(source, TiledFile) or os.path.lexists(source) else None
        for source in sources
    )
    if signs is None and lanes is None:
        rule = f"{folder}: has neither signs.parquet nor lanes.parquet; expected one"
        raise InputError(rule, "missing-file")
    return signs, lanes


def read_surveyed_signs(path: Path | TiledFile) -> tuple[tuple[str, ...], SurveySigns]:
    """Names of signs and where they are, by name. Where faults are gathered all are, and the signs are worth nothing."""
    sheet = opened(path, ("sign_id", "shape"), ("corners", "center", "normal", "sigma_m"))
    sign_id = sheet.ids("sign_id")
    shape = torch.from_numpy(sheet.codes("shape", polygon.SHAPES))
    corners, has_corners = read_corners(sheet, shape, optional=True)
    centers = sheet.points("center", optional=True)
    has_center = centers.count > 0
    sheet.refuse(
        ~has_corners & ~has_center,
        lambda row: "neither corners nor a center; expected one of them",
        code="null",
    )
    center = center_of(corners, polygon.corner_mask(shape)).numpy()
    # Corners are the better witness: where they are known the centre is their mean.
    center[has_center & ~has_corners] = centers.values[~has_corners[has_center]]
    signs = SurveySigns(
        shape=shape,
        corners_world=corners,
        center_world=torch.from_numpy(center),
        normal_world=read_normals(sheet, corners),
        sigma=torch.from_numpy(read_sigma(sheet)),
    )
    order = _by_id(sign_id)
    return tuple(sign_id[k] for k in order), signs[torch.tensor(order, dtype=torch.int64)]


def read_surveyed_lanes(
    path: Path | TiledFile,
) -> tuple[tuple[str, ...], torch.Tensor, SurveyLanePoints]:
    """Names of lane markers, their types and points, by name; faults as of signs."""
    sheet = opened(path, ("lane_id", "points"), ("type",))
    lane_id = sheet.ids("lane_id")
    points = sheet.point_lists("points")
    sheet.refuse(
        points.count < 2,
        lambda row: f"column 'points': {points.count[row]} points; expected 2 or more",
        code="point-count",
    )
    lane_type = sheet.codes("type", LANE_TYPES, optional=True)
    order = _by_id(lane_id)
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    lane = place[points.row]
    row = np.argsort(lane, kind="stable")
    return (
        tuple(lane_id[k] for k in order),
        torch.from_numpy(lane_type[order]),
        SurveyLanePoints(
            lane=torch.from_numpy(lane[row]), point_world=torch.from_numpy(points.values[row])
        ),
    )


def _by_id(names: tuple[str, ...]) -> list[int]:
    """Rows in the order of their ids: what is measured by a survey does not depend on the order of its rows."""
    return sorted(range(len(names)), key=names.__getitem__)


def _no_signs() -> SurveySigns:
    empty = torch.zeros(0, 3, dtype=torch.float64)
    return SurveySigns(
        shape=_integers(),
        corners_world=empty.new_zeros(0, polygon.MAX_CORNERS, 3),
        center_world=empty,
        normal_world=empty,
        sigma=empty[:, 0],
    )


def _no_points() -> SurveyLanePoints:
    return SurveyLanePoints(lane=_integers(), point_world=torch.zeros(0, 3, dtype=torch.float64))


def _integers() -> torch.Tensor:
    return torch.from_numpy(np.zeros(0, dtype=np.int64))
