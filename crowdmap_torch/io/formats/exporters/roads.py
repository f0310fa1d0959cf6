"""Roads of OpenDRIVE: rows of lanes along one marker, their reference line, with borders and heights by s.

The line follows the longest marker. Lanes are counted from the marker between those of opposite directions, else from
the leftmost: lanes to its right run along the line. The road tilts as fits the heights of all its markers best. A lane
begins and ends with its markers, and a section of the road has the same lanes from its beginning to its end.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import PchipInterpolator

from crowdmap_torch.io.formats.exporters.carriageways import Carriageways, Cell
from crowdmap_torch.io.formats.exporters.reference_line import ReferenceLine, reference_line, spread

_AROUND = 12
"""Points of a marker beyond a road's ends that shape the road there."""
_GRID_M = 1.0
"""Lanes begin and end at whole metres along a road, and where it does [m]."""
_TOUCHES_M = 0.05
"""A marker that misses an end of a road by less reaches it [m]."""


@dataclass(frozen=True)
class Section:
    """A stretch of a road with the same lanes from its beginning to its end."""

    s: Float[np.ndarray, " knots"]
    """From its beginning to its end [m]."""
    border: tuple[int, ...]
    """Borders from left to right."""
    cell: tuple[int | None, ...]
    """Lanes between each two of them; None where there is none."""
    middle: int
    """Number of the border that is lane 0, whether its marker is there or not."""
    aside: Float[np.ndarray, "borders knots"]
    """How far to the left of the line each border is, level [m]."""
    aside_slope: Float[np.ndarray, "borders knots"]
    rise: Float[np.ndarray, "borders knots"]
    """How far it is above the line [m]."""

    @property
    def is_marked(self) -> tuple[bool, ...]:
        """Whether each border is that of a lane."""
        lanes = (None, *self.cell, None)
        return tuple(one is not None or other is not None for one, other in pairwise(lanes))

    @property
    def number(self) -> tuple[int, ...]:
        """Numbers of the lanes from left to right: positive to the left of lane 0."""
        return tuple(
            self.middle - c if c < self.middle else self.middle - c - 1
            for c in range(len(self.cell))
        )


@dataclass(frozen=True)
class Road:
    """Lanes side by side along one reference line."""

    line: ReferenceLine
    guide: int
    """The border that the line follows."""
    border: tuple[int, ...]
    """Borders from left to right, of all sections."""
    cell: tuple[int, ...]
    """Lanes between each two of them."""
    span: tuple[tuple[float, float] | None, ...]
    """From where to where along the line each lane has both its borders [m]; None: nowhere."""
    is_along: tuple[bool, ...]
    """Whether each border runs along the line."""
    is_left_hand: bool
    """Whether lanes along the line lie to the left of lane 0."""
    is_whole: tuple[bool, bool]
    """Whether the road begins and ends where its lanes were cut, not where their markers end."""
    section: tuple[Section, ...]
    tilt: Float[np.ndarray, " knots"]
    """Superelevation at the knots of the line [rad], positive where the road falls to the right."""

    @property
    def tilt_slope(self) -> Float[np.ndarray, " knots"]:
        """Change of the superelevation with s [rad/m]."""
        return np.gradient(self.tilt, self.line.s)


def roads(ways: Carriageways) -> list[Road]:
    """A road for each row of lanes, in the order of rows; none where markers never lie side by side."""
    rows: dict[int, list[int]] = {}
    for number, cell in enumerate(ways.cells):
        rows.setdefault(cell.row, []).append(number)
    found = [_road(ways, cells) for cells in rows.values()]
    return _tilts_joined(ways, [road for road in found if road is not None])


def _tilts_joined(ways: Carriageways, every: list[Road]) -> list[Road]:
    """Roads whose lines go on into one another have the same tilt where they meet."""
    tilts = [road.tilt.copy() for road in every]
    meets: dict[tuple[int, int], list[tuple[int, int, int]]] = {}
    for number, road in enumerate(every):
        guide = ways.borders[road.guide]
        runs = 1 if road.is_along[road.border.index(road.guide)] else -1
        for at, vertex in zip((0, -1), (guide.first, guide.last)[::runs], strict=True):
            if road.is_whole[at]:
                meets.setdefault((guide.chain, vertex), []).append((number, at, runs))
    for ends in meets.values():
        mean = float(np.mean([runs * tilts[number][at] for number, at, runs in ends]))
        for number, at, runs in ends:
            tilts[number][at] = runs * mean
    return [replace(road, tilt=tilt) for road, tilt in zip(every, tilts, strict=True)]


def along(cell: Cell, border: int) -> bool:
    """Whether a border of a lane runs the way the lane does."""
    return not (cell.is_left_reversed if border == cell.left else cell.is_right_reversed)


def _road(ways: Carriageways, cells: list[int]) -> Road | None:
    border, cell, with_line = _across(ways, cells)
    # Where directions change across the row is the middle; else the side on which lanes along the line have none.
    changes = [k for k in range(1, len(cell)) if with_line[k - 1] != with_line[k]]
    middle = changes[0] if changes else 0
    # The longest marker guides the line, so that it goes on where lanes come and go.
    guide = max(
        border, key=lambda b: (len(ways.chains[ways.borders[b].chain]), b == border[middle])
    )
    near = [min(k, len(cell) - 1) for k in range(len(border))]
    is_along = [
        along(ways.cells[cell[c]], b) == with_line[c] for b, c in zip(border, near, strict=True)
    ]
    line, sides, spans, is_whole = _line(ways, border, guide, not is_along[border.index(guide)])
    if not any(spans):
        return None
    here = np.array([side.has(line.s) for side in sides])
    aside = np.where(here, [side.aside(line.s)[0] for side in sides], 0.0)
    rise = np.where(here, [side.height(line.s) - line.height for side in sides], 0.0)
    known = np.flatnonzero(np.sum(aside**2, axis=0) > 1.0)
    tilt = np.arctan2(np.sum(aside * rise, axis=0)[known], np.sum(aside**2, axis=0)[known])
    return Road(
        line=line,
        guide=guide,
        border=tuple(border),
        cell=tuple(cell),
        span=tuple(spans),
        is_along=tuple(is_along),
        is_left_hand=bool(changes) and with_line[middle - 1],
        is_whole=is_whole,
        section=tuple(_sections(border, cell, spans, sides, line, middle=middle)),
        tilt=np.interp(line.s, line.s[known], tilt) if len(known) else np.zeros(len(line.s)),
    )


