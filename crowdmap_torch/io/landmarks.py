"""Signs and lane pieces of a map as Parquet files (FORMAT.md), one row each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.geometry import polygon, se3, spline_length
from crowdmap_torch.io.columns import MAX_PLACE_M, Sheet
from crowdmap_torch.io.rigs import UNIT_TOLERANCE
from crowdmap_torch.io.tiled_sheets import TiledFile, opened
from crowdmap_torch.io.writing import (
    list_column,
    name_column,
    points_column,
    row_column,
    write_parquet,
)
from crowdmap_torch.tables import LANE_TYPES, ControlPoints, Lanes, Signs

MIN_SIGMA_M = 1e-6
"""Nobody surveys to a micrometre [m]."""
DEFAULT_SIGMA_M = 0.02
"""1-sigma per axis of a landmark that comes without one, as a surveyor's has [m]."""
POINT_SPACING_M = 1.0
"""The spline is sampled at most this far apart for readers that have none [m]."""
_SUPPORT = ("n_journeys", "n_observations", "first_seen_ns", "last_seen_ns")


def write_signs(
    path: Path, signs: Signs, sign_id: Sequence[str], type_names: Sequence[str]
) -> None:
    """Writes signs with the up axis that is nearest to world up; numbers must be finite."""
    _require_ids(signs, sign_id)
    signs = signs.to("cpu")
    T, size = polygon.canonical(signs.T_world_sign.detach(), signs.size.detach(), signs.shape)
    corners = se3.transform(T[:, None], polygon.corners(signs.shape, size))
    count = polygon.corner_count(signs.shape)
    size = _finite("size", size)
    write_parquet(
        path,
        {
            "sign_id": pa.array(list(sign_id), pa.string()),
            "shape": name_column(signs.shape.numpy(), polygon.SHAPES),
            "type": name_column(signs.type.numpy(), type_names),
            "corners": points_column(
                _finite("corners", corners[polygon.corner_mask(signs.shape)]), count.numpy()
            ),
            "center": row_column(_finite("center", T[:, :3, 3])),
            "normal": row_column(_finite("normal", T[:, :3, 2])),
            "width_m": pa.array(size[:, 0]),
            "height_m": pa.array(size[:, 1]),
            "covariance": row_column(_finite("covariance", signs.covariance.reshape(-1, 9))),
            **_support_columns(signs),
        },
    )


def write_lanes(path: Path, lanes: Lanes, lane_id: Sequence[str]) -> None:
    """Writes pieces of lane markers, with points of their splines for readers without one.

    Numbers must be finite.
    """
    _require_ids(lanes, lane_id)
    # Packed in the order of the pieces.
    lanes = lanes.select(torch.arange(len(lanes), device=lanes.type.device)).to("cpu")
    control = lanes.control.point_world.detach().cpu()
    count = lanes.control_count
    if len(lanes):
        point, _, piece = spline_length.sample_flat(control, count, POINT_SPACING_M)
    else:
        point, piece = control, count
    write_parquet(
        path,
        {
            "lane_id": pa.array(list(lane_id), pa.string()),
            "type": name_column(lanes.type.numpy(), LANE_TYPES),
            "control_points": points_column(_finite("control_points", control), count.numpy()),
            "points": points_column(
                _finite("points", point), np.bincount(piece.numpy(), minlength=len(lanes))
            ),
            "sigma_m": list_column(_finite("sigma_m", lanes.control.sigma.cpu()), count.numpy()),
            **_support_columns(lanes),
        },
    )


def read_signs(path: Path | TiledFile) -> tuple[Signs, tuple[str, ...], tuple[str, ...]]:
    """Signs, their ids and the traffic-sign codes that the `type` column counts.

    Only the columns `sign_id`, `shape` and `corners` must be there: a survey can be read as a map.
    """
    optional = ("type", "center", "normal", "width_m", "height_m", "covariance", "sigma_m")
    sheet = opened(path, ("sign_id", "shape", "corners"), (*optional, *_SUPPORT, "confidence"))
    sign_id = sheet.ids("sign_id")
    shape = torch.from_numpy(sheet.codes("shape", polygon.SHAPES))
    corners, known = read_corners(sheet, shape)
    sheet.refuse(~known, lambda row: "column 'corners' is null; expected the sign's corners")
    mask = polygon.corner_mask(shape)
    center = center_of(corners, mask)
    if "center" in sheet:
        center = torch.from_numpy(sheet.points("center").values)
    normal = read_normals(sheet, corners)
    T_world_sign, size = _axes(corners - center[:, None], normal, shape, center)
    if "width_m" in sheet and "height_m" in sheet:
        given = [_positive(sheet, name) for name in ("width_m", "height_m")]
        size = torch.from_numpy(np.stack(given, axis=-1))
    names = sheet.strings("type", optional=True)
    type_names = tuple(sorted(name for name in names.unique().to_pylist() if name is not None))
    signs = Signs(
        shape=shape,
        type=torch.from_numpy(sheet.codes("type", type_names, optional=True)),
        T_world_sign=T_world_sign,
        size=size,
        covariance=_covariance(sheet),
        **_read_support(sheet),
    )
    return signs, sign_id, type_names


