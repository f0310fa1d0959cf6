"""Junctions of OpenDRIVE: where roads end before one another, with a connecting road for each lane that goes on.

A map has no markers across a crossing. A lane goes on in those that begin ahead of it over a crossing's width: straight
on in the one that lies on its own way, in a turn from the outermost lane on that side to the outermost one. A connecting
road has one lane, as wide as the lanes at its ends, and no marks.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from crowdmap_torch.io.formats.exporters.attributes import add, add_cubics
from crowdmap_torch.io.formats.exporters.carriageways import Carriageways
from crowdmap_torch.io.formats.exporters.lane_sections import Ends, neighbour
from crowdmap_torch.io.formats.exporters.reference_line import ReferenceLine, cubics, reference_line
from crowdmap_torch.io.formats.exporters.road_shape import add_shape
from crowdmap_torch.io.formats.exporters.roads import Road

_CROSSING_M = (1.0, 40.0)
"""Lanes go on beyond crossings that are so wide [m]."""
_LEVEL_M = 2.0
"""A lane that begins higher or lower is on another road [m]."""
_AHEAD = 0.4
"""Cosine of the largest angle between a lane's end and the way across."""
_TURN = -0.35
"""Cosine of the largest turn over a crossing."""
_STRAIGHT = 0.85
"""Cosine of the largest turn that is none."""
_ASIDE_M = 2.0
"""Straight on a lane may be this far beside the one it goes on in [m]."""
_BEYOND = 12
"""Points beyond its ends that shape a connecting road there, half a metre apart."""
_AROUND_M = 15.0
"""Roads whose cubics all begin farther from a way have no lanes there [m]."""


@dataclass(frozen=True)
class LaneTip:
    """Where a lane begins or ends at an end of its road, as its driver sees it."""

    road: int
    which: str
    number: int
    leads_in: bool
    """Whether it ends there."""
    edge: Float[np.ndarray, "2 3"]
    """Its left and its right edge on the road's surface."""
    onward: Float[np.ndarray, " 2"]
    slope: float
    """Rise along the way."""
    tilt: float
    """Superelevation [rad]."""
    is_left_hand: bool

    @property
    def middle(self) -> Float[np.ndarray, " 3"]:
        """The point between its edges."""
        return self.edge.mean(axis=0)


@dataclass(frozen=True)
class Connection:
    """A lane that goes on in another."""

    begin: LaneTip
    end: LaneTip
    line: ReferenceLine
    """Along the lane's inner edge."""
    junction: int


def junctions(ways: Carriageways, every: list[Road], ends: list[Ends]) -> list[Connection]:
    """Connections between roads that end before one another, numbered by junction from 0."""
    tips = [
        tip
        for number, road in enumerate(every)
        for which in ("start", "end")
        if neighbour(number, which, ends) is None
        for tip in _tips(ways, number, road, which)
    ]
    by_end: dict[tuple[int, str], list[LaneTip]] = {}
    for tip in tips:
        by_end.setdefault((tip.road, tip.which), []).append(tip)
    found: list[tuple[LaneTip, LaneTip, ReferenceLine]] = []
    for one, other in _near(by_end):
        into = [tip for tip in by_end[one] if tip.leads_in]
        out = [tip for tip in by_end[other] if not tip.leads_in]
        for a, b in _matched(into, out):
            line = _line(a, b)
            if not _is_taken(line, a, b, every):
                found.append((a, b, line))
    group = _groups(list(by_end), [(a, b) for a, b, _ in found])
    numbered = [Connection(a, b, line, group[a.road, a.which]) for a, b, line in found]
    return sorted(numbered, key=lambda one: one.junction)


def junction_of(connections: list[Connection]) -> dict[tuple[int, str], int]:
    """The junction at each end of a road that is at one."""
    return {
        (tip.road, tip.which): one.junction for one in connections for tip in (one.begin, one.end)
    }


