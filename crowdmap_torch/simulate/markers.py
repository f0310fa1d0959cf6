"""Lane markers as curves on the road's surface: solid, dashed, double, curb, along and across."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from crowdmap_torch.simulate.roads import Road

STEP_M = 0.25
"""Station between neighbouring points of a marker."""


@dataclass(frozen=True)
class Markers:
    """All markers of a world; the points of one marker are adjacent, `STEP_M` of station apart."""

    lane_id: tuple[str, ...]
    type: tuple[str, ...]
    start: Int[np.ndarray, " m"]
    """First row of `point`."""
    count: Int[np.ndarray, " m"]
    station: Float[np.ndarray, " m"]
    """Station of the first point; NaN for a marker that does not run along the road."""
    dash_m: Float[np.ndarray, " m"]
    """Painted length of a dash; 0 for a marker without gaps."""
    gap_m: Float[np.ndarray, " m"]
    is_oncoming: Bool[np.ndarray, " m"]
    """True for markers beside which cars drive against the order of the points."""
    point: Float[np.ndarray, "p 3"]

    def __len__(self) -> int:
        return len(self.lane_id)

    def points_of(self, marker: int) -> Float[np.ndarray, "k 3"]:
        """The points of one marker, in order."""
        return self.point[self.start[marker] : self.start[marker] + self.count[marker]]

    def length(self) -> Float[np.ndarray, " m"]:
        """Length of each marker's parameter [m]."""
        return (self.count - 1) * STEP_M

    def at(
        self, marker: Int[np.ndarray, "*batch"], parameter: Float[np.ndarray, "*batch"]
    ) -> Float[np.ndarray, "*batch 3"]:
        """World points of markers, `parameter` metres of station after their first points."""
        place = parameter / STEP_M
        below = np.clip(place.astype(np.int64), 0, self.count[marker] - 2)
        share = (place - below)[..., None]
        row = self.start[marker] + below
        return (1 - share) * self.point[row] + share * self.point[row + 1]

    def is_painted(
        self, marker: Int[np.ndarray, "*batch"], parameter: Float[np.ndarray, "*batch"]
    ) -> Bool[np.ndarray, "*batch"]:
        """False in the gaps of dashed markers and beyond a marker's ends."""
        inside = (parameter >= 0) & (parameter <= self.length()[marker])
        dash, gap = self.dash_m[marker], self.gap_m[marker]
        period = np.where(dash > 0, dash + gap, 1.0)
        return inside & ((dash <= 0) | (np.mod(parameter, period) < dash))


@dataclass(frozen=True)
class Strip:
    """One marker to be laid: along the road, at an offset that may change (a split, a merge)."""

    type: str
    stations: tuple[float, float]
    offset: float
    end_offset: float | None = None
    """Offset that it has moved over to at its end, if not `offset`."""
    is_oncoming: bool = False
    """True if only those who drive against the stations have it beside them."""
    crosses: bool = False
    """True: it runs from `offset` to `end_offset` across the road, at the first of the stations."""


def lay_markers(road: Road, strips: Sequence[Strip], *, dash_m: float, gap_m: float) -> Markers:
    """The markers of a world; a dashed one is painted `dash_m` of every `dash_m + gap_m`."""
    points, stations = [], []
    for strip in strips:
        end_offset = strip.offset if strip.end_offset is None else strip.end_offset
        first, last = strip.stations
        span = abs(end_offset - strip.offset) if strip.crosses else last - first
        share = np.linspace(0, 1, round(span / STEP_M) + 1)
        if strip.crosses:
            station, offset = np.full_like(share, first), share
        else:
            station = first + STEP_M * np.arange(len(share))
            offset = share**2 * (3 - 2 * share)
        offset = strip.offset + (end_offset - strip.offset) * offset
        points.append(road.surface(station, offset))
        stations.append(np.nan if strip.crosses else first)
    count = np.array([len(p) for p in points], dtype=np.int64)
    is_dashed = np.array([strip.type == "dashed" for strip in strips])
    return Markers(
        lane_id=tuple(f"lane-{k:03d}" for k in range(len(strips))),
        type=tuple(strip.type for strip in strips),
        start=np.cumsum(count) - count,
        count=count,
        station=np.array(stations),
        dash_m=np.where(is_dashed, dash_m, 0.0),
        gap_m=np.where(is_dashed, gap_m, 0.0),
        is_oncoming=np.array([strip.is_oncoming for strip in strips], dtype=bool),
        point=np.concatenate(points) if points else np.zeros((0, 3)),
    )


def join_markers(parts: Sequence[Markers]) -> Markers:
    """The markers of many roads, numbered anew."""
    count = np.concatenate([part.count for part in parts])
    return Markers(
        lane_id=tuple(f"lane-{k:03d}" for k in range(len(count))),
        type=tuple(kind for part in parts for kind in part.type),
        start=np.cumsum(count) - count,
        count=count,
        station=np.concatenate([part.station for part in parts]),
        dash_m=np.concatenate([part.dash_m for part in parts]),
        gap_m=np.concatenate([part.gap_m for part in parts]),
        is_oncoming=np.concatenate([part.is_oncoming for part in parts]),
        point=np.concatenate([part.point for part in parts]),
    )
