"""ASAM OpenDRIVE 1.7: roads with reference line, elevation, superelevation, lanes and road marks, and signs as signals.

A signal's heading is that of the driver who reads it: with `hOffset` 0 it faces along the road. Its s, t and zOffset are
those of the middle of its bottom edge, zOffset straight up from the road's surface there.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.formats.exporters.carriageways import Carriageways, carriageways
from crowdmap_torch.io.formats.exporters.features import Layer, lane_points, layers
from crowdmap_torch.io.formats.exporters.head import head, json_text
from crowdmap_torch.io.formats.exporters.reference_line import cubics
from crowdmap_torch.io.formats.exporters.roads import Road, roads
from crowdmap_torch.io.formats.geodesy import FLATTENING, SEMI_MAJOR_M
from crowdmap_torch.tables import HdMap, Origin

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


@dataclass(frozen=True)
class _Foot:
    """Where a sign stands beside a road."""

    road: int
    s: float
    t: float
    is_beyond: bool
    """Whether the road ends before it."""


def write(hd_map: HdMap, path: Path) -> tuple[str, ...]:
    """Writes an OpenDRIVE file; returns what it has no place for, a line each."""
    points = lane_points(hd_map.lanes)
    ways = carriageways(points)
    every = roads(ways)
    signs, _, lanes = layers(hd_map)
    root = ET.Element("OpenDRIVE")
    _header(root, hd_map, points)
    feet = _feet(hd_map, every)
    ends = [_ends(ways, road) for road in every]
    for number, road in enumerate(every):
        element = _road(root, number, road, ends)
        _lanes(element, number, road, ways, lanes, ends)
        chosen = [row for row, foot in enumerate(feet) if foot and foot.road == number]
        if chosen:
            group = ET.SubElement(element, "signals")
            for row in chosen:
                foot = feet[row]
                assert foot is not None
                _signal(group, row, foot, road, hd_map, signs)
    ET.indent(root)
    ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
    return _losses(hd_map, ways, every, feet)


def _losses(
    hd_map: HdMap, ways: Carriageways, every: list[Road], feet: list[_Foot | None]
) -> tuple[str, ...]:
    losses = []
    used = {border for road in every for border in road.border}
    alone = [row for row in range(len(ways.borders)) if row not in used]
    if alone:
        steps = (np.linalg.norm(np.diff(ways.points(b)[:, :2], axis=0), axis=1) for b in alone)
        length = sum(float(step.sum()) for step in steps)
        losses.append(
            f"{length:.0f} m of markers without a lane beside them: marks belong to lanes"
        )
    if len(hd_map.lanes):
        losses.append("control points and sigma_m of markers (the largest sigma is kept)")
    homeless = sum(foot is None for foot in feet)
    if homeless:
        losses.append(f"{homeless} signs: there is no road that they could belong to")
    beyond = sum(foot is not None and foot.is_beyond for foot in feet)
    if beyond:
        losses.append(
            f"s and t of {beyond} signs beyond the ends of roads: their positionInertial holds, s and t are the end's"
        )
    return tuple(losses)


def _header(root: ET.Element, hd_map: HdMap, points: list[np.ndarray]) -> None:
    every = np.concatenate((*points, hd_map.signs.center_world.detach().cpu().numpy()))[:, :2]
    low, high = (every.min(0), every.max(0)) if len(every) else (np.zeros(2), np.zeros(2))
    created = hd_map.provenance.get("created_at")
    element = _add(
        root,
        "header",
        revMajor=1,
        revMinor=7,
        name="crowdmap_torch",
        version="1",
        **({"date": created} if isinstance(created, str) else {}),
        north=high[1],
        south=low[1],
        east=high[0],
        west=low[0],
    )
    ET.SubElement(element, "geoReference").text = _projection(hd_map.origin)
    _add(element, "userData", code="crowdmap", value=json_text(head(hd_map)))


def _projection(origin: Origin) -> str:
    """A transverse Mercator projection that meets the tangent plane at the origin, to 4 mm at 10 km."""
    lat = np.radians(origin.lat_deg)
    e_sq = FLATTENING * (2 - FLATTENING)
    inside = 1 - e_sq * np.sin(lat) ** 2
    radius = SEMI_MAJOR_M * np.sqrt(1 - e_sq) / inside
    scale = 1 + origin.height_m / radius
    return (
        f"+proj=tmerc +lat_0={origin.lat_deg!r} +lon_0={origin.lon_deg!r} +k={scale:.12f} "
        "+x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"
    )


def _ends(ways: Carriageways, road: Road) -> dict[str, dict[tuple[int, int], int]]:
    """Points of each lane's two borders where the road begins and ends, and the lane's number."""
    tips = []
    for b, runs in zip(road.border, road.is_along, strict=True):
        node = ways.nodes(b, not runs)
        tips.append((int(node[0]), int(node[-1])))
    numbers = _numbers(road)
    return {
        which: {(tips[c][k], tips[c + 1][k]): numbers[c] for c in range(len(road.cell))}
        for k, which in enumerate(("start", "end"))
    }


def _numbers(road: Road) -> list[int]:
    """Numbers of a road's lanes from left to right: positive to the left of the reference line."""
    return [
        road.middle - c if c < road.middle else road.middle - c - 1 for c in range(len(road.cell))
    ]


