"""Changes of poses.parquet that put mistakes right, each of a table of its columns."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.formats.composing.utm import convergence, geodetic_from_grid
from crowdmap_torch.io.formats.geodesy import local_from_geodetic
from crowdmap_torch.plausibility.finding import Repair
from crowdmap_torch.plausibility.held import held_frames
from crowdmap_torch.tables import Origin

_POSITION, _QUATERNION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
_FALSE_NORTHING_M = 1e7
"""What UTM adds south of the equator."""


def _columns(table: pa.Table, names: tuple[str, ...]) -> Float[np.ndarray, "f k"]:
    return np.stack([table.column(name).to_numpy() for name in names], -1).astype(np.float64)


def _with(table: pa.Table, names: tuple[str, ...], values: Float[np.ndarray, "f k"]) -> pa.Table:
    for k, name in enumerate(names):
        place = table.column_names.index(name)
        table = table.set_column(place, name, pa.array(values[:, k], pa.float64()))
    return table


def _poses(table: pa.Table) -> tuple[Float[np.ndarray, "f 3 3"], Float[np.ndarray, "f 3"]]:
    R = se3.from_quaternion(torch.from_numpy(_columns(table, _QUATERNION)))
    return R.numpy(), _columns(table, _POSITION)


def _with_poses(
    table: pa.Table, R: Float[np.ndarray, "f 3 3"], p: Float[np.ndarray, "f 3"]
) -> pa.Table:
    table = _with(table, _QUATERNION, se3.to_quaternion(torch.from_numpy(R)).numpy())
    return _with(table, _POSITION, p)


def _sorted(table: pa.Table, repair: Repair, origin: Origin) -> pa.Table:
    return table.take(pc.call_function("sort_indices", [table.column("frame")]))


def _times(table: pa.Table, repair: Repair, origin: Origin) -> pa.Table:
    k, factor = table.column_names.index("t_ns"), round(repair.numbers[0])
    t = table.column("t_ns")
    if pa.types.is_integer(t.type):
        ns = t.cast(pa.int64()).to_numpy() * factor
    else:
        # Whole units apart, so that seconds since 1970 keep the digits that they have.
        value = t.cast(pa.float64()).to_numpy()
        whole = np.floor(value)
        ns = whole.astype(np.int64) * factor + np.rint((value - whole) * factor).astype(np.int64)
    return table.set_column(k, "t_ns", pa.array(ns, pa.int64()))


def _lengths(table: pa.Table, repair: Repair, origin: Origin) -> pa.Table:
    return _with(table, _POSITION, _columns(table, _POSITION) * repair.numbers[0])


def _unit_quaternions(table: pa.Table, repair: Repair, origin: Origin) -> pa.Table:
    q = _columns(table, _QUATERNION)
    return _with(table, _QUATERNION, q / np.sqrt(np.square(q).sum(-1, keepdims=True)))


def _quaternion_order(table: pa.Table, repair: Repair, origin: Origin) -> pa.Table:
    return _with(table, _QUATERNION, _columns(table, _QUATERNION)[:, [1, 2, 3, 0]])


def _inverse(table: pa.Table, repair: Repair, origin: Origin) -> pa.Table:
    R, p = _poses(table)
    back = R.swapaxes(-1, -2)
    return _with_poses(table, back, -(back @ p[..., None])[..., 0])


def _axes(table: pa.Table, repair: Repair, origin: Origin) -> pa.Table:
    world, camera = np.array(repair.numbers).reshape(2, 3, 3)
    R, p = _poses(table)
    return _with_poses(table, world @ R @ camera, p @ world.T)


def _degrees(table: pa.Table, repair: Repair, origin: Origin) -> pa.Table:
    p = _columns(table, _POSITION)
    if repair.numbers[0]:
        p = p[:, [1, 0, 2]]
    # Heights over the ellipsoid are told from those over the origin by what they are near to.
    if abs(np.median(p[:, 2])) < abs(np.median(p[:, 2]) - origin.height_m):
        p = p + np.array([0.0, 0.0, origin.height_m])
    return _with(table, _POSITION, local_from_geodetic(p, origin))


def _utm(table: pa.Table, repair: Repair, origin: Origin) -> pa.Table:
    """Positions by the projection, rotations by how far grid north is from true north where the drive begins."""
    zone, is_south = round(repair.numbers[0]), bool(repair.numbers[1])
    R, p = _poses(table)
    grid = p[:, :2] - np.array([0.0, _FALSE_NORTHING_M if is_south else 0.0])
    lat_lon = geodetic_from_grid(grid, zone)
    # Heights stay heights over the origin: whether they are has a rule of its own.
    above = np.concatenate((lat_lon, np.full((len(p), 1), origin.height_m)), axis=-1)
    place = local_from_geodetic(above, origin)
    place[:, 2] = p[:, 2]
    angle = -convergence(lat_lon[0], zone)
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return _with_poses(table, turn @ R, place)


def _heights(table: pa.Table, repair: Repair, origin: Origin) -> pa.Table:
    p = _columns(table, _POSITION)
    return _with(table, _POSITION, p - np.array([0.0, 0.0, repair.numbers[0]]))


def _no_sigmas(table: pa.Table, repair: Repair, origin: Origin) -> pa.Table:
    left = [name for name in repair.of.split(", ") if name in table.column_names]
    return table.drop_columns(left)


def _between_fixes(table: pa.Table, repair: Repair, origin: Origin) -> pa.Table:
    """Places of frames that had that of the last fix, on a cubic spline; rotations too where they were held with them."""
    t, p = table.column("t_ns").to_numpy(), _columns(table, _POSITION)
    # From the first frame on: seconds since 1970 would lose digits.
    t = (t - t[0]) * 1e-9
    is_held = held_frames(t, p)
    known = t[~is_held]
    inside = np.clip(t, known[0], known[-1])
    spline = CubicSpline(known, p[~is_held], bc_type="natural")
    # Behind the last fix a car goes on as it went.
    beyond = (t - inside)[:, None] * spline(known[-1], 1)
    table = _with(table, _POSITION, spline(inside) + beyond)
    q = _columns(table, _QUATERNION)
    after = np.flatnonzero(is_held)
    if (q[after] == q[after - 1]).all():
        turned = Slerp(known, Rotation.from_quat(q[~is_held]))(inside).as_quat()
        table = _with(table, _QUATERNION, turned)
    return table


POSE_CHANGES: dict[str, Callable[[pa.Table, Repair, Origin], pa.Table]] = {
    "sort-frames": _sorted,
    "time-unit": _times,
    "length-unit": _lengths,
    "unit-quaternions": _unit_quaternions,
    "quaternion-order": _quaternion_order,
    "inverse-poses": _inverse,
    "axes": _axes,
    "degrees": _degrees,
    "utm": _utm,
    "heights": _heights,
    "no-sigmas": _no_sigmas,
    "between-fixes": _between_fixes,
}
"""By the name of the repair."""
