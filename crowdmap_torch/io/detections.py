"""`signs.parquet` and `lanes.parquet` of a journey: what its camera detected, read and written.

A fault of one detection's geometry drops that row and is counted; any other fault refuses the file
(FORMAT.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.geometry import polygon
from crowdmap_torch.geometry.camera import MAX_OFF_AXIS, Camera, inside_image, unproject
from crowdmap_torch.io.columns import Lists, Sheet
from crowdmap_torch.io.errors import Code
from crowdmap_torch.io.row_order import points_by_place, rank_of_lists, rows_by_content
from crowdmap_torch.io.writing import list_column, name_column, write_parquet
from crowdmap_torch.tables import LANE_TYPES, Journey, LaneDetections, LanePoints, SignDetections

DROPPED_SIGN, DROPPED_LANE, DROPPED_LANE_POINT = "sign: ", "lane: ", "lane point: "
"""How the reasons of `Journey.dropped` begin; rows of a file were dropped for the first two."""
FROZEN = "in a frame whose pose is frozen"
"""How that of detections ends that are left out with their frame."""
_DROPPED: dict[Code, str] = {
    "outside-image": "outside the image",
    "no-area": "no area",
    "crosses-itself": "crosses itself",
    "not-clockwise": "not clockwise",
    "off-axis": "85 degrees or more off the axis",
    "no-ray": "undistortion does not close",
    "few-points": "fewer than two usable points",
    "no-length": "no length",
}
"""How they end."""

_MIN_AREA = 1e-6
"""Least area over squared perimeter that is not none; rounding to float32 stays below."""
_MIN_EXTENT_PX = 1e-3
"""A lane marker has no length if its points lie in a smaller box."""


@dataclass(frozen=True)
class SignFile:
    """The usable sign detections of a journey, in the order of frames and of their corners."""

    detections: SignDetections
    type_names: tuple[str, ...]
    """Traffic-sign codes of this file, sorted, by code of the `type` column."""
    dropped: dict[str, int]


@dataclass(frozen=True)
class LaneFile:
    """The usable lane detections of a journey, in the order of frames and of their usable points."""

    detections: LaneDetections
    points: LanePoints
    dropped: dict[str, int]


def read_sign_detections(
    path: Path, camera: Camera, frame_number: Int[np.ndarray, " f"]
) -> SignFile:
    """The sign detections of a journey whose frames have the given numbers.

    A track number below zero counts as none: tracks are hints.
    """
    sheet = Sheet(path, ("frame", "shape", "u", "v"), ("type", "score", "track"))
    frame = _frame_index(sheet, frame_number)
    shape = sheet.codes("shape", polygon.SHAPES)
    u, v = _pixels(sheet)
    expected = polygon.CORNER_COUNT.numpy()[shape]
    sheet.refuse(
        u.count != expected,
        lambda row: (
            f"{polygon.SHAPES[shape[row]]} with {u.count[row]} corners; expected {expected[row]}"
        ),
        *("shape", "u", "v"),
        code="point-count",
    )
    score = _score(sheet)
    track = np.maximum(sheet.integers("track", null=-1), -1)
    codes = sheet.strings("type", optional=True)
    type_names = tuple(sorted(name for name in codes.unique().to_pylist() if name is not None))
    type_code = sheet.codes("type", type_names, optional=True)
    sheet.require_sound()

    slot = np.minimum(np.arange(polygon.MAX_CORNERS), expected[:, None] - 1)
    at = u.start[:, None] + slot
    corners_px = torch.from_numpy(np.stack((u.values[at], v.values[at]), axis=-1))
    ideal, faults = _corner_faults(camera, corners_px, torch.from_numpy(shape))
    usable, dropped = _count(sheet, DROPPED_SIGN, faults, np.arange(len(sheet)))
    corner_columns = corners_px.flatten(1).numpy().T
    order = rows_by_content(
        usable.numpy(), frame, (*corner_columns, shape, type_code, score, track)
    )
    return SignFile(
        detections=SignDetections(
            row=torch.from_numpy(order),
            frame=torch.from_numpy(frame[order]),
            shape=torch.from_numpy(shape[order]),
            corners_px=corners_px[order],
            corners_ideal=ideal[order],
            type=torch.from_numpy(type_code[order]),
            score=torch.from_numpy(score[order]),
            track=torch.from_numpy(track[order]),
        ),
        type_names=type_names,
        dropped=dropped,
    )


def read_lane_detections(
    path: Path, camera: Camera, frame_number: Int[np.ndarray, " f"]
) -> LaneFile:
    """The lane detections of a journey whose frames have the given numbers.

    Points outside the image and points without a ray are left out and counted; the row goes with
    them if fewer than two remain, or all in one place.
    """
    sheet = Sheet(path, ("frame", "u", "v"), ("type", "score"))
    frame = _frame_index(sheet, frame_number)
    u, v = _pixels(sheet)
    sheet.refuse(
        u.count < 2,
        lambda row: f"lane marker with {u.count[row]} points; expected 2 or more",
        *("u", "v"),
        code="point-count",
    )
    lane_type = sheet.codes("type", LANE_TYPES, optional=True)
    score = _score(sheet)
    sheet.require_sound()

    given = np.stack((u.values, v.values), axis=-1)
    px = torch.from_numpy(given[points_by_place(given, u.row)])
    ideal, faults = _point_faults(camera, px)
    usable, dropped = _count(sheet, DROPPED_LANE_POINT, faults, u.row)
    kept = usable.numpy()
    row = u.row[kept]
    remaining = np.bincount(row, minlength=len(sheet))
    short = remaining < 2
    flat = ~short & (_extent(px.numpy()[kept], row, len(sheet)) < _MIN_EXTENT_PX)
    good, dropped_rows = _count(
        sheet,
        DROPPED_LANE,
        {"few-points": torch.from_numpy(short), "no-length": torch.from_numpy(flat)},
        np.arange(len(sheet)),
    )
    content = rank_of_lists(px.numpy()[kept], row, len(sheet))
    order = rows_by_content(good.numpy(), frame, (content, lane_type, score))
    # Points of the rows in use, those of one detection adjacent.
    place = np.full(len(sheet), -1)
    place[order] = np.arange(len(order))
    points = np.flatnonzero(kept & (place[u.row] >= 0))
    points = points[np.argsort(place[u.row[points]], kind="stable")]
    return LaneFile(
        detections=LaneDetections(
            row=torch.from_numpy(order),
            frame=torch.from_numpy(frame[order]),
            type=torch.from_numpy(lane_type[order]),
            score=torch.from_numpy(score[order]),
        ),
        points=LanePoints(
            detection=torch.from_numpy(place[u.row[points]]), px=px[points], ideal=ideal[points]
        ),
        dropped=dropped_rows | dropped,
    )


def write_sign_detections(
    path: Path,
    frame: Int[np.ndarray, " n"],
    shape: Int[np.ndarray, " n"],
    corners_px: Float[np.ndarray, "n 8 2"],
    type_code: Int[np.ndarray, " n"],
    type_names: Sequence[str],
    score: Float[np.ndarray, " n"],
    track: Int[np.ndarray, " n"],
) -> None:
    """Writes `signs.parquet`: frame numbers, indices into `polygon.SHAPES` and `type_names` (-1 none), NaN for no score."""
    count = polygon.CORNER_COUNT.numpy()[shape]
    slots = np.arange(polygon.MAX_CORNERS) < count[:, None]
    columns = {
        "frame": frame,
        "shape": name_column(shape, polygon.SHAPES),
        "u": list_column(corners_px[..., 0][slots], count, pa.float32()),
        "v": list_column(corners_px[..., 1][slots], count, pa.float32()),
        "type": name_column(type_code, type_names),
        "score": _score_column(score),
        "track": pa.array(track, mask=track < 0),
    }
    write_parquet(path, columns)


def write_lane_detections(
    path: Path,
    frame: Int[np.ndarray, " n"],
    px: Float[np.ndarray, "p 2"],
    count: Int[np.ndarray, " n"],
    type_code: Int[np.ndarray, " n"],
    type_names: Sequence[str],
    score: Float[np.ndarray, " n"],
) -> None:
    """Writes `lanes.parquet`: frame numbers, `count` points of each row, one row after the other, the rest as of signs."""
    columns = {
        "frame": frame,
        "u": list_column(px[:, 0], count, pa.float32()),
        "v": list_column(px[:, 1], count, pa.float32()),
        "type": name_column(type_code, type_names),
        "score": _score_column(score),
    }
    write_parquet(path, columns)


def _score_column(score: Float[np.ndarray, " n"]) -> pa.Array:
    return pa.array(score.astype(np.float32), mask=np.isnan(score))


def _frame_index(sheet: Sheet, frame_number: Int[np.ndarray, " f"]) -> Int[np.ndarray, " n"]:
    frame = sheet.integers("frame")
    index = np.minimum(np.searchsorted(frame_number, frame), len(frame_number) - 1)
    sheet.refuse(
        frame_number[index] != frame,
        lambda row: (
            f"frame {frame[row]} is not in poses.parquet, whose frames are "
            f"{frame_number[0]} to {frame_number[-1]}; expected a frame that exists"
        ),
        "frame",
        code="unknown-frame",
    )
    return index


def _pixels(sheet: Sheet) -> tuple[Lists, Lists]:
    u, v = sheet.number_lists("u"), sheet.number_lists("v")
    sheet.refuse(
        u.count != v.count,
        lambda row: f"{u.count[row]} values in u and {v.count[row]} in v; expected as many in both",
        *("u", "v"),
        code="point-count",
    )
    return u, v


def _score(sheet: Sheet) -> Float[np.ndarray, " n"]:
    score = sheet.numbers("score", optional=True, single=True)
    sheet.refuse(
        (score < 0) | (score > 1),
        lambda row: f"column 'score': expected 0 to 1, found {score[row]:g}",
        "score",
        code="score",
    )
    return score


def _corner_faults(
    camera: Camera, corners_px: Float[Tensor, "n 8 2"], shape: Int[Tensor, " n"]
) -> tuple[Float[Tensor, "n 8 2"], dict[Code, Bool[Tensor, " n"]]]:
    """Undistorted corners, and which detections have which fault, the gravest first."""
    mask = polygon.corner_mask(shape)
    area = polygon.signed_area(corners_px, mask)
    # The padded slots close the outline: from the last corner to the first one.
    perimeter = (corners_px - corners_px.roll(1, dims=1)).square().sum(-1).sqrt().sum(-1)
    ideal, faults = _point_faults(camera, corners_px)
    return ideal, {
        "outside-image": faults.pop("outside-image").any(-1),
        "no-area": ~(area.abs() > _MIN_AREA * perimeter.square()),
        "crosses-itself": ~polygon.is_simple(corners_px, mask),
        "not-clockwise": area < 0,
        **{code: bad.any(-1) for code, bad in faults.items()},
    }


def _point_faults(
    camera: Camera, px: Float[Tensor, "*batch 2"]
) -> tuple[Float[Tensor, "*batch 2"], dict[Code, Bool[Tensor, "*batch"]]]:
    ideal, closes = unproject(camera, px)
    # The undistortion stops where rays are not used any more.
    is_wide = ideal.square().sum(-1).sqrt() > (1 - 1e-6) * math.tan(MAX_OFF_AXIS)
    return ideal, {
        "outside-image": ~inside_image(camera, px),
        "off-axis": ~closes & is_wide,
        "no-ray": ~closes,
    }


def _count(
    sheet: Sheet, prefix: str, faults: dict[Code, Bool[Tensor, " n"]], row: Int[np.ndarray, " n"]
) -> tuple[Bool[Tensor, " n"], dict[str, int]]:
    """Which of n, of these rows of a file, have no fault, and how many have which one first."""
    usable = torch.ones_like(next(iter(faults.values())))
    dropped = {}
    for code, is_faulty in faults.items():
        if count := int((usable & is_faulty).sum()):
            reason = prefix + _DROPPED[code]
            dropped[reason] = count
            sheet.leave_out(reason, code, row[(usable & is_faulty).numpy()])
        usable = usable & ~is_faulty
    return usable, dropped


def _extent(
    px: Float[np.ndarray, "p 2"], row: Int[np.ndarray, " p"], rows: int
) -> Float[np.ndarray, " n"]:
    """The longer side of the box around each row's points, 0 without any; rows are in order."""
    extent = np.zeros(rows)
    if len(row):
        first = np.flatnonzero(np.diff(row, prepend=-1))
        high, low = (reduce.reduceat(px, first) for reduce in (np.maximum, np.minimum))
        extent[row[first]] = (high - low).max(-1)
    return extent


def seen_in(journey: Journey, used: Bool[Tensor, " f"], reason: str) -> Journey:
    """What was detected in the frames that are `used`; rows keep their numbers, those left out are counted for `reason`."""
    has_sign, has_lane = used[journey.signs.frame], used[journey.lanes.frame]
    signs, lanes = journey.signs[has_sign], journey.lanes[has_lane]
    points = journey.lane_points[has_lane[journey.lane_points.detection]]
    left = {
        f"{DROPPED_SIGN}{reason}": len(journey.signs) - len(signs),
        f"{DROPPED_LANE}{reason}": len(journey.lanes) - len(lanes),
    }
    return replace(
        journey,
        signs=signs,
        lanes=lanes,
        lane_points=replace(points, detection=(has_lane.long().cumsum(0) - 1)[points.detection]),
        dropped=journey.dropped | {reason: count for reason, count in left.items() if count},
    )
