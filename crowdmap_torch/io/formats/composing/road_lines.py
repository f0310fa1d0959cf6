"""Roads of OpenDRIVE files: reference lines of all kinds, heights, and places by s and t."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float

from crowdmap_torch.io.errors import InputError

_FINE_M = 0.01
"""Spirals are summed up in steps of this [m]."""


def number(path: Path, element: Element, name: str, default: float | None = None) -> float:
    """A finite attribute; InputError that names the file and the element otherwise."""
    text = element.get(name)
    if text is None and default is not None:
        return default
    try:
        value = float(text or "")
    except ValueError:
        value = np.nan
    if not abs(value) <= 1e9:
        raise InputError(f"{path}: {element.tag}: {name}: expected a finite number, found {text!r}")
    return value


def cubic(
    path: Path, records: list[Element], key: str, s: Float[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """Values of cubics, each from where it begins; 0 before the first."""
    if not records:
        return np.zeros(len(s))
    rows = np.array([[number(path, record, name) for name in (key, *"abcd")] for record in records])
    row = np.searchsorted(rows[:, 0], s + 1e-9, side="right") - 1
    start, a, b, c, d = rows[np.maximum(row, 0)].T
    p = s - start
    return np.where(row < 0, 0.0, a + p * (b + p * (c + p * d)))


class RoadLine:
    """One road element, its reference line read when it is asked for."""

    def __init__(self, path: Path, element: Element) -> None:
        """`path` is named in complaints."""
        self.path, self.element = path, element
        self.length = number(path, element, "length")
        self._pieces = element.findall("planView/geometry")
        if not self._pieces:
            raise InputError(f"{path}: road {element.get('id')}: has no geometry; expected some")

    def heading(self, s: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Of the reference line [rad]."""
        return self._line(s)[1]

    def world(
        self, s: Float[np.ndarray, " k"], t: Float[np.ndarray, " k"], h: Float[np.ndarray, " k"]
    ) -> Float[np.ndarray, "k 3"]:
        """Points at t along the tilted surface, and h square to it."""
        xy, heading = self._line(s)
        find = self.element.findall
        height = cubic(self.path, find("elevationProfile/elevation"), "s", s)
        tilt = cubic(self.path, find("lateralProfile/superelevation"), "s", s)
        level = t * np.cos(tilt) - h * np.sin(tilt)
        return np.stack(
            (
                xy[:, 0] - level * np.sin(heading),
                xy[:, 1] + level * np.cos(heading),
                height + t * np.sin(tilt) + h * np.cos(tilt),
            ),
            axis=-1,
        )

    @cached_property
    def _starts(self) -> Float[np.ndarray, " n"]:
        return np.array([number(self.path, piece, "s") for piece in self._pieces])

    def _line(
        self, s: Float[np.ndarray, " k"]
    ) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
        row = np.clip(np.searchsorted(self._starts, s + 1e-9, side="right") - 1, 0, None)
        xy, heading = np.zeros((len(s), 2)), np.zeros(len(s))
        for k in np.unique(row):
            piece = self._pieces[k]
            here = row == k
            local, turn = self._local(piece, s[here] - self._starts[k])
            hdg = number(self.path, piece, "hdg")
            cos, sin = np.cos(hdg), np.sin(hdg)
            xy[here, 0] = number(self.path, piece, "x") + local[:, 0] * cos - local[:, 1] * sin
            xy[here, 1] = number(self.path, piece, "y") + local[:, 0] * sin + local[:, 1] * cos
            heading[here] = hdg + turn
        return xy, heading

    def _local(
        self, piece: Element, p: Float[np.ndarray, " k"]
    ) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, " k"]]:
        """Points in axes along and to the left of a piece's beginning, and the heading there."""
        length = number(self.path, piece, "length")
        shape = next(iter(piece), None)
        kind = "nothing" if shape is None else shape.tag
        if shape is not None and kind in ("line", "arc", "spiral"):
            names = {"line": (), "arc": ("curvature",) * 2, "spiral": ("curvStart", "curvEnd")}[
                kind
            ]
            ends = [number(self.path, shape, name) for name in names] or [0.0, 0.0]
            fine = np.linspace(0, length, max(2, int(length / _FINE_M) + 1))
            turn = ends[0] * fine + (ends[1] - ends[0]) * fine**2 / (2 * max(length, 1e-9))
            step = np.diff(fine) / 2
            xy = [
                np.concatenate(([0.0], np.cumsum(step * (f(turn)[1:] + f(turn)[:-1]))))
                for f in (np.cos, np.sin)
            ]
            at = np.clip(p, 0, length)
            return np.stack([np.interp(at, fine, c) for c in xy], -1), np.interp(at, fine, turn)
        if shape is not None and kind in ("poly3", "paramPoly3"):
            axes = ("V",) if kind == "poly3" else ("U", "V")
            names = [[f"{a}{x}" if kind == "paramPoly3" else a for a in "abcd"] for x in axes]
            rows = [[number(self.path, shape, name) for name in own] for own in names]
            rows = [[0.0, 1.0, 0.0, 0.0], *rows] if kind == "poly3" else rows
            is_share = kind == "paramPoly3" and shape.get("pRange", "normalized") == "normalized"
            q = p / length if is_share else p
            powers = np.stack((np.ones_like(q), q, q**2, q**3))
            change = np.stack((np.zeros_like(q), np.ones_like(q), 2 * q, 3 * q**2))
            uv, d_uv = np.array(rows) @ powers, np.array(rows) @ change
            return uv.T, np.arctan2(d_uv[1], d_uv[0])
        raise InputError(
            f"{self.path}: road {self.element.get('id')}: its geometry is {kind}; expected line, arc, spiral, "
            "poly3 or paramPoly3"
        )
