"""Lanes between neighbouring markers, cut so that those beside one another begin and end together.

A map has markers, no lanes. Where two of them run side by side at a lane's width, nothing between, there is a
lane. Chains of markers are cut where a piece, a lane or a lane beside it begins or ends; a stretch between two
cuts is a border, and a cell is a lane between two borders, so neighbours share borders and successors share points.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from crowdmap_torch.io.formats.exporters.lane_chains import Chain, chains

LANE_WIDTH_M = (2.0, 6.0)
"""Least and largest distance of markers with a lane between them [m]."""
_MAX_STEP_M = 1.5
"""Markers of one road lie on one level: a bridge is higher [m]."""
_MIN_PARALLEL = 0.94
_BESIDE_M = 0.75
"""A point is beside another if it is no farther ahead or behind; points are 1 m apart at most [m]."""
_HOLE = 5
"""A lane goes on over so many points without a partner."""
_MIN_POINTS = 5
"""Fewer points in a row side by side are no lane."""
_SAME_CUT = 4
"""Cuts on both sides of a lane that are so few points apart are one."""
LEFT, RIGHT = 0, 1


@dataclass(frozen=True)
class Border:
    """A stretch of a chain between two cuts."""

    chain: int
    first: int
    last: int
    piece: int
    """The piece of a marker that it is part of."""


@dataclass(frozen=True)
class Cell:
    """A lane for the length of its two borders."""

    left: int
    right: int
    is_left_reversed: bool
    """Whether the left border runs against the lane's direction."""
    is_right_reversed: bool
    is_two_way: bool
    """Its borders run in opposite directions, and nothing tells which is right."""
    row: int
    """Cells that lie side by side have the same."""


@dataclass(frozen=True)
class Carriageways:
    """Borders and the lanes between them; every point of every piece is in a border or a stub."""

    chains: list[Chain]
    borders: list[Border]
    cells: list[Cell]
    stubs: list[tuple[int, Int[np.ndarray, " s"]]]
    """Ends of pieces that overlap another: piece, numbers of points."""

    def nodes(self, border: int, is_reversed: bool = False) -> Int[np.ndarray, " n"]:
        """Numbers of a border's points, among those of all pieces."""
        b = self.borders[border]
        node = self.chains[b.chain].node[b.first : b.last + 1]
        return node[::-1] if is_reversed else node

    def points(self, border: int, is_reversed: bool = False) -> Float[np.ndarray, "n 3"]:
        """A border's points in the world."""
        b = self.borders[border]
        point = self.chains[b.chain].point_world[b.first : b.last + 1]
        return point[::-1] if is_reversed else point


@dataclass(frozen=True)
class _Strip:
    """Two chains side by side: points `at[0]` of the one lie beside points `at[1]` of the other, one by one."""

    chain: tuple[int, int]
    side: tuple[int, int]
    """On which side of each the other lies."""
    at: tuple[np.ndarray, np.ndarray]

    def range(self, which: int) -> tuple[int, int]:
        return int(self.at[which].min()), int(self.at[which].max())

    def across(self, which: int, vertex: int) -> int:
        """The point of the other chain beside a point of one."""
        x, y = self.at[which], self.at[1 - which]
        order = np.argsort(x, kind="stable")
        return round(float(np.interp(vertex, x[order], y[order])))


def carriageways(
    points_world: list[Float[np.ndarray, "_ 3"]], longest: int | None = None
) -> Carriageways:
    """Borders and lanes of pieces of markers, given by their points, 1 m apart at most.

    Cells of more than `longest` points are cut into equal ones, for what is said of a lane to be near.
    """
    found, stubs = chains(points_world)
    strips = _strips(found)
    cuts = _cuts(found, strips, longest)
    borders, border_at = _borders(found, cuts)
    return Carriageways(found, borders, _cells(found, strips, cuts, border_at), stubs)


