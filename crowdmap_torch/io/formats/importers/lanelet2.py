"""Lanelet2 maps (OSM files) as surveys: painted lines and curbs, and traffic signs.

Painted lines are ways of type `line_thin` and `line_thick` (subtypes solid, dashed, and pairs of them), curbs `curbstone`;
a way that comes twice counts once, ways with one `lane_id` tag that follow each other are one marker. Places are `lat`,
`lon` and `ele`, taken as the height above the ellipsoid. A sign with a `shape` tag is the polygon of its corners, clockwise
as the driver sees them (`crowdmap export --to lanelet2` writes that); of others only the centre is known.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.datasets import read_origin
from crowdmap_torch.io.documents import Document
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.parts import Asked, Importer, Parts, SurveyRows
from crowdmap_torch.io.formats.composing.sources import the_one
from crowdmap_torch.io.formats.composing.xml import read_xml
from crowdmap_torch.io.formats.geodesy import local_from_geodetic
from crowdmap_torch.tables import LANE_TYPES, Origin

_LINES = ("line_thin", "line_thick")
_CURB, _SIGN = "curbstone", "traffic_sign"


@dataclass(frozen=True)
class _Way:
    """A way of the file."""

    name: str
    nodes: tuple[str, ...]
    tags: dict[str, str]


def read(sources: tuple[Path, ...], asked: Asked) -> Parts:
    """The survey that one file is."""
    path = the_one(sources, "an OSM file")
    root = read_xml(path)
    place = {node.get("id", ""): _place(path, node) for node in root.iter("node")}
    ways = list(_ways(path, root, place))
    if not ways:
        raise InputError(f"{path}: has no ways; expected a Lanelet2 map")
    origin = asked.origin or _own_origin(path, root)
    if origin is None:
        origin = Origin(*place[ways[0].nodes[0]])
    order = {name: row for row, name in enumerate(place)}
    local = local_from_geodetic(np.array(list(place.values())), origin)

    def points_of(nodes: tuple[str, ...]) -> Float[np.ndarray, "p 3"]:
        return local[[order[node] for node in nodes]]

    lines = _lines([way for way in ways if way.tags.get("type") in (*_LINES, _CURB)])
    signs = [way for way in ways if way.tags.get("type") == _SIGN]
    shapes = [way.tags.get("shape") for way in signs]
    corners = [_corners(path, way, points_of(way.nodes)) for way in signs]
    survey = SurveyRows(
        source=path,
        lane_id=tuple(way.name for way in lines),
        lane_type=np.array([_type(way) for way in lines], dtype=np.int64),
        lane_points=tuple(points_of(way.nodes) for way in lines),
        sign_id=tuple(way.tags.get("sign_id", way.name) for way in signs),
        sign_shape=np.array(
            [polygon.RECTANGLE if s is None else polygon.SHAPES.index(s) for s in shapes], np.int64
        ),
        sign_code=tuple(_code(way) for way in signs),
        sign_corners=tuple(corners),
    )
    return Parts(survey=survey, origin=origin, notes=_notes(ways, lines, corners))


def _place(path: Path, node: Element) -> tuple[float, float, float]:
    tags = _tags(node)
    try:
        lat, lon = float(node.get("lat", "")), float(node.get("lon", ""))
        height = float(tags.get("ele", "0"))
    except ValueError as error:
        raise InputError(
            f"{path}: node {node.get('id')}: expected lat, lon and ele ({error})"
        ) from error
    if not (abs(lat) <= 90 and abs(lon) <= 180 and abs(height) <= 12_000):
        raise InputError(
            f"{path}: node {node.get('id')}: no place on the earth: {lat}, {lon}, {height}"
        )
    return lat, lon, height


def _ways(path: Path, root: Element, place: dict[str, tuple]) -> Iterator[_Way]:
    for way in root.iter("way"):
        name = way.get("id", "")
        nodes = tuple(member.get("ref", "") for member in way.iter("nd"))
        for node in nodes:
            if node not in place:
                raise InputError(
                    f"{path}: way {name}: node {node} is not in the file; expected it there"
                )
        if len(nodes) >= 2:
            yield _Way(name, nodes, _tags(way))


def _tags(element: Element) -> dict[str, str]:
    return {tag.get("k", ""): tag.get("v", "") for tag in element.iter("tag")}


def _own_origin(path: Path, root: Element) -> Origin | None:
    """The origin that `crowdmap export` notes in the file."""
    for note in root.iter("note"):
        try:
            content = json.loads(note.text or "")
        except ValueError:
            continue
        if isinstance(content, dict) and "crowdmap" in content:
            return read_origin(Document(path, content).part("crowdmap"))
    return None


def _lines(ways: list[_Way]) -> list[_Way]:
    """Markers: each set of nodes once, pieces of one `lane_id` joined where one ends at the other's beginning."""
    once: dict[tuple[str, ...], _Way] = {}
    for way in ways:
        once.setdefault(min(way.nodes, way.nodes[::-1]), way)
    markers: list[_Way] = []
    pieces: dict[str, list[_Way]] = {}
    for way in once.values():
        if (lane := way.tags.get("lane_id")) is None:
            markers.append(way)
        else:
            pieces.setdefault(lane, []).append(way)
    for lane, own in pieces.items():
        chains = _chains(own)
        names = [lane] if len(chains) == 1 else [f"{lane}-{k}" for k in range(len(chains))]
        markers += [
            _Way(name, nodes, own[0].tags) for name, nodes in zip(names, chains, strict=True)
        ]
    return markers


