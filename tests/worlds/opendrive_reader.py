"""A reader of OpenDRIVE that knows the standard and nothing of the exporter: places of lanes and signals in the world."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np


def number(element: ET.Element, name: str) -> float:
    return float(element.attrib[name])


def polynomial(records: list[ET.Element], key: str, at: float) -> float:
    """The cubic of the last record that begins at or before a place; 0 without one."""
    value = 0.0
    for record in records:
        offset = at - number(record, key)
        if offset >= -1e-9:
            a, b, c, d = (number(record, name) for name in "abcd")
            value = a + b * offset + c * offset**2 + d * offset**3
    return value


@dataclass
class ReadRoad:
    """One road element."""

    element: ET.Element

    @property
    def length(self) -> float:
        return number(self.element, "length")

    def line(self, s: float) -> tuple[float, float, float]:
        """x, y and heading of the reference line."""
        pieces = self.element.findall("planView/geometry")
        geometry = [piece for piece in pieces if number(piece, "s") <= s + 1e-9][-1]
        (poly,) = geometry
        assert poly.tag == "paramPoly3" and poly.attrib["pRange"] == "arcLength"
        p = s - number(geometry, "s")
        u, v = (
            sum(number(poly, f"{a}{axis}") * p**k for k, a in enumerate("abcd")) for axis in "UV"
        )
        du, dv = (
            sum(k * number(poly, f"{a}{axis}") * p ** (k - 1) for k, a in enumerate("abcd") if k)
            for axis in "UV"
        )
        hdg = number(geometry, "hdg")
        x = number(geometry, "x") + u * math.cos(hdg) - v * math.sin(hdg)
        y = number(geometry, "y") + u * math.sin(hdg) + v * math.cos(hdg)
        return x, y, hdg + math.atan2(dv, du)

    def world(self, s: float, t: float, z: float = 0.0, h: float = 0.0) -> np.ndarray:
        """A point at t on the tilted road, h square to it and z straight above."""
        x, y, hdg = self.line(s)
        height = polynomial(self.element.findall("elevationProfile/elevation"), "s", s)
        tilt = polynomial(self.element.findall("lateralProfile/superelevation"), "s", s)
        level = t * math.cos(tilt) - h * math.sin(tilt)
        up = t * math.sin(tilt) + h * math.cos(tilt)
        return np.array([x - level * math.sin(hdg), y + level * math.cos(hdg), height + up + z])

    def section(self, s: float) -> ET.Element:
        """The lane section that holds at a place: the last one that begins at or before it."""
        sections = self.element.findall("lanes/laneSection")
        return [section for section in sections if number(section, "s") <= s + 1e-9][-1]

    def lanes(self, s: float = 0.0) -> dict[int, ET.Element]:
        return {int(lane.attrib["id"]): lane for lane in self.section(s).iter("lane")}

    def borders(self, s: float) -> dict[int, float]:
        """The t of the outer border of every lane, and of lane 0."""
        lanes = self.lanes(s)
        at = s - number(self.section(s), "s")
        t = {0: polynomial(self.element.findall("lanes/laneOffset"), "s", s)}
        for sign in (1, -1):
            for k in range(1, len(lanes)):
                if sign * k in lanes:
                    width = polynomial(lanes[sign * k].findall("width"), "sOffset", at)
                    t[sign * k] = t[sign * (k - 1)] + sign * width
        return t

    def edges(self, s: float) -> list[np.ndarray]:
        """Inner and outer edges of all lanes to drive on in the world, at the heights that lanes have."""
        t, at = self.borders(s), s - number(self.section(s), "s")
        found = []
        for k, lane in self.lanes(s).items():
            if k and lane.attrib["type"] != "none":
                heights = [h for h in lane.findall("height") if number(h, "sOffset") <= at + 1e-9]
                inner, outer = (
                    number(heights[-1], name) if heights else 0.0 for name in ("inner", "outer")
                )
                inside = k - int(math.copysign(1, k))
                found += [self.world(s, t[inside], h=inner), self.world(s, t[k], h=outer)]
        return found


def facing(signal: ET.Element, road: ReadRoad) -> np.ndarray:
    """Unit vector that points out of the front of a signal."""
    heading = road.line(number(signal, "s"))[2] + number(signal, "hOffset")
    heading += {"+": 0.0, "-": math.pi}[signal.attrib["orientation"]]
    pitch = number(signal, "pitch")
    # Heading, then pitch, of the one who reads it; it looks back at him.
    return -np.array(
        [math.cos(heading) * math.cos(pitch), math.sin(heading) * math.cos(pitch), -math.sin(pitch)]
    )