def _strips(found: list[Chain]) -> list[_Strip]:
    """Runs of points that have one another as nearest neighbours at a lane's width."""
    if not found:
        return []
    point = np.concatenate([chain.point_world for chain in found])
    tangent = np.concatenate([chain.tangent_world for chain in found])
    of = np.repeat(np.arange(len(found)), [len(chain) for chain in found])
    start = np.cumsum([0, *(len(chain) for chain in found)])
    partner = _partners(point, tangent, of)
    strips = []
    for side in (LEFT, RIGHT):
        has = partner[side] >= 0
        other = np.where(has, partner[side], 0)
        is_opposed = np.sum(tangent * tangent[other], axis=1) < 0
        other_side = np.where(is_opposed, side, 1 - side)
        back = np.where(other_side == LEFT, partner[LEFT][other], partner[RIGHT][other])
        mutual = has & (back >= 0) & (np.abs(back - np.arange(len(point))) <= 2)
        mutual &= of[np.maximum(back, 0)] == of
        # Each pair once: from its left chain, or where they run against one another from the earlier chain.
        mutual &= np.where(is_opposed, of < of[other], side == RIGHT)
        key = np.where(mutual, 2 * of[other] + is_opposed, -1)
        for number in range(len(found)):
            rows = np.arange(start[number], start[number + 1])
            for run in _runs(key[rows]):
                at = rows[run]
                mate = partner[side][at]
                opposed = bool(is_opposed[at[0]])
                # Along a curve the nearest point may step back by one.
                mate = np.minimum.accumulate(mate) if opposed else np.maximum.accumulate(mate)
                mates = int(of[mate[0]])
                strips.append(
                    _Strip(
                        (number, mates),
                        (side, side if opposed else 1 - side),
                        (at - start[number], mate - start[mates]),
                    )
                )
    return strips