def add_connecting_roads(root: ET.Element, connections: list[Connection], first: int) -> None:
    """Adds the connecting roads, whose ids count on from `first`."""
    for number, one in enumerate(connections):
        line, left = one.line, one.begin.is_left_hand
        element = add(
            root,
            "road",
            name="",
            length=line.length,
            id=first + number,
            junction=one.junction + 1,
            rule="LHT" if left else "RHT",
        )
        link = ET.SubElement(element, "link")
        for name, tip in (("predecessor", one.begin), ("successor", one.end)):
            add(link, name, elementType="road", elementId=tip.road + 1, contactPoint=tip.which)
        tilt = np.interp(line.s, (0, line.length), (one.begin.tilt, one.end.tilt))
        add_shape(element, line, tilt, np.gradient(tilt, line.s))
        section = add(ET.SubElement(element, "lanes"), "laneSection", s=0.0)
        side = ET.SubElement(section, "left") if left else None
        middle = ET.SubElement(section, "center")
        _add_no_mark(add(middle, "lane", id=0, type="none", level="false"))
        side = ET.SubElement(section, "right") if side is None else side
        lane = add(side, "lane", id=1 if left else -1, type="driving", level="false")
        own = ET.SubElement(lane, "link")
        add(own, "predecessor", id=one.begin.number)
        add(own, "successor", id=one.end.number)
        wide = np.array([_width(one.begin), _width(one.end)])
        add_cubics(lane, "width", "sOffset", cubics(line.s[[0, -1]], wide, np.zeros(2)))
        _add_no_mark(lane)


def _add_no_mark(lane: ET.Element) -> None:
    """Says that nothing is painted."""
    add(lane, "roadMark", sOffset=0.0, type="none", color="standard")


def add_junctions(root: ET.Element, connections: list[Connection], first: int) -> None:
    """Adds the junctions of the connecting roads whose ids count on from `first`."""
    element, last = root, -1
    for number, one in enumerate(connections):
        if one.junction != last:
            element, last = add(root, "junction", id=one.junction + 1, name=""), one.junction
        connection = add(
            element,
            "connection",
            id=number + 1,
            incomingRoad=one.begin.road + 1,
            connectingRoad=first + number,
            contactPoint="start",
        )
        to = 1 if one.begin.is_left_hand else -1
        add(connection, "laneLink", **{"from": one.begin.number, "to": to})


def _tips(ways: Carriageways, number: int, road: Road, which: str) -> list[LaneTip]:
    """The lanes at an end of a road, but those that may be driven both ways."""
    at = 0 if which == "start" else -1
    section, line = road.section[at], road.line
    point, tangent, _ = line.at(line.s[[at]])
    onward = tangent[0] / np.linalg.norm(tangent[0])
    left = np.array([-onward[1], onward[0]])
    aside = section.aside[:, at]
    height = line.height[at] + aside * np.tan(road.tilt[at])
    edge = np.column_stack((point[0] + aside[:, None] * left, height))
    found = []
    for c, (cell, lane) in enumerate(zip(section.cell, section.number, strict=True)):
        if cell is None or ways.cells[cell].is_two_way:
            continue
        runs = 1 if (lane < 0) != road.is_left_hand else -1
        found.append(
            LaneTip(
                road=number,
                which=which,
                number=lane,
                leads_in=(which == "end") == (runs > 0),
                edge=edge[c : c + 2][::runs],
                onward=runs * onward,
                slope=runs * float(line.slope[at]),
                tilt=runs * float(road.tilt[at]),
                is_left_hand=road.is_left_hand,
            )
        )
    return found


def _near(
    by_end: dict[tuple[int, str], list[LaneTip]],
) -> list[tuple[tuple[int, str], tuple[int, str]]]:
    """Pairs of ends of roads, either way round, that are not too far apart for a crossing."""
    ends = list(by_end)
    if not ends:
        return []
    middle = np.array([np.mean([tip.middle[:2] for tip in by_end[end]], axis=0) for end in ends])
    wide = max(
        float(np.ptp([tip.edge[:, :2] for tip in own], axis=0).max()) for own in by_end.values()
    )
    pairs = KDTree(middle).query_pairs(_CROSSING_M[1] + wide, output_type="ndarray")
    both = np.concatenate((pairs, pairs[:, ::-1]))
    return [(ends[k], ends[j]) for k, j in both[np.lexsort((both[:, 1], both[:, 0]))]]


def _is_taken(line: ReferenceLine, a: LaneTip, b: LaneTip, every: list[Road]) -> bool:
    """Whether a way between two lanes leads over lanes that are marked: then it is no crossing."""
    s = line.length * np.array([0.25, 0.5, 0.75])
    point, tangent, _ = line.at(s)
    aside = np.stack((-tangent[:, 1], tangent[:, 0]), axis=-1)
    half = (_width(a) + _width(b)) / 4 * (1 if a.is_left_hand else -1)
    middle, height = point + half * aside, line.height_at(s)
    for road in every:
        if np.linalg.norm(road.line.start[:, None] - middle, axis=-1).min() > _AROUND_M:
            continue
        along, t = road.line.beside(middle)
        for k in np.flatnonzero((along > 0) & (along < road.line.length)):
            section = next(one for one in road.section if along[k] <= one.s[-1] + 1e-6)
            left, right = (np.interp(along[k], section.s, section.aside[c]) for c in (0, -1))
            is_level = abs(float(road.line.height_at(along[[k]])[0] - height[k])) < _LEVEL_M
            if right < t[k] < left and is_level:
                return True
    return False


