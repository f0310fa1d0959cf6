"""Reference lines of OpenDRIVE: smooth curves by arc length, and places beside them as s and t."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.polynomial import Polynomial
from scipy.interpolate import CubicSpline
from scipy.spatial import KDTree

KNOT_SPACING_M = 4.0
"""Largest length of one cubic [m]."""
_LENGTH_ROUNDS = 6
_FOOT_ROUNDS = 8
_DENSE_M = 0.5
_SAME = 2e-6
"""Coefficients that differ less are those of one cubic, and what changes less is constant."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)


@dataclass(frozen=True)
class ReferenceLine:
    """Cubics through points of a marker, tangents shared; from s = 0 to `length`, straight on beyond."""

    s: Float[np.ndarray, " knots"]
    """Where each cubic begins, and where the last ends [m]."""
    start: Float[np.ndarray, "knots 2"]
    heading: Float[np.ndarray, " knots"]
    """[rad], anticlockwise from east."""
    coefficient: Float[np.ndarray, "cubics 4 2"]
    """Of powers of the way from the beginning, in axes along and to the left of the heading there."""
    height: Float[np.ndarray, " knots"]
    slope: Float[np.ndarray, " knots"]
    """Heights at the knots, and their change with s."""

    @property
    def length(self) -> float:
        """Of the whole line [m]."""
        return float(self.s[-1])

    def at(
        self, s: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
        """Points of the line, their first and their second derivative by s."""
        inside = np.clip(s, 0, self.length)
        k = np.clip(np.searchsorted(self.s, inside, side="right") - 1, 0, len(self.s) - 2)
        p = (inside - self.s[k])[:, None]
        c = self.coefficient[k]
        local = c[:, 0] + p * (c[:, 1] + p * (c[:, 2] + p * c[:, 3]))
        first = c[:, 1] + p * (2 * c[:, 2] + 3 * p * c[:, 3])
        second = 2 * c[:, 2] + 6 * p * c[:, 3]
        cos, sin = np.cos(self.heading[k]), np.sin(self.heading[k])
        R = np.stack((np.stack((cos, -sin), -1), np.stack((sin, cos), -1)), -2)
        point, first, second = (np.einsum("nij,nj->ni", R, v) for v in (local, first, second))
        beyond = (s - inside)[:, None]
        is_beyond = beyond != 0
        return (self.start[k] + point + beyond * first, first, np.where(is_beyond, 0.0, second))

    def heading_at(self, s: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Direction of the line [rad]."""
        tangent = self.at(s)[1]
        return np.arctan2(tangent[:, 1], tangent[:, 0])

    def height_at(self, s: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Heights of the line, straight on beyond its ends."""
        inside = np.clip(s, 0, self.length)
        rows = cubics(self.s, self.height, self.slope)
        beyond = np.where(s < 0, self.slope[0], self.slope[-1]) * (s - inside)
        return np.array([value(rows, at) for at in inside]) + beyond

    def beside(
        self, point: Float[np.ndarray, "n 2"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Where points have their foot on the line, and how far to the left of it they are [m]."""
        dense = np.linspace(0, self.length, max(2, round(self.length / _DENSE_M)))
        s = dense[KDTree(self.at(dense)[0]).query(point)[1]]
        for _ in range(_FOOT_ROUNDS):
            foot, first, second = self.at(s)
            gap = foot - point
            bend = np.sum(first**2 + gap * second, axis=1)
            s = s - np.sum(gap * first, axis=1) / np.maximum(bend, 0.2)
        foot, first, _ = self.at(s)
        gap = point - foot
        t = (first[:, 0] * gap[:, 1] - first[:, 1] * gap[:, 0]) / np.linalg.norm(first, axis=1)
        return s, t


def reference_line(
    point_world: Float[np.ndarray, "n 3"], first: float, last: float
) -> ReferenceLine:
    """The smooth line through points `first` to `last` of a marker, fractions between two; those around shape its ends."""
    way = np.cumsum([0, *np.linalg.norm(np.diff(point_world[:, :2], axis=0), axis=1)])
    begin, end = np.interp((first, last), np.arange(len(way)), way)
    curve = CubicSpline(way, point_world)
    knot = spread(begin, end)
    place, change = curve(knot), curve(knot, 1)
    speed = np.linalg.norm(change[:, :2], axis=1)
    tangent = change[:, :2] / speed[:, None]
    heading = np.arctan2(tangent[:, 1], tangent[:, 0])
    cos, sin = np.cos(heading[:-1]), np.sin(heading[:-1])
    R = np.stack((np.stack((cos, sin), -1), np.stack((-sin, cos), -1)), -2)
    step = np.einsum("nij,nj->ni", R, np.diff(place[:, :2], axis=0))
    out = np.einsum("nij,nj->ni", R, tangent[1:])
    length = np.linalg.norm(step, axis=1)
    for _ in range(_LENGTH_ROUNDS):
        # The way along a cubic whose tangents are as long as itself is nearly its parameter.
        powers = _powers(step, out, length)
        tau = ((_NODES + 1) / 2)[:, None, None] ** np.arange(3)[:, None]
        velocity = np.sum(np.arange(1, 4)[:, None] * powers[:, None] * tau, axis=2)
        length = np.linalg.norm(velocity, axis=2) @ _WEIGHTS / 2
    scale = length[:, None, None] ** np.arange(1, 4)[:, None]
    coefficient = np.concatenate(
        (np.zeros_like(step)[:, None], _powers(step, out, length) / scale), 1
    )
    return ReferenceLine(
        s=np.cumsum([0, *length]),
        start=place[:, :2],
        heading=heading,
        coefficient=coefficient,
        height=place[:, 2],
        slope=change[:, 2] / speed,
    )


def spread(first: float, last: float) -> Float[np.ndarray, " k"]:
    """Places from `first` to `last`, equally far apart, `KNOT_SPACING_M` at the most."""
    return np.linspace(first, last, max(1, int(np.ceil((last - first) / KNOT_SPACING_M))) + 1)


def _powers(
    step: Float[np.ndarray, "k 2"], out: Float[np.ndarray, "k 2"], m: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "k 3 2"]:
    """Coefficients of powers 1 to 3 of cubics over 0 .. 1 by `step`, tangents `m` long, ahead at first and `out` at last."""
    ahead, m = np.array([1.0, 0.0]), m[:, None]
    first = m * ahead
    return np.stack((first, 3 * step - 2 * first - m * out, first + m * out - 2 * step), axis=1)


def cubics(
    s: Float[np.ndarray, " k"], value: Float[np.ndarray, " k"], slope: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "_ 5"]:
    """Rows of s, a, b, c, d of cubics with given values and slopes at their ends; those that only go on are left out."""
    h = np.diff(s)
    rise = np.diff(value) / h
    c = (3 * rise - 2 * slope[:-1] - slope[1:]) / h
    d = (slope[:-1] + slope[1:] - 2 * rise) / h**2
    change = np.abs(slope[:-1] * h) + np.abs(c * h**2) + np.abs(d * h**3)
    powers = np.where((change < _SAME)[:, None], 0.0, np.column_stack((slope[:-1], c, d)))
    rows = np.column_stack((s[:-1], value[:-1], powers))
    kept = [rows[0]]
    for row in rows[1:]:
        _, a, b, cc, dd = kept[-1]
        p = row[0] - kept[-1][0]
        goes_on = (
            a + p * (b + p * (cc + p * dd)),
            b + p * (2 * cc + 3 * p * dd),
            cc + 3 * p * dd,
            dd,
        )
        if np.abs(row[1:] - goes_on).max() > _SAME:
            kept.append(row)
    return np.array(kept)


def value(rows: Float[np.ndarray, "_ 5"], s: float, derivative: int = 0) -> float:
    """Cubics as `cubics` gives them, or their derivative, at one place."""
    s0, *powers = rows[max(0, int(np.searchsorted(rows[:, 0], s, side="right")) - 1)]
    return float(Polynomial(powers).deriv(derivative)(s - s0))