def _partners(
    point: Float[np.ndarray, "n 3"], tangent: Float[np.ndarray, "n 2"], of: Int[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """The nearest point of another chain to the left, and to the right, of every point; -1 for none."""
    reach = float(np.hypot(LANE_WIDTH_M[1], _BESIDE_M))
    pairs = KDTree(point[:, :2]).query_pairs(reach, output_type="ndarray")
    pairs = pairs[of[pairs[:, 0]] != of[pairs[:, 1]]]
    one, two = np.concatenate((pairs, pairs[:, ::-1])).T
    step = point[two] - point[one]
    ahead = np.sum(step[:, :2] * tangent[one], axis=1)
    to_left = tangent[one, 0] * step[:, 1] - tangent[one, 1] * step[:, 0]
    width = np.abs(to_left)
    fits = (
        (np.abs(ahead) <= _BESIDE_M)
        & (width >= LANE_WIDTH_M[0])
        & (width <= LANE_WIDTH_M[1])
        & (np.abs(step[:, 2]) <= _MAX_STEP_M)
        & (np.abs(np.sum(tangent[one] * tangent[two], axis=1)) >= _MIN_PARALLEL)
    )
    result = []
    for is_side in (to_left > 0, to_left < 0):
        rows = np.flatnonzero(fits & is_side)
        # The nearest marker, to a decimetre, and of that the point straight beside.
        order = rows[np.lexsort((np.abs(ahead[rows]), np.round(width[rows], 1), one[rows]))]
        owner, first = np.unique(one[order], return_index=True)
        best = np.full(len(point), -1)
        best[owner] = two[order[first]]
        result.append(best)
    return result[0], result[1]


def _runs(key: Int[np.ndarray, " n"]) -> list[Int[np.ndarray, " r"]]:
    """Rows of equal keys in order, holes of a few rows bridged; short runs are left out."""
    runs = []
    for value in np.unique(key[key >= 0]):
        rows = np.flatnonzero(key == value)
        for run in np.split(rows, np.flatnonzero(np.diff(rows) > _HOLE) + 1):
            if len(run) >= _MIN_POINTS:
                runs.append(run)
    return runs


def _cuts(found: list[Chain], strips: list[_Strip], longest: int | None) -> list[set[int]]:
    """Where every chain is cut: at its ends and joints, at ends of lanes, and across from cuts of neighbours."""
    cuts: list[set[int]] = [set() for _ in found]
    beside: list[list[tuple[_Strip, int]]] = [[] for _ in found]
    for strip in strips:
        for which in (0, 1):
            beside[strip.chain[which]].append((strip, which))
    queue: deque[tuple[int, int]] = deque()

    def cut(chain: int, vertex: int) -> None:
        if vertex not in cuts[chain]:
            cuts[chain].add(vertex)
            queue.append((chain, vertex))

    for number, chain in enumerate(found):
        for vertex in (0, len(chain) - 1, *chain.joints.tolist()):
            cut(number, vertex)
    for strip in strips:
        for which in (0, 1):
            for vertex in strip.range(which):
                near = [c for c in cuts[strip.chain[which]] if abs(c - vertex) <= _SAME_CUT]
                if not near:
                    cut(strip.chain[which], vertex)

    def cut_neighbours() -> None:
        while queue:
            chain, vertex = queue.popleft()
            for strip, which in beside[chain]:
                low, high = strip.range(which)
                if not low <= vertex <= high:
                    continue
                other, across = strip.chain[1 - which], strip.across(which, vertex)
                if not any(abs(c - across) <= _SAME_CUT for c in cuts[other]):
                    cut(other, across)

    cut_neighbours()
    for number in range(len(found) if longest else 0):
        for first, last in pairwise(sorted(cuts[number])):
            parts = -(-(last - first) // (longest or 1))
            for vertex in np.linspace(first, last, parts + 1).round().astype(int).tolist()[1:-1]:
                if not any(abs(c - vertex) <= _SAME_CUT for c in cuts[number]):
                    cut(number, vertex)
                cut_neighbours()
    return cuts


def _borders(
    found: list[Chain], cuts: list[set[int]]
) -> tuple[list[Border], dict[tuple[int, int], int]]:
    """All borders, and which one begins at which point of which chain."""
    borders, at = [], {}
    for number, chain in enumerate(found):
        places = sorted(cuts[number])
        for first, last in pairwise(places):
            at[number, first] = len(borders)
            borders.append(Border(number, first, last, int(chain.piece[last])))
    return borders, at


def _cells(
    found: list[Chain],
    strips: list[_Strip],
    cuts: list[set[int]],
    border_at: dict[tuple[int, int], int],
) -> list[Cell]:
    """A cell for each pair of borders that lie side by side from cut to cut."""
    sides = {}
    pairs = []
    for number, strip in enumerate(strips):
        for one, other in _matched(strip, cuts):
            borders = []
            for which, (a, b) in enumerate((one, other)):
                borders.append(border_at[strip.chain[which], min(a, b)])
                sides.setdefault(borders[-1], set()).add(strip.side[which])
            pairs.append((number, borders[0], borders[1]))
    cells = []
    for number, a, b in pairs:
        strip = strips[number]
        is_opposed = strip.side[0] == strip.side[1]
        # A marker with lanes on both sides may run either way; one at the edge runs with its lane.
        by = 0 if len(sides[a]) <= len(sides[b]) else 1
        is_two_way = is_opposed and len(sides[a]) == len(sides[b]) == 1
        if is_opposed and len(sides[a]) == len(sides[b]) == 2:
            # Both run with lanes on their other sides: what lies between two carriageways is none.
            continue
        # The lane runs with `by`, which is on the left if the other lies to its right.
        borders = (a, b) if by == 0 else (b, a)
        is_left = strip.side[by] == RIGHT
        cells.append(
            Cell(
                left=borders[0] if is_left else borders[1],
                right=borders[1] if is_left else borders[0],
                is_left_reversed=is_opposed and not is_left,
                is_right_reversed=is_opposed and is_left,
                is_two_way=is_two_way,
                row=0,
            )
        )
    rows = _rows([(cell.left, cell.right) for cell in cells])
    return [replace(cell, row=row) for cell, row in zip(cells, rows, strict=True)]


def _matched(strip: _Strip, cuts: list[set[int]]) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Stretches from cut to cut of both chains of a strip that lie beside one another."""
    places = []
    for which in (0, 1):
        low, high = strip.range(which)
        near = (low - _SAME_CUT, high + _SAME_CUT)
        places.append(sorted(c for c in cuts[strip.chain[which]] if near[0] <= c <= near[1]))
    if strip.side[0] == strip.side[1]:
        places[1].reverse()
    index = {c: k for k, c in enumerate(places[1])}
    mate = {}
    for c in places[0]:
        across = strip.across(0, c)
        near = min(places[1], key=lambda other: abs(other - across), default=None)
        if near is not None and abs(near - across) <= 2 * _SAME_CUT:
            mate[c] = near
    stretches = []
    for a, b in pairwise(places[0]):
        if a in mate and b in mate and index[mate[b]] == index[mate[a]] + 1:
            stretches.append(((a, b), (mate[a], mate[b])))
    return stretches


def _rows(pairs: list[tuple[int, int]]) -> list[int]:
    """The row of each pair of borders: pairs that share a border are in one."""
    parent: dict[int, int] = {}

    def root(border: int) -> int:
        while parent.setdefault(border, border) != border:
            border = parent[border]
        return border

    for a, b in pairs:
        parent[root(a)] = root(b)
    number: dict[int, int] = {}
    return [number.setdefault(root(a), len(number)) for a, _ in pairs]
