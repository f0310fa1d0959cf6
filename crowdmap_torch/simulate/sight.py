"""What cars see of a city's markers: the stretch of each that lies ahead, found by where it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from crowdmap_torch.simulate.markers import STEP_M, Markers

_EVERY = 8
"""Every eighth point of a marker is looked for."""
_ASIDE_M = 25.0
"""Markers are followed this far to the side."""
_LEAST_DEPTH_M = 4.0
_MIN_ALONG = 0.5
"""Cosine of the angle between a marker and a camera that looks along it."""
_CHUNK_FRAMES = 1000


@dataclass(frozen=True)
class Sight:
    """The markers in sight, frame after frame; rows in order of frame and marker."""

    key: Int[np.ndarray, " r"]
    """`frame * markers + marker`."""
    markers: int
    foot_row: Float[np.ndarray, " r"]
    """Parameter of the marker beside the camera, were it straight; NaN where it runs across [m]."""
    sense_row: Float[np.ndarray, " r"]
    """Metres of parameter for a metre ahead; negative where the car drives against the marker's points."""
    low_row: Float[np.ndarray, " r"]
    """First parameter in sight [m]."""
    high_row: Float[np.ndarray, " r"]
    side: Float[np.ndarray, " r"]
    """How far to the side its nearest part is [m]."""

    def place(
        self, frame: Int[np.ndarray, "*batch"], marker: Int[np.ndarray, "*batch"]
    ) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
        """Foot and sense."""
        row = self._row(frame, marker)
        return self.foot_row[row], self.sense_row[row]

    def window(
        self, frame: Int[np.ndarray, "*batch"], marker: Int[np.ndarray, "*batch"]
    ) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
        """First and last parameter in sight."""
        row = self._row(frame, marker)
        return self.low_row[row], self.high_row[row]

    def nearest(
        self, frames: Int[np.ndarray, " f"], count: int, side_m: float
    ) -> tuple[Int[np.ndarray, " d"], Int[np.ndarray, " d"]]:
        """Frames and markers: of each frame the `count` that pass nearest, none farther aside than `side_m`."""
        frame, marker = np.divmod(self.key, self.markers)
        rows = np.flatnonzero((self.side < side_m) & np.isin(frame, frames))
        rows = rows[np.lexsort((self.side[rows], frame[rows]))]
        own = frame[rows]
        begins = np.flatnonzero(np.diff(own, prepend=-1))
        place = np.arange(len(rows)) - np.repeat(begins, np.diff(np.append(begins, len(rows))))
        rows = rows[place < count]
        return frame[rows], marker[rows]

    def _row(
        self, frame: Int[np.ndarray, "*batch"], marker: Int[np.ndarray, "*batch"]
    ) -> Int[np.ndarray, "*batch"]:
        return np.searchsorted(self.key, frame * self.markers + marker)


def sight(
    markers: Markers,
    p_world: Float[np.ndarray, "f 3"],
    R_world_camera: Float[np.ndarray, "f 3 3"],
    *,
    far_m: float,
) -> Sight:
    """The markers up to `far_m` ahead of cameras."""
    of_point = np.repeat(np.arange(len(markers)), markers.count)
    parameter = (np.arange(len(of_point)) - markers.start[of_point]) * STEP_M
    is_last = parameter == markers.length()[of_point]
    rows = np.flatnonzero((np.arange(len(of_point)) - markers.start[of_point]) % _EVERY == 0)
    rows = np.union1d(rows, np.flatnonzero(is_last))
    reach = far_m / 2 + 2.0
    low, high = p_world.min(0)[:2] - far_m - reach, p_world.max(0)[:2] + far_m + reach
    is_near = ((markers.point[rows, :2] > low) & (markers.point[rows, :2] < high)).all(-1)
    rows = rows[is_near]
    tree = KDTree(markers.point[rows, :2])
    ahead = R_world_camera[:, :2, 2]
    ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
    middle = p_world[:, :2] + far_m / 2 * ahead
    radius = float(np.hypot(reach, _ASIDE_M))
    parts = []
    for first in range(0, len(p_world), _CHUNK_FRAMES):
        found = tree.query_ball_point(middle[first : first + _CHUNK_FRAMES], radius)
        frame = first + np.repeat(np.arange(len(found)), [len(near) for near in found])
        point = rows[np.concatenate([np.array(near, dtype=np.int64) for near in found])]
        away = np.einsum("dk,dkj->dj", markers.point[point] - p_world[frame], R_world_camera[frame])
        seen = (away[:, 2] > _LEAST_DEPTH_M) & (away[:, 2] < far_m)
        seen &= np.abs(away[:, 0]) < _ASIDE_M
        parts.append((frame[seen], of_point[point[seen]], parameter[point[seen]], away[seen]))
    columns = (np.concatenate(column) for column in zip(*parts, strict=True))
    return _stretches(markers, *columns)


def _stretches(
    markers: Markers,
    frame: Int[np.ndarray, " d"],
    marker: Int[np.ndarray, " d"],
    parameter: Float[np.ndarray, " d"],
    away: Float[np.ndarray, "d 3"],
) -> Sight:
    """Of points in sight, the stretches of markers that they lie on."""
    key = frame * len(markers) + marker
    order = np.lexsort((parameter, key))
    key, parameter, away = key[order], parameter[order], away[order]
    begin = np.flatnonzero(np.diff(key, prepend=-1))
    end = np.append(begin[1:], len(key)) - 1
    low, high = parameter[begin], parameter[end]
    side = np.minimum.reduceat(np.abs(away[:, 0]), begin) if len(key) else np.zeros(0)
    length = np.maximum(high - low, 1e-9)
    slope = (away[end, 2] - away[begin, 2]) / length
    is_along = (np.abs(slope) > _MIN_ALONG) & (high - low > STEP_M * _EVERY)
    slope = np.where(is_along, slope, 1.0)
    reach = STEP_M * _EVERY
    return Sight(
        key=key[begin],
        markers=len(markers),
        foot_row=np.where(is_along, low - away[begin, 2] / slope, np.nan),
        sense_row=1.0 / slope,
        low_row=np.maximum(low - reach, 0.0),
        high_row=np.minimum(high + reach, markers.length()[key[begin] % len(markers)]),
        side=side,
    )
