"""Lanes of OpenDRIVE: sections of a road, widths and heights of lanes, their road marks, and which lane goes on in which.

A road's surface is its elevation, tilted. Markers that lie above or below it are met by the heights of their lanes.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from crowdmap_torch.io.formats.exporters.attributes import add, add_cubics
from crowdmap_torch.io.formats.exporters.carriageways import Carriageways
from crowdmap_torch.io.formats.exporters.features import Layer
from crowdmap_torch.io.formats.exporters.head import json_text
from crowdmap_torch.io.formats.exporters.reference_line import cubics, value
from crowdmap_torch.io.formats.exporters.roads import Road, Section

MARKS = {
    "solid": "solid",
    "dashed": "broken",
    "double": "solid solid",
    "curb": "curb",
    None: "custom",
}
"""Types of road marks by those of markers."""
MARK_WIDTH_M = 0.12
"""Of painted lines: a map does not say [m]."""
_MEETS_M = 0.005
"""Lanes are linked if their edges are no farther apart [m]: where two roads follow different markers there may be a gap."""
_MIN_LIFT_M = 0.01
"""Lanes whose markers are nearer to the road's surface have no height of their own [m]."""
_LIFT_STEP_M = 0.02
"""Heights change by so much at a time [m]."""

LINKS = (("predecessor", "start"), ("successor", "end"))
"""Names of links, and the end of the road that each is of."""


@dataclass(frozen=True)
class LaneEnd:
    """Where a lane ends at an end of its road."""

    number: int
    edge: Float[np.ndarray, "2 3"]
    """Its left and its right edge on the road's surface, as seen along the road."""


Ends = dict[str, dict[tuple[int, int], LaneEnd]]
"""For each end of a road, its lanes by the points of their two borders there."""


def lane_ends(ways: Carriageways, road: Road) -> Ends:
    """The lanes at both ends of a road; none where markers end."""
    ends: Ends = {}
    for at, which in ((0, "start"), (-1, "end")):
        section, s = road.section[at], road.line.s[[at]]
        point, tangent, _ = road.line.at(s)
        left = np.array([-tangent[0, 1], tangent[0, 0]]) / np.linalg.norm(tangent[0])
        aside = section.aside[:, [at]]
        height = road.line.height[at] + aside * np.tan(road.tilt[at])
        edge = np.concatenate((point + aside * left, height), axis=1)
        node = []
        for border in section.border:
            runs = road.is_along[road.border.index(border)]
            node.append(int(ways.nodes(border, not runs)[at]))
        ends[which] = {
            (node[c], node[c + 1]): LaneEnd(number, edge[c : c + 2])
            for c, number in enumerate(section.number)
            if section.cell[c] is not None and road.is_whole[at]
        }
    return ends


def neighbour(number: int, which: str, ends: list[Ends]) -> tuple[int, str, dict[int, int]] | None:
    """The one road that meets an end of a road, with which of its ends, and how lanes go on."""
    found = []
    for other, tips in enumerate(ends):
        for contact in ("start", "end"):
            if (other, contact) == (number, which):
                continue
            lanes = {}
            for tip, lane in ends[number][which].items():
                # Where beginnings meet the other road is seen from its far side.
                step = 1 if contact != which else -1
                mate = tips[contact].get(tip if step > 0 else (tip[1], tip[0]))
                if mate and np.abs(lane.edge - mate.edge[::step]).max() < _MEETS_M:
                    lanes[lane.number] = mate.number
            if lanes:
                found.append((other, contact, lanes))
    return found[0] if len(found) == 1 else None


def add_lanes(
    element: ET.Element, number: int, road: Road, ways: Carriageways, lanes: Layer, ends: list[Ends]
) -> None:
    """Adds the lanes of road `number` to its element; `ends` are those of all roads (`lane_ends`)."""
    group = ET.SubElement(element, "lanes")
    across = [_across(road, section) for section in road.section]
    if any(s.border[s.middle] != road.guide for s in road.section):
        for section, at in zip(road.section, across, strict=True):
            offset = cubics(section.s, at.t[section.middle], at.slope[section.middle])
            add_cubics(group, "laneOffset", "s", offset)
    near = {name: neighbour(number, which, ends) for name, which in LINKS}
    for k, section in enumerate(road.section):
        joined = {name: {} if found is None else found[2] for name, found in near.items()}
        if k:
            joined["predecessor"] = _same_lanes(section, road.section[k - 1])
        if k + 1 < len(road.section):
            joined["successor"] = _same_lanes(section, road.section[k + 1])
        _section(group, section, across[k], ways, lanes, joined)


