"""Lanelet2 maps: OSM files that the `lanelet2` package, JOSM and Autoware read.

Lane markers are ways with heights, cut where lanes begin and end; signs are polygons of their corners in space, clockwise as
the driver sees them. Between neighbouring markers there are lanelets, which share ways with those beside them and points
with those that follow; signs that face them are their regulatory elements.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

import numpy as np
from jaxtyping import Bool, Float

from crowdmap_torch import __version__
from crowdmap_torch.io.formats.exporters.carriageways import Carriageways, carriageways
from crowdmap_torch.io.formats.exporters.features import Layer, lane_points, layers
from crowdmap_torch.io.formats.exporters.head import head, json_text
from crowdmap_torch.io.formats.exporters.sign_lanes import lanes_of_signs
from crowdmap_torch.io.formats.geodesy import geodetic_from_local
from crowdmap_torch.tables import HdMap

LONGEST = 100
"""Points of a lanelet, 1 m apart at most."""
LINE_TAGS = {
    "solid": {"type": "line_thin", "subtype": "solid"},
    "dashed": {"type": "line_thin", "subtype": "dashed"},
    "double": {"type": "line_thin", "subtype": "solid_solid"},
    "curb": {"type": "curbstone", "subtype": "high"},
    None: {"type": "line_thin"},
}
"""Of a way, by the type of its marker."""
_COVARIANCE = [f"covariance_{pair}" for pair in ("ee", "en", "eu", "nn", "nu", "uu")]


@dataclass(frozen=True)
class _Member:
    kind: str
    role: str
    number: int


def write(hd_map: HdMap, path: Path) -> tuple[str, ...]:
    """Writes an OSM file; returns what it has no place for, a line each."""
    points = lane_points(hd_map.lanes)
    ways = carriageways(points, LONGEST)
    lines = [
        "<?xml version='1.0' encoding='UTF-8'?>",
        # Numbers are the file's own: uploaded, they would take the place of elements of OpenStreetMap.
        f'<osm version="0.6" generator="crowdmap_torch {__version__}" upload="never">',
        f"  <note>{escape(json_text({'crowdmap': head(hd_map)}))}</note>",
        *_elements(hd_map, points, ways),
        "</osm>",
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    if not len(hd_map.lanes):
        return ()
    return (
        "control points of lane markers, and sigma_m at each (the largest is kept): a way has points 1 m apart",
    )


def _elements(hd_map: HdMap, points: list[np.ndarray], ways: Carriageways) -> Iterator[str]:
    """Nodes, ways and relations, in the order in which OSM wants them."""
    signs, plates, lanes = layers(hd_map)
    corners = [np.array(c) for c in plates.lists["corners"]]
    every = [*points, *corners]
    used = np.ones(sum(map(len, every)), dtype=bool)
    used[: sum(map(len, points))] = False
    for nodes in (
        *(ways.nodes(row) for row in range(len(ways.borders))),
        *(nodes for _, nodes in ways.stubs),
    ):
        used[nodes] = True
    yield from _nodes(every, used, hd_map)
    number = count(len(used) + 1)
    pieces = [_line_tags(lanes, row) for row in range(len(lanes))]
    border_way = []
    for row, border in enumerate(ways.borders):
        border_way.append(next(number))
        yield from _way(border_way[-1], (ways.nodes(row) + 1).tolist(), pieces[border.piece])
    for piece, nodes in ways.stubs:
        yield from _way(next(number), (nodes + 1).tolist(), pieces[piece])
    first = sum(map(len, points)) + 1
    sign_way = []
    for row, ring in enumerate(corners):
        sign_way.append(next(number))
        nodes = range(first, first + len(ring))
        first += len(ring)
        yield from _way(sign_way[-1], nodes, _sign_tags(signs, row))
    rules = [[] for _ in ways.cells]
    for row, cells in enumerate(lanes_of_signs(hd_map.signs, ways)):
        if cells:
            rule = next(number)
            for cell in cells:
                rules[cell].append(_Member("relation", "regulatory_element", rule))
            tags = {"type": "regulatory_element", "subtype": "traffic_sign"}
            yield from _relation(rule, [_Member("way", "refers", sign_way[row])], tags)
    for cell, rule in zip(ways.cells, rules, strict=True):
        bounds = [
            _Member("way", "left", border_way[cell.left]),
            _Member("way", "right", border_way[cell.right]),
        ]
        tags = {
            "type": "lanelet",
            "subtype": "road",
            "location": "urban",
            "one_way": "no" if cell.is_two_way else "yes",
            "participant:vehicle": "yes",
        }
        yield from _relation(next(number), [*bounds, *rule], tags)


def _nodes(
    points_world: list[Float[np.ndarray, "_ 3"]], used: Bool[np.ndarray, " n"], hd_map: HdMap
) -> list[str]:
    """A node for each point that is used; all are numbered, from 1."""
    if not points_world:
        return []
    place = geodetic_from_local(np.concatenate(points_world), hd_map.origin)
    return [
        f'  <node id="{row}" version="1" visible="true" lat="{lat:.11f}" lon="{lon:.11f}">'
        f'<tag k="ele" v="{height:.5f}"/></node>'
        for row, (lat, lon, height) in enumerate(place.tolist(), start=1)
        if used[row - 1]
    ]


def _line_tags(lanes: Layer, row: int) -> dict[str, str]:
    tags = LINE_TAGS[lanes.columns["type"][row]]
    known = {name: lanes.columns[name][row] for name in lanes.columns if name != "type"}
    return tags | _texts(known | {"max_sigma_m": max(lanes.lists["sigma_m"][row])})


def _sign_tags(signs: Layer, row: int) -> dict[str, str]:
    known = {name: column[row] for name, column in signs.columns.items()}
    code = known.pop("type")
    covariance = " ".join(repr(known.pop(name)) for name in _COVARIANCE)
    drop = [*"xyz", *(f"q{a}" for a in "xyzw")]
    tags = {"type": "traffic_sign", "subtype": "unknown", "area": "yes"}
    if code is not None:
        # Lanelet2 writes the country in small letters and joins the code to it: de274, usR1-1.
        country, _, rest = code.rpartition(":")
        tags |= {"subtype": country.lower() + rest, "code": code}
    kept = {name: value for name, value in known.items() if name not in drop}
    return tags | _texts(kept | {"covariance": covariance})


def _texts(values: Mapping[str, object]) -> dict[str, str]:
    return {name: str(value) for name, value in values.items()}


def _way(number: int, nodes: Iterable[int], tags: Mapping[str, str]) -> Iterator[str]:
    yield f'  <way id="{number}" version="1" visible="true">'
    yield from (f'    <nd ref="{node}"/>' for node in nodes)
    yield from _tags(tags)
    yield "  </way>"


def _relation(number: int, members: list[_Member], tags: Mapping[str, str]) -> Iterator[str]:
    yield f'  <relation id="{number}" version="1" visible="true">'
    for member in members:
        yield f'    <member type="{member.kind}" role="{member.role}" ref="{member.number}"/>'
    yield from _tags(tags)
    yield "  </relation>"


def _tags(tags: Mapping[str, str]) -> Iterator[str]:
    for name, value in tags.items():
        yield f"    <tag k={quoteattr(name)} v={quoteattr(value)}/>"