def _chains(ways: list[_Way]) -> list[tuple[str, ...]]:
    """Nodes of ways that follow each other, joined."""
    chains = [way.nodes for way in ways]
    joined = True
    while joined:
        joined = False
        begins = {chain[0]: k for k, chain in enumerate(chains)}
        for k, chain in enumerate(chains):
            after = begins.get(chain[-1], k)
            if after != k:
                chains[k] = chain + chains[after][1:]
                del chains[after]
                joined = True
                break
    return chains


def _type(way: _Way) -> int:
    if way.tags.get("type") == _CURB:
        return LANE_TYPES.index("curb")
    subtype = way.tags.get("subtype", "")
    if subtype in ("solid", "dashed"):
        return LANE_TYPES.index(subtype)
    return LANE_TYPES.index("double") if "_" in subtype else -1


def _code(way: _Way) -> str | None:
    code = way.tags.get("code", way.tags.get("subtype"))
    return None if code == "unknown" else code


def _corners(path: Path, way: _Way, points: Float[np.ndarray, "c 3"]) -> Float[np.ndarray, "_ 3"]:
    """The corners, or the centre alone."""
    if len(points) > 2 and way.nodes[0] == way.nodes[-1]:
        points = points[:-1]
    shape = way.tags.get("shape")
    if shape is None:
        # A line is the lower edge of a sign that is `height` high.
        up = 0.0
        if len(points) == 2 and "height" in way.tags:
            try:
                up = float(way.tags["height"]) / 2
            except ValueError as error:
                raise InputError(
                    f"{path}: way {way.name}: height: expected metres ({error})"
                ) from error
        return points.mean(0, keepdims=True) + np.array([0.0, 0.0, up])
    if shape not in polygon.SHAPES:
        raise InputError(
            f"{path}: way {way.name}: shape {shape!r} is unknown; expected one of {', '.join(polygon.SHAPES)}"
        )
    expected = int(polygon.CORNER_COUNT[polygon.SHAPES.index(shape)])
    if len(points) != expected:
        raise InputError(
            f"{path}: way {way.name}: {shape} with {len(points)} corners; expected {expected}"
        )
    return points


def _notes(ways: list[_Way], lines: list[_Way], corners: list[np.ndarray]) -> tuple[str, ...]:
    kinds = Counter(way.tags.get("type", "none") for way in ways)
    taken = sum(kinds.pop(kind, 0) for kind in (*_LINES, _CURB))
    kinds.pop(_SIGN, 0)
    centres = sum(len(own) == 1 for own in corners)
    notes = []
    if len(lines) < taken:
        notes.append(f"{taken - len(lines)} of {taken} ways are there twice, or pieces of others")
    if centres:
        notes.append(f"{centres} signs without a shape: only their centres are taken")
    if kinds:
        left = ", ".join(f"{kind} ({n})" for kind, n in kinds.most_common())
        notes.append(f"ways left out: {left}")
    return tuple(notes)


IMPORTER = Importer(
    summary="a Lanelet2 map as a survey: painted lines, curbs, signs",
    gives=("survey",),
    tested_on="real files",
    read=read,
)