def read_lanes(path: Path | TiledFile) -> tuple[Lanes, tuple[str, ...]]:
    """Pieces of lane markers and their ids.

    Only the columns `lane_id` and `points` must be there; they then stand for the control points.
    """
    optional = ("type", "control_points", "sigma_m", *_SUPPORT, "confidence")
    sheet = opened(path, ("lane_id", "points"), optional)
    lane_id = sheet.ids("lane_id")
    name = "control_points" if "control_points" in sheet else "points"
    control = sheet.point_lists(name)
    sheet.refuse(
        control.count < 2,
        lambda row: f"column {name!r}: {control.count[row]} points; expected 2 or more",
    )
    sigma = np.full(len(control.values), DEFAULT_SIGMA_M)
    if name == "control_points" and "sigma_m" in sheet:
        sigmas = sheet.number_lists("sigma_m")
        sheet.refuse(
            sigmas.count != control.count,
            lambda row: (
                f"column 'sigma_m': {sigmas.count[row]} numbers for {control.count[row]} "
                "control points; expected as many"
            ),
        )
        sigma = sigmas.values
        _refuse_sigma(sheet, sigma, sigmas.row)
    lanes = Lanes(
        type=torch.from_numpy(sheet.codes("type", LANE_TYPES, optional=True)),
        control_start=torch.from_numpy(control.start),
        control_count=torch.from_numpy(control.count),
        **_read_support(sheet),
        control=ControlPoints(
            point_world=torch.from_numpy(control.values), sigma=torch.from_numpy(sigma)
        ),
    )
    return lanes, lane_id


def read_corners(
    sheet: Sheet, shape: Int[Tensor, " n"], *, optional: bool = False
) -> tuple[Float[Tensor, "n 8 3"], Bool[np.ndarray, " n"]]:
    """The `corners` column, last corners repeated, NaN where it has none; and where it has some."""
    lists = sheet.point_lists("corners", optional=optional)
    known = lists.count > 0 if optional else np.ones(len(sheet), dtype=bool)
    expected = polygon.corner_count(shape).numpy()
    sheet.refuse(
        known & (lists.count != expected),
        lambda row: (
            f"{polygon.SHAPES[int(shape[row])]} with {lists.count[row]} corners; "
            f"expected {expected[row]}"
        ),
        code="point-count",
    )
    slot = np.minimum(np.arange(polygon.MAX_CORNERS), expected[:, None] - 1)
    padded = np.full((len(sheet), polygon.MAX_CORNERS, 3), np.nan)
    # All that are known, but where faults are gathered.
    fits = known & (lists.count == expected)
    padded[fits] = lists.values[(lists.start[:, None] + slot)[fits]]
    return torch.from_numpy(padded), known


def read_normals(sheet: Sheet, corners_world: Float[Tensor, "n 8 3"]) -> Float[Tensor, "n 3"]:
    """Unit normals that point at the driver: as given, else from corners; NaN without either."""
    turning = _turning(corners_world)
    length = turning.square().sum(-1).sqrt()
    sheet.refuse(
        (length <= 1e-12).numpy(),
        lambda row: "column 'corners': they lie on a line; expected a polygon",
        code="value",
    )
    normal = turning / length[:, None]
    if "normal" not in sheet:
        return normal
    given = sheet.points("normal", optional=True)
    known = np.flatnonzero(given.count)
    size = np.sqrt(np.square(given.values).sum(-1))
    off = np.zeros(len(sheet), dtype=bool)
    off[known] = np.abs(size - 1) > UNIT_TOLERANCE
    sheet.refuse(off, lambda row: "column 'normal': expected a unit vector", code="value")
    unit = torch.from_numpy(given.values / np.where(size > 0, size, 1.0)[:, None])
    backwards = np.zeros(len(sheet), dtype=bool)
    backwards[known] = ((unit * normal[known]).sum(-1) < 0).numpy()
    sheet.refuse(
        backwards,
        lambda row: (
            "corners run anticlockwise as the normal's side sees them; expected clockwise, "
            "with the normal pointing at the driver"
        ),
        code="value",
    )
    return normal.index_put((torch.from_numpy(known),), unit)


def center_of(corners: Float[Tensor, "n 8 3"], mask: Bool[Tensor, "n 8"]) -> Float[Tensor, "n 3"]:
    """Mean of the corners."""
    return torch.where(mask[..., None], corners, 0.0).sum(1) / mask.sum(1, keepdim=True)