def _sections(
    border: list[int],
    cell: list[int],
    spans: list[tuple[float, float] | None],
    sides: list[_Side],
    line: ReferenceLine,
    *,
    middle: int,
) -> Iterator[Section]:
    """Stretches between the places where lanes begin and end."""
    places = sorted({place for span in spans if span for place in span})
    for first, last in pairwise(places):
        there = [c for c, span in enumerate(spans) if span and span[0] <= first and last <= span[1]]
        # Lane 0 is the same marker all along; what lies between borders that are no neighbours is no lane.
        rank = sorted({middle, *there, *(c + 1 for c in there)})
        lane = tuple(
            cell[one] if one in there and other == one + 1 else None
            for one, other in pairwise(rank)
        )
        knot = spread(first, last)
        aside, slope = zip(*(sides[r].aside(knot) for r in rank), strict=True)
        yield Section(
            s=knot,
            border=tuple(border[r] for r in rank),
            cell=lane,
            middle=rank.index(middle),
            aside=np.array(aside),
            aside_slope=np.array(slope),
            rise=np.array([sides[r].height(knot) for r in rank]) - line.height_at(knot),
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


def _extended(ways: Carriageways, border: int) -> tuple[Float[np.ndarray, "n 3"], int, int]:
    """As `_around`, but straight on beyond the ends of the marker: lanes beside it may begin before it, or end after it."""
    points, first, last = _around(ways, border)
    b = ways.borders[border]
    beyond = np.arange(1.0, _AROUND + 1)[:, None]
    if b.first == 0:
        points = np.concatenate((points[0] + beyond[::-1] * _onward(points[::-1]), points))
        last += _AROUND
    if b.last == len(ways.chains[b.chain]) - 1:
        points = np.concatenate((points, points[-1] + beyond * _onward(points)))
        last = len(points) - 1
    return points, first, last


def _onward(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " 3"]:
    """The step of a metre by which a marker would go on."""
    step = points[-1] - points[max(0, len(points) - 3)]
    return step / np.linalg.norm(step)


@dataclass(frozen=True)
class _Side:
    """A border's marker by the s of a line."""

    low: float
    high: float
    left: PchipInterpolator
    height: PchipInterpolator

    def has(self, s: Float[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
        """Whether the marker is there."""
        return (s >= self.low - _TOUCHES_M) & (s <= self.high + _TOUCHES_M)

    def aside(
        self, s: Float[np.ndarray, " k"]
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """How far to the left of the line it is [m], and the slope of that; straight on beyond its ends."""
        where = np.clip(s, self.low, self.high)
        slope = self.left(where, 1)
        return self.left(where) + (s - where) * slope, slope


def _line(
    ways: Carriageways, border: list[int], guide: int, is_reversed: bool
) -> tuple[ReferenceLine, list[_Side], list[tuple[float, float] | None], tuple[bool, bool]]:
    """The line along a border as far as there are lanes, borders beside it, spans of lanes, and which ends are whole."""
    points, first, last = _extended(ways, guide)
    if is_reversed:
        points, first, last = points[::-1], len(points) - 1 - last, len(points) - 1 - first
    line = reference_line(points, first, last)
    sides = [_beside(ways, b, line) for b in border]
    spans = _spans(sides, line.length)
    begin = min((span[0] for span in spans if span), default=0.0)
    end = max((span[1] for span in spans if span), default=line.length)
    is_whole = (begin == 0.0, end == line.length)
    if any(spans) and not all(is_whole):
        places = np.arange(len(points), dtype=float)
        cut = np.interp((begin, end), line.beside(points[:, :2])[0], places)
        line = reference_line(
            points, first if is_whole[0] else cut[0], last if is_whole[1] else cut[1]
        )
        sides = [_beside(ways, b, line) for b in border]
        spans = _spans(sides, line.length)
    return line, sides, spans, is_whole


def _spans(sides: list[_Side], length: float) -> list[tuple[float, float] | None]:
    """Where both borders of each lane are: from and to whole metres of a line, and its ends."""
    grid = np.array([0.0, *np.arange(_GRID_M, length - _GRID_M, _GRID_M), length])
    spans = []
    for one, other in pairwise(sides):
        inside = grid[one.has(grid) & other.has(grid)]
        spans.append((float(inside[0]), float(inside[-1])) if len(inside) > 1 else None)
    return spans


def _beside(ways: Carriageways, border: int, line: ReferenceLine) -> _Side:
    """A border beside a line."""
    points, _, _ = _around(ways, border)
    s, t = line.beside(points[:, :2])
    order = np.argsort(s, kind="stable")
    s, t, z = s[order], t[order], points[order, 2]
    kept = np.concatenate(([True], np.diff(s) > 1e-3))
    s, t, z = s[kept], t[kept], z[kept]
    return _Side(float(s[0]), float(s[-1]), PchipInterpolator(s, t), PchipInterpolator(s, z))