@dataclass(frozen=True)
class _Across:
    """Where the borders of a section are on the tilted surface of their road, along which t is counted."""

    t: Float[np.ndarray, "borders knots"]
    slope: Float[np.ndarray, "borders knots"]
    """Its change with s."""
    lift: Float[np.ndarray, "borders knots"]
    """How far above the surface they are, square to it [m]."""


def _across(road: Road, section: Section) -> _Across:
    rows = cubics(road.line.s, road.tilt, road.tilt_slope)
    tilt = np.array([value(rows, s) for s in section.s])
    slope = np.array([value(rows, s, 1) for s in section.s])
    t = section.aside / np.cos(tilt)
    return _Across(
        t=t,
        slope=section.aside_slope / np.cos(tilt) + t * np.tan(tilt) * slope,
        lift=(section.rise - section.aside * np.tan(tilt)) * np.cos(tilt),
    )


def _same_lanes(section: Section, other: Section) -> dict[int, int]:
    """Numbers of the lanes of a section, and which they have in another."""
    numbers = dict(zip(other.cell, other.number, strict=True))
    return {
        number: numbers[cell]
        for cell, number in zip(section.cell, section.number, strict=True)
        if cell is not None and cell in numbers
    }


def _section(
    group: ET.Element,
    section: Section,
    across: _Across,
    ways: Carriageways,
    lanes: Layer,
    joined: dict[str, dict[int, int]],
) -> None:
    element = add(group, "laneSection", s=section.s[0])
    t, slope = across.t, across.slope
    numbers = section.number
    sides = {
        "left": [c for c, lane in enumerate(numbers) if lane > 0],
        "center": [],
        "right": [c for c, lane in enumerate(numbers) if lane < 0],
    }
    for name, columns in sides.items():
        if name == "center":
            lane = add(ET.SubElement(element, name), "lane", id=0, type="none", level="false")
            _mark(lane, section, section.middle, ways, lanes)
        elif columns:
            side = ET.SubElement(element, name)
            for c in columns:
                cell = section.cell[c]
                kind = "none"
                if cell is not None:
                    kind = "bidirectional" if ways.cells[cell].is_two_way else "driving"
                lane = add(side, "lane", id=numbers[c], type=kind, level="false")
                links = [(n, to[numbers[c]]) for n, to in joined.items() if numbers[c] in to]
                if links:
                    link = ET.SubElement(lane, "link")
                    for n, other in links:
                        add(link, n, id=other)
                width = cubics(section.s - section.s[0], t[c] - t[c + 1], slope[c] - slope[c + 1])
                add_cubics(lane, "width", "sOffset", width)
                _mark(lane, section, c if numbers[c] > 0 else c + 1, ways, lanes)
                inner_first = across.lift[[c + 1, c] if numbers[c] > 0 else [c, c + 1]]
                _add_heights(lane, section, inner_first)


def _add_heights(lane: ET.Element, section: Section, lift: Float[np.ndarray, "2 knots"]) -> None:
    """How far a lane lies above the road's surface, inside and outside, where its markers do not lie in it."""
    if np.abs(lift).max() < _MIN_LIFT_M:
        return
    # A height holds until the next one.
    for k, change in enumerate(np.abs(np.diff(lift)).max(axis=0)):
        steps = max(1, int(np.ceil(change / _LIFT_STEP_M)))
        for share in np.arange(steps) / steps:
            s = section.s[k] + share * (section.s[k + 1] - section.s[k]) - section.s[0]
            inner, outer = lift[:, k] + (share + 0.5 / steps) * (lift[:, k + 1] - lift[:, k])
            add(lane, "height", sOffset=s, inner=inner, outer=outer)


def _mark(
    lane: ET.Element, section: Section, border: int, ways: Carriageways, lanes: Layer
) -> None:
    if not section.is_marked[border]:
        return
    piece = ways.borders[section.border[border]].piece
    known = {name: column[piece] for name, column in lanes.columns.items()}
    known["max_sigma_m"] = max(lanes.lists["sigma_m"][piece])
    kind = MARKS[lanes.columns["type"][piece]]
    width = {} if kind == "curb" else {"width": MARK_WIDTH_M}
    mark = add(
        lane, "roadMark", sOffset=0.0, type=kind, weight="standard", color="standard", **width
    )
    add(mark, "userData", code="crowdmap", value=json_text(known))