def _axes(
    relative: Float[Tensor, "n 8 3"],
    normal: Float[Tensor, "n 3"],
    shape: Int[Tensor, " n"],
    center: Float[Tensor, "n 3"],
) -> tuple[Float[Tensor, "n 4 4"], Float[Tensor, "n 2"]]:
    """Sign frames and sizes from corners relative to the centre, in the shape's own order."""
    mask = polygon.corner_mask(shape)[..., None]
    tau = torch.where(mask, polygon.template(shape), 0.0)
    # No shape's corners correlate in x and y, so each axis is found by itself.
    wide, high = ((tau.mT @ relative) / tau.square().sum(1)[..., None]).unbind(1)
    x = wide - (wide * normal).sum(-1, keepdim=True) * normal
    x = torch.nn.functional.normalize(x, dim=-1)
    y = torch.linalg.cross(normal, x)
    size = torch.stack(((wide * x).sum(-1), (high * y).sum(-1)), dim=-1)
    return se3.make(torch.stack((x, y, normal), dim=-1), center), size


def _covariance(sheet: Sheet) -> Float[Tensor, "n 3 3"]:
    if "covariance" in sheet:
        covariance = sheet.number_lists("covariance", 9).values.reshape(-1, 3, 3)
        sheet.refuse(
            np.abs(covariance).max(axis=(1, 2), initial=0.0) > MAX_PLACE_M**2,
            lambda row: f"column 'covariance': expected {MAX_PLACE_M**2:g} m^2 at most",
        )
        return torch.from_numpy(covariance)
    variance = torch.from_numpy(read_sigma(sheet)).square()
    return variance[:, None, None] * torch.eye(3, dtype=torch.float64)


def read_sigma(sheet: Sheet) -> Float[np.ndarray, " n"]:
    """The `sigma_m` column, `DEFAULT_SIGMA_M` where it says nothing [m]."""
    sigma = sheet.numbers("sigma_m", optional=True)
    _refuse_sigma(sheet, sigma)
    return np.where(np.isnan(sigma), DEFAULT_SIGMA_M, sigma)


def _support_columns(table: Signs | Lanes) -> dict[str, pa.Array]:
    counts = {name: pa.array(getattr(table, name).numpy()) for name in _SUPPORT}
    return counts | {"confidence": pa.array(_finite("confidence", table.confidence))}


def _read_support(sheet: Sheet) -> dict[str, Tensor]:
    """Columns that signs and lanes share; which journey's tracklet a landmark was is not in a file."""
    counts = {
        name: torch.from_numpy(sheet.integers(name) if name in sheet else np.zeros(len(sheet), int))
        for name in _SUPPORT
    }
    confidence = sheet.numbers("confidence", optional=True)
    sheet.refuse(
        (confidence < 0) | (confidence > 1),
        lambda row: f"column 'confidence': expected 0 to 1, found {confidence[row]:g}",
    )
    confidence = np.where(np.isnan(confidence), 1.0, confidence)
    none = torch.full((len(sheet),), -1, dtype=torch.int64)
    origin = {"journey": none, "tracklet": none, "frame": none}
    return origin | counts | {"confidence": torch.from_numpy(confidence)}


def _positive(sheet: Sheet, name: str) -> Float[np.ndarray, " n"]:
    values = sheet.numbers(name)
    sheet.refuse(
        ~((values > 0) & (values <= MAX_PLACE_M)),
        lambda row: (
            f"column {name!r}: expected a number above 0, {MAX_PLACE_M:g} at most, found {values[row]}"
        ),
    )
    return values


def _refuse_sigma(
    sheet: Sheet, sigma: Float[np.ndarray, " n"], row_of: Int[np.ndarray, " n"] | None = None
) -> None:
    """Refuses a sigma whose inverse square is no weight; NaN is unknown."""
    off = (sigma < MIN_SIGMA_M) | (sigma > MAX_PLACE_M)
    row_of = np.arange(len(sheet)) if row_of is None else row_of
    sheet.refuse(
        np.bincount(row_of[off], minlength=len(sheet)).astype(bool),
        lambda row: (
            f"column 'sigma_m': expected {MIN_SIGMA_M:g} to {MAX_PLACE_M:g} m, "
            f"found {sigma[off & (row_of == row)][0]}; leave it null if it is unknown"
        ),
        "sigma_m",
        code="range",
    )


def _turning(corners: Tensor) -> Tensor:
    """Vector area of polygons, on the side from which their corners run clockwise; NaN for NaN."""
    relative = corners - corners[:, :1]
    # Padded slots add nothing: the cross product of equal neighbours is zero.
    return -torch.linalg.cross(relative[:, :-1], relative[:, 1:]).sum(1) / 2


def _finite(name: str, values: Tensor) -> np.ndarray:
    values = values.detach().cpu().to(torch.float64)
    if not bool(values.isfinite().all()):
        row = int((~values.isfinite()).nonzero()[0, 0])
        raise ValueError(f"{name}: value {row} is not finite; a map holds finite numbers only")
    return values.numpy()


def _require_ids(table: Signs | Lanes, ids: Sequence[str]) -> None:
    if len(ids) != len(table):
        raise ValueError(f"{len(ids)} ids for {len(table)} landmarks; expected one for each")