def _neighbour(
    number: int, which: str, ends: list[dict[str, dict[tuple[int, int], int]]]
) -> tuple[int, str, dict[int, int]] | None:
    """The one road that meets an end of a road, with which of its ends, and how lanes go on."""
    found = []
    for other, tips in enumerate(ends):
        for contact in ("start", "end"):
            if (other, contact) == (number, which):
                continue
            lanes = {}
            for tip, lane in ends[number][which].items():
                # Where beginnings meet the other road is seen from its far side.
                key = tip if contact != which else (tip[1], tip[0])
                if key in tips[contact]:
                    lanes[lane] = tips[contact][key]
            if lanes:
                found.append((other, contact, lanes))
    return found[0] if len(found) == 1 else None


def _road(
    root: ET.Element, number: int, road: Road, ends: list[dict[str, dict[tuple[int, int], int]]]
) -> ET.Element:
    line = road.line
    element = _add(
        root,
        "road",
        name="",
        length=line.length,
        id=number + 1,
        junction=-1,
        rule="LHT" if road.is_left_hand else "RHT",
    )
    links = [(name, _neighbour(number, which, ends)) for name, which in _LINKS]
    if any(near for _, near in links):
        link = ET.SubElement(element, "link")
        for name, near in links:
            if near:
                _add(link, name, elementType="road", elementId=near[0] + 1, contactPoint=near[1])
    plan = ET.SubElement(element, "planView")
    for k, c in enumerate(line.coefficient):
        geometry = _add(
            plan,
            "geometry",
            s=line.s[k],
            x=line.start[k, 0],
            y=line.start[k, 1],
            hdg=line.heading[k],
            length=line.s[k + 1] - line.s[k],
        )
        powers = {
            f"{a}{axis}": c[p, j] for j, axis in enumerate("UV") for p, a in enumerate("abcd")
        }
        _add(geometry, "paramPoly3", **powers, pRange="arcLength")
    profile = ET.SubElement(element, "elevationProfile")
    _add_cubics(profile, "elevation", "s", cubics(line.s, line.height, line.slope))
    lateral = ET.SubElement(element, "lateralProfile")
    _add_cubics(lateral, "superelevation", "s", cubics(line.s, road.tilt, road.tilt_slope))
    return element


_LINKS = (("predecessor", "start"), ("successor", "end"))


def _lanes(
    element: ET.Element,
    number: int,
    road: Road,
    ways: Carriageways,
    lanes: Layer,
    ends: list[dict[str, dict[tuple[int, int], int]]],
) -> None:
    # On a tilted road t is counted along its surface.
    cos = np.cos(road.tilt)
    t = road.aside / cos
    slope = road.aside_slope / cos + t * np.tan(road.tilt) * road.tilt_slope
    links = [(name, _neighbour(number, which, ends)) for name, which in _LINKS]
    group = ET.SubElement(element, "lanes")
    if road.border[road.middle] != road.guide:
        offset = cubics(road.line.s, t[road.middle], slope[road.middle])
        _add_cubics(group, "laneOffset", "s", offset)
    section = _add(group, "laneSection", s=0.0)
    numbers = _numbers(road)
    groups = (
        ("left", [c for c in range(len(road.cell)) if numbers[c] > 0]),
        ("center", []),
        ("right", [c for c in range(len(road.cell)) if numbers[c] < 0]),
    )
    for name, cells in groups:
        if name == "center":
            lane = _add(ET.SubElement(section, name), "lane", id=0, type="none", level="false")
            _mark(lane, ways.borders[road.border[road.middle]].piece, lanes)
        elif cells:
            side = ET.SubElement(section, name)
            for c in cells:
                is_two_way = ways.cells[road.cell[c]].is_two_way
                kind = "bidirectional" if is_two_way else "driving"
                lane = _add(side, "lane", id=numbers[c], type=kind, level="false")
                joined = [
                    (n, near[2][numbers[c]]) for n, near in links if near and numbers[c] in near[2]
                ]
                if joined:
                    link = ET.SubElement(lane, "link")
                    for n, other in joined:
                        _add(link, n, id=other)
                width = cubics(road.line.s, t[c] - t[c + 1], slope[c] - slope[c + 1])
                _add_cubics(lane, "width", "sOffset", width)
                outer = road.border[c if numbers[c] > 0 else c + 1]
                _mark(lane, ways.borders[outer].piece, lanes)


