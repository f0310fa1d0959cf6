"""ASAM OpenDRIVE maps as surveys: road marks along the borders of lanes, and signals as signs.

Reference lines are lines, arcs, spirals and cubics; heights are elevation, superelevation and heights of lanes. A border
is a marker where its road mark is a line or a curb. The origin is that of a transverse Mercator `geoReference` that
begins there (`crowdmap export --to opendrive` writes one), else `--origin`; x and y are east and north of it. A signal is a
sign of the shape and corners that `crowdmap export` noted, else a rectangle of its width and height where it faces.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
import torch
from jaxtyping import Float

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.parts import Asked, Importer, Parts, SurveyRows
from crowdmap_torch.io.formats.composing.road_lines import RoadLine, cubic, number
from crowdmap_torch.io.formats.composing.sources import the_one
from crowdmap_torch.io.formats.composing.xml import read_xml
from crowdmap_torch.tables import LANE_TYPES, Origin

_TYPES = {
    "solid": "solid",
    "broken": "dashed",
    "curb": "curb",
    "custom": None,
    **dict.fromkeys(("solid solid", "solid broken", "broken solid", "broken broken"), "double"),
}
"""Types of markers by those of road marks; others (none, grass, edge ...) are no markers."""
_STEP_M = 1.0
_JOINED_M = 0.2
"""Pieces of one marker that lie no farther apart are joined [m]."""


def read(sources: tuple[Path, ...], asked: Asked) -> Parts:
    """The survey that one file is."""
    path = the_one(sources, "an OpenDRIVE file")
    root = read_xml(path)
    if root.tag != "OpenDRIVE":
        raise InputError(f"{path}: its root is {root.tag}; expected OpenDRIVE")
    header = root.find("header")
    origin = asked.origin or _origin(path, header)
    if header is not None and header.find("offset") is not None:
        raise InputError(f"{path}: its header has an offset; expected a file without one")
    left_out: Counter[str] = Counter()
    pieces: list[tuple[str, int, np.ndarray]] = []
    signs: list[tuple[str, int, str | None, np.ndarray]] = []
    for element in root.iter("road"):
        road = RoadLine(path, element)
        pieces += _markers(road, left_out)
        signs += [_sign(road, signal) for signal in element.iter("signal")]
    if not pieces and not signs:
        raise InputError(f"{path}: has no road marks and no signals; expected a map with some")
    lanes = _joined(pieces)
    survey = SurveyRows(
        source=path,
        lane_id=tuple(name for name, _, _ in lanes),
        lane_type=np.array([kind for _, kind, _ in lanes], dtype=np.int64),
        lane_points=tuple(points for _, _, points in lanes),
        sign_id=tuple(name for name, *_ in signs),
        sign_shape=np.array([shape for _, shape, _, _ in signs], dtype=np.int64),
        sign_code=tuple(code for _, _, code, _ in signs),
        sign_corners=tuple(corners for *_, corners in signs),
    )
    notes = ()
    if left_out:
        texts = ", ".join(f"{kind} ({n})" for kind, n in left_out.most_common())
        notes = (f"road marks left out: {texts}",)
    return Parts(survey=survey, origin=origin, notes=notes)


def _origin(path: Path, header: Element | None) -> Origin:
    text = "" if header is None else header.findtext("geoReference") or ""
    known = dict(re.findall(r"\+(\w+)=(\S+)", text))
    shifts = [float(known.get(name, 0)) for name in ("x_0", "y_0")] if known else []
    if known.get("proj") != "tmerc" or any(shifts) or not {"lat_0", "lon_0"} <= known.keys():
        raise InputError(
            f"{path}: its geoReference is {text.strip() or 'missing'!r}; expected +proj=tmerc with lat_0 and lon_0 and "
            "no shift, or --origin LAT LON HEIGHT of its x = y = 0"
        )
    head = _noted(header)
    noted = head.get("origin") if isinstance(head, dict) else None
    height = float(noted.get("height_m", 0.0)) if isinstance(noted, dict) else 0.0
    return Origin(float(known["lat_0"]), float(known["lon_0"]), height)


def _noted(element: Element | None) -> dict:
    """What `crowdmap export` wrote beside an element; nothing in files of others."""
    for data in [] if element is None else element.findall("userData"):
        if data.get("code") == "crowdmap":
            try:
                content = json.loads(data.get("value", ""))
            except ValueError:
                continue
            return content if isinstance(content, dict) else {}
    return {}


def _markers(road: RoadLine, left_out: Counter[str]) -> list[tuple[str, int, np.ndarray]]:
    """Points of the road marks of all lane sections: id, type, places."""
    found = []
    sections = road.element.findall("lanes/laneSection")
    starts = [number(road.path, section, "s") for section in sections]
    for k, section in enumerate(sections):
        end = starts[k + 1] if k + 1 < len(sections) else road.length
        s = np.linspace(starts[k], end, max(2, math.ceil((end - starts[k]) / _STEP_M) + 1))
        lanes = {int(number(road.path, lane, "id")): lane for lane in section.iter("lane")}
        t = {0: cubic(road.path, road.element.findall("lanes/laneOffset"), "s", s)}
        for sign in (1, -1):
            for lane in sorted((i for i in lanes if i * sign > 0), key=abs):
                inside = t[lane - sign] if lane - sign in t else t[0]
                border = lanes[lane].findall("border")
                if border:
                    t[lane] = cubic(road.path, border, "sOffset", s - starts[k])
                else:
                    width = lanes[lane].findall("width")
                    t[lane] = inside + sign * cubic(road.path, width, "sOffset", s - starts[k])
        for lane, element in lanes.items():
            found += _marks(road, element, lane, s, starts[k], t, lanes, left_out)
    return found


def _marks(
    road: RoadLine,
    lane: Element,
    lane_id: int,
    s: Float[np.ndarray, " k"],
    start: float,
    t: dict[int, np.ndarray],
    lanes: dict[int, Element],
    left_out: Counter[str],
) -> list[tuple[str, int, np.ndarray]]:
    marks = lane.findall("roadMark")
    begins = [start + number(road.path, mark, "sOffset") for mark in marks]
    found = []
    for k, mark in enumerate(marks):
        kind = mark.get("type", "none")
        end = begins[k + 1] if k + 1 < len(marks) else float(s[-1])
        here = (s >= begins[k] - 1e-6) & (s <= end + 1e-6)
        if kind not in _TYPES:
            left_out[kind] += kind != "none"
            continue
        if here.sum() < 2:
            continue
        # Lane 0 has no height of its own; the lane outside of it may.
        lift = _lift(road, lane, "outer", s - start)
        if lane_id == 0:
            beside = lanes.get(-1) if -1 in lanes else lanes.get(1)
            lift = np.zeros(len(s)) if beside is None else _lift(road, beside, "inner", s - start)
        points = road.world(s, t[lane_id], lift)[here]
        name = str(_noted(mark).get("lane_id") or f"{road.element.get('id')}:{lane_id}")
        marker = _TYPES[kind]
        found.append((name, -1 if marker is None else LANE_TYPES.index(marker), points))
    return found


def _lift(
    road: RoadLine, lane: Element, edge: str, s: Float[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """Height of a lane's edge above the road's surface; each holds until the next."""
    heights = lane.findall("height")
    if not heights:
        return np.zeros(len(s))
    begins = np.array([number(road.path, height, "sOffset") for height in heights])
    values = np.array([number(road.path, height, edge) for height in heights])
    row = np.searchsorted(begins, s + 1e-9, side="right") - 1
    return np.where(row < 0, 0.0, values[np.maximum(row, 0)])


def _joined(pieces: list[tuple[str, int, np.ndarray]]) -> list[tuple[str, int, np.ndarray]]:
    """Markers of one name joined where one piece ends at the beginning of the next; the others numbered."""
    of: dict[tuple[str, int], list[np.ndarray]] = {}
    for name, kind, points in pieces:
        of.setdefault((name, kind), []).append(points)
    markers: list[tuple[str, int, np.ndarray]] = []
    for (name, kind), own in of.items():
        chains = list(own)
        joined = True
        while joined:
            joined = False
            for one in range(len(chains)):
                for other in range(len(chains)):
                    if one == other:
                        continue
                    for turned in (chains[other], chains[other][::-1]):
                        gap = np.linalg.norm(chains[one][-1] - turned[0])
                        if gap <= _JOINED_M and not joined:
                            chains[one] = np.concatenate((chains[one], turned[1:]))
                            joined = True
                    if joined:
                        del chains[other]
                        break
                if joined:
                    break
        names = [name] if len(chains) == 1 else [f"{name}-{k}" for k in range(len(chains))]
        markers += [(n, kind, points) for n, points in zip(names, chains, strict=True)]
    seen = Counter(name for name, _, _ in markers)
    return [
        (
            name if seen[name] == 1 else f"{name}-{LANE_TYPES[kind] if kind >= 0 else 'unknown'}",
            kind,
            points,
        )
        for name, kind, points in markers
    ]


def _sign(road: RoadLine, signal: Element) -> tuple[str, int, str | None, np.ndarray]:
    """A signal as a sign: id, shape, code, corners in the world; its centre alone where it has no size."""
    path, noted = road.path, _noted(signal)
    name = str(noted.get("sign_id") or f"signal-{signal.get('id')}")
    kind = signal.get("type", "-1")
    code = None if kind in ("-1", "none", "") else kind
    if code is not None and signal.get("country"):
        code = f"{signal.get('country')}:{code}"
    code = noted["type"] if isinstance(noted.get("type"), str) else code
    shape = noted.get("shape")
    shape = polygon.SHAPES.index(shape) if shape in polygon.SHAPES else polygon.RECTANGLE
    s, t = np.array([number(path, signal, "s")]), np.array([number(path, signal, "t")])
    heading = float(road.heading(s)[0]) + number(path, signal, "hOffset", 0.0)
    heading += 0.0 if signal.get("orientation") == "+" else math.pi
    bottom = road.world(s, t, np.zeros(1))[0] + [0, 0, number(path, signal, "zOffset", 0.0)]
    inertial = signal.find("positionInertial")
    pitch, roll = (number(path, signal, angle, 0.0) for angle in ("pitch", "roll"))
    if inertial is not None:
        bottom = np.array([number(path, inertial, axis) for axis in "xyz"])
        heading, pitch, roll = (
            number(path, inertial, angle, 0.0) for angle in ("hdg", "pitch", "roll")
        )
    size = [number(path, signal, side, 0.0) for side in ("width", "height")]
    if min(size) <= 0:
        return name, shape, code, bottom[None]
    corner = polygon.corners(torch.tensor([shape]), torch.tensor([size], dtype=torch.float64))[
        0
    ].numpy()[: int(polygon.CORNER_COUNT[shape])]
    # Onward, to the left and up of the driver who reads it; a sign's x is to the right, its z towards him.
    R = _rotation(heading, pitch, roll)
    across = -R[:, 1][None] * corner[:, :1] + R[:, 2][None] * (corner[:, 1:2] - corner[:, 1].min())
    return name, shape, code, bottom + across


def _rotation(heading: float, pitch: float, roll: float) -> Float[np.ndarray, "3 3"]:
    (ch, sh), (cp, sp), (cr, sr) = ((math.cos(a), math.sin(a)) for a in (heading, pitch, roll))
    yaw = np.array([[ch, -sh, 0], [sh, ch, 0], [0, 0, 1]])
    tip = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    lean = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return yaw @ tip @ lean


IMPORTER = Importer(
    summary="an ASAM OpenDRIVE map as a survey: road marks and signals",
    gives=("survey",),
    tested_on="small files after the published layout",
    read=read,
)
