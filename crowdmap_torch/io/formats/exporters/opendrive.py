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
from crowdmap_torch.io.formats.exporters.attributes import add
from crowdmap_torch.io.formats.exporters.carriageways import Carriageways, carriageways
from crowdmap_torch.io.formats.exporters.features import Layer, lane_points, layers
from crowdmap_torch.io.formats.exporters.head import head, json_text
from crowdmap_torch.io.formats.exporters.junctions import (
    add_connecting_roads,
    add_junctions,
    junction_of,
    junctions,
)
from crowdmap_torch.io.formats.exporters.lane_sections import (
    LINKS,
    Ends,
    add_lanes,
    lane_ends,
    neighbour,
)
from crowdmap_torch.io.formats.exporters.reference_line import cubics, value
from crowdmap_torch.io.formats.exporters.road_shape import add_shape
from crowdmap_torch.io.formats.exporters.roads import Road, roads
from crowdmap_torch.io.formats.geodesy import FLATTENING, SEMI_MAJOR_M
from crowdmap_torch.tables import HdMap, Origin


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
    ends = [lane_ends(ways, road) for road in every]
    connections = junctions(ways, every, ends)
    at_junction = junction_of(connections)
    for number, road in enumerate(every):
        element = _road(root, number, road, ends, at_junction)
        add_lanes(element, number, road, ways, lanes, ends)
        chosen = [row for row, foot in enumerate(feet) if foot and foot.road == number]
        if chosen:
            group = ET.SubElement(element, "signals")
            for row in chosen:
                foot = feet[row]
                assert foot is not None
                _signal(group, row, foot, road, hd_map, signs)
    add_connecting_roads(root, connections, len(every) + 1)
    add_junctions(root, connections, len(every) + 1)
    ET.indent(root)
    ET.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
    return _losses(hd_map, ways, every, feet)


def _losses(
    hd_map: HdMap, ways: Carriageways, every: list[Road], feet: list[_Foot | None]
) -> tuple[str, ...]:
    losses = []
    alone = _without_lanes(ways, every)
    if alone >= 1:
        losses.append(f"{alone:.0f} m of markers without a lane beside them: marks belong to lanes")
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


def _without_lanes(ways: Carriageways, every: list[Road]) -> float:
    """Length of the markers beside which no lane is [m]."""
    steps = [
        np.linalg.norm(np.diff(ways.points(b), axis=0), axis=1) for b in range(len(ways.borders))
    ]
    for road in every:
        for rank, border in enumerate(road.border):
            spans = [span for span in road.span[max(0, rank - 1) : rank + 1] if span]
            points = ways.points(border)
            s = road.line.beside((points[1:, :2] + points[:-1, :2]) / 2)[0]
            for low, high in spans:
                steps[border] = np.where((s >= low) & (s <= high), 0.0, steps[border])
    return float(sum(step.sum() for step in steps))


def _header(root: ET.Element, hd_map: HdMap, points: list[np.ndarray]) -> None:
    every = np.concatenate((*points, hd_map.signs.center_world.detach().cpu().numpy()))[:, :2]
    low, high = (every.min(0), every.max(0)) if len(every) else (np.zeros(2), np.zeros(2))
    created = hd_map.provenance.get("created_at")
    element = add(
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
    add(element, "userData", code="crowdmap", value=json_text(head(hd_map)))


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


def _road(
    root: ET.Element,
    number: int,
    road: Road,
    ends: list[Ends],
    at_junction: dict[tuple[int, str], int],
) -> ET.Element:
    line = road.line
    element = add(
        root,
        "road",
        name="",
        length=line.length,
        id=number + 1,
        junction=-1,
        rule="LHT" if road.is_left_hand else "RHT",
    )
    links = [
        (name, neighbour(number, which, ends), at_junction.get((number, which)))
        for name, which in LINKS
    ]
    if any(near or junction is not None for _, near, junction in links):
        link = ET.SubElement(element, "link")
        for name, near, junction in links:
            if near:
                add(link, name, elementType="road", elementId=near[0] + 1, contactPoint=near[1])
            elif junction is not None:
                add(link, name, elementType="junction", elementId=junction + 1)
    add_shape(element, line, road.tilt, road.tilt_slope)
    return element


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
    tilt = value(cubics(road.line.s, road.tilt, road.tilt_slope), foot.s)
    ground = value(cubics(road.line.s, road.line.height, road.line.slope), foot.s)
    known = {name: column[row] for name, column in signs.columns.items()}
    code = known["type"]
    country, _, rest = (code or "").rpartition(":")
    is_iso = (
        len(country) in (2, 3) and country.isascii() and country.isalpha() and country.isupper()
    )
    signal = add(
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
    add(signal, "positionInertial", **place, hdg=heading, pitch=pitch, roll=roll)
    add(signal, "userData", code="crowdmap", value=json_text(known))