def _matched(into: list[LaneTip], out: list[LaneTip]) -> list[tuple[LaneTip, LaneTip]]:
    """Which lanes of one end of a road go on in which of another."""
    if not into or not out or into[0].is_left_hand != out[0].is_left_hand:
        return []
    turn = float(into[0].onward @ out[0].onward)
    if turn > _STRAIGHT:
        near = [
            (_misfit(a, b), k, j)
            for k, a in enumerate(into)
            for j, b in enumerate(out)
            if _fits(a, b) and _misfit(a, b) < _ASIDE_M
        ]
        pairs, used = [], (set(), set())
        for _, k, j in sorted(near):
            if k not in used[0] and j not in used[1]:
                used[0].add(k)
                used[1].add(j)
                pairs.append((into[k], out[j]))
        return pairs
    to_left = bool(into[0].onward[0] * out[0].onward[1] > into[0].onward[1] * out[0].onward[0])
    a, b = (_outermost(tips, to_left) for tips in (into, out))
    return [(a, b)] if turn > _TURN and _fits(a, b) else []


def _outermost(tips: list[LaneTip], to_left: bool) -> LaneTip:
    """The leftmost lane, or the rightmost one, as drivers see it."""

    def aside(tip: LaneTip) -> float:
        return float(tip.onward[0] * tip.middle[1] - tip.onward[1] * tip.middle[0])

    return (max if to_left else min)(tips, key=aside)


def _fits(a: LaneTip, b: LaneTip) -> bool:
    """Whether a lane begins ahead of the end of another, over a crossing at the most."""
    way = b.middle - a.middle
    away = float(np.linalg.norm(way[:2]))
    if not _CROSSING_M[0] <= away <= _CROSSING_M[1] or abs(way[2]) > _LEVEL_M:
        return False
    return float(min(way[:2] @ a.onward, way[:2] @ b.onward)) > _AHEAD * away


def _misfit(a: LaneTip, b: LaneTip) -> float:
    """How far a lane begins beside the way on which another ends, between the directions of the two [m]."""
    mean = a.onward + b.onward
    way = (b.middle - a.middle)[:2]
    return float(abs(mean[0] * way[1] - mean[1] * way[0]) / np.linalg.norm(mean))


def _groups(
    ends: list[tuple[int, str]], pairs: list[tuple[LaneTip, LaneTip]]
) -> dict[tuple[int, str], int]:
    """Ends of roads that lanes go on between, numbered by junction."""
    root = {end: end for end in ends}

    def top(end: tuple[int, str]) -> tuple[int, str]:
        while root[end] != end:
            end = root[end]
        return end

    for a, b in pairs:
        root[top((b.road, b.which))] = top((a.road, a.which))
    used = [(tip.road, tip.which) for pair in pairs for tip in pair]
    number = {one: k for k, one in enumerate(dict.fromkeys(top(end) for end in used))}
    return {end: number[top(end)] for end in used}


def _line(a: LaneTip, b: LaneTip) -> ReferenceLine:
    """A smooth curve from the inner edge of a lane's end to that of the next one's beginning, with its heights."""
    inner = 1 if a.is_left_hand else 0
    start, end = a.edge[inner], b.edge[inner]
    away = float(np.linalg.norm((end - start)[:2]))
    out, into = (np.append(tip.onward, tip.slope) for tip in (a, b))
    u = np.linspace(0, 1, max(4, int(2 * away)) + 1)[:, None]
    # Quintic: straight at both ends, where the roads it joins are for it.
    go, out_go = 10 * u**3 - 15 * u**4 + 6 * u**5, u - 6 * u**3 + 8 * u**4 - 3 * u**5
    into_go = -4 * u**3 + 7 * u**4 - 3 * u**5
    curve = start + go * (end - start) + away * (out_go * out + into_go * into)
    beyond = np.arange(1.0, _BEYOND + 1)[:, None] / 2
    points = np.concatenate((start - beyond[::-1] * out, curve, end + beyond * into))
    return reference_line(points, _BEYOND, _BEYOND + len(curve) - 1)


def _width(tip: LaneTip) -> float:
    """Along the tilted surface [m]."""
    return float(np.linalg.norm((tip.edge[1] - tip.edge[0])[:2]) / np.cos(tip.tilt))