def _mark(lane: ET.Element, piece: int, lanes: Layer) -> None:
    known = {name: column[piece] for name, column in lanes.columns.items()}
    known["max_sigma_m"] = max(lanes.lists["sigma_m"][piece])
    kind = MARKS[lanes.columns["type"][piece]]
    width = {} if kind == "curb" else {"width": MARK_WIDTH_M}
    mark = _add(
        lane, "roadMark", sOffset=0.0, type=kind, weight="standard", color="standard", **width
    )
    _add(mark, "userData", code="crowdmap", value=json_text(known))


def _bottoms(hd_map: HdMap) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """Middles of the bottom edges of signs, and their axes as signals have them: onward, to the left, up."""
    signs = hd_map.signs.to("cpu")
    T = signs.T_world_sign.detach().numpy()
    low = polygon.corners(signs.shape, signs.size.detach())[..., 1].amin(-1).numpy()
    bottom = T[:, :3, 3] + low[:, None] * T[:, :3, 1]
    return bottom, np.stack((-T[:, :3, 2], -T[:, :3, 0], T[:, :3, 1]), axis=-1)


def _feet(hd_map: HdMap, every: list[Road]) -> list[_Foot | None]:
    """The road beside which each sign stands: the nearest that does not end before it, else the nearest."""
    bottom, _ = _bottoms(hd_map)
    best: list[tuple[tuple[bool, float], _Foot] | None] = [None] * len(bottom)
    for number, road in enumerate(every if len(bottom) else ()):
        s, t = road.line.beside(bottom[:, :2])
        inside = np.clip(s, 0, road.line.length)
        for row in range(len(bottom)):
            is_beyond = bool(s[row] != inside[row])
            rank = (is_beyond, float(np.hypot(t[row], s[row] - inside[row])))
            now = best[row]
            if now is None or rank < now[0]:
                best[row] = (rank, _Foot(number, float(inside[row]), float(t[row]), is_beyond))
    return [None if found is None else found[1] for found in best]


def _signal(
    group: ET.Element, row: int, foot: _Foot, road: Road, hd_map: HdMap, signs: Layer
) -> None:
    bottoms, axes = _bottoms(hd_map)
    bottom, R = bottoms[row], axes[row]
    s = np.array([foot.s])
    heading = float(np.arctan2(R[1, 0], R[0, 0]))
    pitch = float(-np.arcsin(np.clip(R[2, 0], -1, 1)))
    roll = float(np.arctan2(R[2, 1], R[2, 2]))
    along_line = float(np.cos(heading - road.line.heading_at(s)[0]))
    base = float(road.line.heading_at(s)[0]) + (0.0 if along_line >= 0 else np.pi)
    tilt = _value(cubics(road.line.s, road.tilt, road.tilt_slope), foot.s)
    ground = _value(cubics(road.line.s, road.line.height, road.line.slope), foot.s)
    known = {name: column[row] for name, column in signs.columns.items()}
    code = known["type"]
    country, _, rest = (code or "").rpartition(":")
    is_iso = (
        len(country) in (2, 3) and country.isascii() and country.isalpha() and country.isupper()
    )
    signal = _add(
        group,
        "signal",
        id=row + 1,
        name=known["sign_id"],
        s=foot.s,
        t=foot.t / np.cos(tilt),
        zOffset=bottom[2] - ground - foot.t * np.tan(tilt),
        hOffset=(heading - base + np.pi) % (2 * np.pi) - np.pi,
        pitch=pitch,
        roll=roll,
        height=known["height_m"],
        width=known["width_m"],
        orientation="+" if along_line >= 0 else "-",
        dynamic="no",
        **({"country": country} if is_iso else {}),
        type=rest or "-1",
        subtype="-1",
    )
    place = dict(zip("xyz", bottom.tolist(), strict=True))
    _add(signal, "positionInertial", **place, hdg=heading, pitch=pitch, roll=roll)
    _add(signal, "userData", code="crowdmap", value=json_text(known))


def _value(rows: Float[np.ndarray, "_ 5"], s: float) -> float:
    """Cubics as `cubics` gives them, at one place."""
    s0, a, b, c, d = rows[max(0, int(np.searchsorted(rows[:, 0], s, side="right")) - 1)]
    p = s - s0
    return float(a + p * (b + p * (c + p * d)))


def _add_cubics(parent: ET.Element, name: str, s: str, rows: Float[np.ndarray, "_ 5"]) -> None:
    for row in rows.tolist():
        _add(parent, name, **dict(zip((s, *"abcd"), row, strict=True)))


def _add(parent: ET.Element, tag: str, /, **attributes: object) -> ET.Element:
    """A child with attributes; numbers to the last digit."""
    texts = {
        key: repr(float(value)) if isinstance(value, float | np.floating) else str(value)
        for key, value in attributes.items()
    }
    return ET.SubElement(parent, tag, texts)
