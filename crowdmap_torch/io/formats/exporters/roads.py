"""Roads of OpenDRIVE: rows of lanes along one marker, their reference line, with borders and heights by s.

The line follows the longest marker. Lanes are counted from the marker between those of opposite directions, else from
the leftmost: lanes to its right run along the line. The road tilts as fits the heights of all its markers best.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from crowdmap_torch.io.formats.exporters.carriageways import Carriageways, Cell
from crowdmap_torch.io.formats.exporters.reference_line import ReferenceLine, reference_line

_AROUND = 8
"""Points of a marker beyond a road's ends that shape the road there."""


@dataclass(frozen=True)
class Road:
    """Lanes side by side along one reference line."""

    line: ReferenceLine
    guide: int
    """The border that the line follows."""
    border: tuple[int, ...]
    """Borders from left to right."""
    middle: int
    """Number among them of the one between lanes of opposite directions, else 0: lane 0."""
    cell: tuple[int, ...]
    """Lanes between each two of them."""
    is_along: tuple[bool, ...]
    """Whether each border runs along the line."""
    is_left_hand: bool
    """Whether lanes along the line lie to the left of lane 0."""
    aside: Float[np.ndarray, "borders knots"]
    """How far to the left each border is at the knots of the line, level [m]."""
    aside_slope: Float[np.ndarray, "borders knots"]
    tilt: Float[np.ndarray, " knots"]
    """Superelevation at the knots [rad], positive where the road falls to the right."""

    @property
    def tilt_slope(self) -> Float[np.ndarray, " knots"]:
        """Change of the superelevation with s [rad/m]."""
        return np.gradient(self.tilt, self.line.s)


def roads(ways: Carriageways) -> list[Road]:
    """A road for each row of lanes, in the order of rows."""
    rows: dict[int, list[int]] = {}
    for number, cell in enumerate(ways.cells):
        rows.setdefault(cell.row, []).append(number)
    return [_road(ways, cells) for cells in rows.values()]


def along(cell: Cell, border: int) -> bool:
    """Whether a border of a lane runs the way the lane does."""
    return not (cell.is_left_reversed if border == cell.left else cell.is_right_reversed)


def _road(ways: Carriageways, cells: list[int]) -> Road:
    border, cell, with_line = _across(ways, cells)
    # Where directions change across the row is the middle; else the side on which lanes along the line have none.
    changes = [k for k in range(1, len(cell)) if with_line[k - 1] != with_line[k]]
    if changes:
        middle = changes[0]
        is_left_hand = with_line[middle - 1]
    else:
        middle, is_left_hand = 0, False
    # The longest marker guides the line, so that it goes on where lanes come and go.
    guide = max(
        border, key=lambda b: (len(ways.chains[ways.borders[b].chain]), b == border[middle])
    )
    near = [min(k, len(cell) - 1) for k in range(len(border))]
    is_along = [
        along(ways.cells[cell[c]], b) == with_line[c] for b, c in zip(border, near, strict=True)
    ]
    is_reversed = not is_along[border.index(guide)]
    line = _line(ways, guide, is_reversed)
    aside, slope, rise = zip(*(_beside(ways, b, line) for b in border), strict=True)
    aside, rise = np.array(aside), np.array(rise)
    tilt = np.arctan2(np.sum(aside * rise, axis=0), np.sum(aside**2, axis=0))
    return Road(
        line=line,
        guide=guide,
        middle=middle,
        border=tuple(border),
        cell=tuple(cell),
        is_along=tuple(is_along),
        is_left_hand=is_left_hand,
        aside=aside,
        aside_slope=np.array(slope),
        tilt=tilt,
    )


def _across(ways: Carriageways, cells: list[int]) -> tuple[list[int], list[int], list[bool]]:
    """Borders and lanes of a row from left to right as the first lane sees it, and which lanes run as it does."""
    of: dict[int, list[int]] = {}
    for number in cells:
        for b in (ways.cells[number].left, ways.cells[number].right):
            of.setdefault(b, []).append(number)
    first = cells[0]

    def walk(number: int, b: int, same: bool) -> list[tuple[int, int, bool]]:
        """Lanes beyond border `b` of a lane, one after another: the far border, the lane, whether it runs as the first."""
        found = []
        while True:
            beyond = [c for c in of[b] if c != number]
            if not beyond:
                return found
            same = same == (along(ways.cells[number], b) == along(ways.cells[beyond[0]], b))
            number = beyond[0]
            cell = ways.cells[number]
            b = cell.right if b == cell.left else cell.left
            found.append((b, number, same))

    left = walk(first, ways.cells[first].left, True)[::-1]
    right = walk(first, ways.cells[first].right, True)
    borders = [
        *(b for b, _, _ in left),
        ways.cells[first].left,
        ways.cells[first].right,
        *(b for b, _, _ in right),
    ]
    row = [*(c for _, c, _ in left), first, *(c for _, c, _ in right)]
    return borders, row, [*(s for *_, s in left), True, *(s for *_, s in right)]


def _around(ways: Carriageways, border: int) -> tuple[Float[np.ndarray, "n 3"], int, int]:
    """Points of a border's marker, a few beyond its ends too, and where it begins and ends among them."""
    b = ways.borders[border]
    chain = ways.chains[b.chain]
    first = max(0, b.first - _AROUND)
    points = chain.point_world[first : b.last + _AROUND + 1]
    apart = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1) > 1e-6
    kept = np.concatenate(([True], apart))
    rank = np.cumsum(kept) - 1
    return points[kept], int(rank[b.first - first]), int(rank[b.last - first])


def _line(ways: Carriageways, border: int, is_reversed: bool) -> ReferenceLine:
    points, first, last = _around(ways, border)
    if is_reversed:
        points, first, last = points[::-1], len(points) - 1 - last, len(points) - 1 - first
    return reference_line(points, first, last)


def _beside(
    ways: Carriageways, border: int, line: ReferenceLine
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """A border at the knots of a line: to the left of it, the slope of that, and above it [m]."""
    points, _, _ = _around(ways, border)
    s, t = line.beside(points[:, :2])
    order = np.argsort(s, kind="stable")
    s, t, z = s[order], t[order], points[order, 2]
    kept = np.concatenate(([True], np.diff(s) > 1e-3))
    s, t, z = s[kept], t[kept], z[kept]
    where = np.clip(line.s, s[0], s[-1])
    beyond = line.s - where
    left, height = PchipInterpolator(s, t), PchipInterpolator(s, z)
    slope = left(where, 1)
    return (
        left(where) + beyond * slope,
        slope,
        height(where) + beyond * height(where, 1) - line.height,
    )
