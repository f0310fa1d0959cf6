"""GNSS tracks of hand-held receivers (GPX 1.0 and 1.1): points with time and `ele`, taken as the height above the ellipsoid.

There are no headings in them: `--heading course` takes the direction of travel.
"""

from __future__ import annotations

import calendar
import re
from pathlib import Path

import numpy as np

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing import headings
from crowdmap_torch.io.formats.composing.parts import Asked, Importer, Parts
from crowdmap_torch.io.formats.composing.sources import the_one
from crowdmap_torch.io.formats.composing.xml import read_xml

_TIME = re.compile(r"(\d{4})-(\d\d)-(\d\d)T(\d\d):(\d\d):(\d\d)(?:\.(\d{1,9}))?Z")


def read(sources: tuple[Path, ...], asked: Asked) -> Parts:
    """The points of all tracks of one file, one after the other."""
    path = the_one(sources, "a GPX file")
    points = [e for e in read_xml(path).iter() if e.tag.rpartition("}")[2] == "trkpt"]
    if not points:
        raise InputError(f"{path}: has no track points; expected <trkpt> with time and ele")
    place, t_ns = [], []
    for number, point in enumerate(points, start=1):
        inside = {child.tag.rpartition("}")[2]: (child.text or "").strip() for child in point}
        where = f"{path}: track point {number}"
        place.append(
            (
                _number(where, point.get("lat"), "lat", 90),
                _number(where, point.get("lon"), "lon", 180),
                _number(where, inside.get("ele"), "ele", 12_000),
            )
        )
        t_ns.append(_time_ns(where, inside.get("time")))
        if len(t_ns) > 1 and t_ns[-1] <= t_ns[-2]:
            raise InputError(f"{where}: its time is not after that of the point before")
    track, origin, notes = headings.fixes(
        path, np.array(t_ns), np.array(place), asked, heading=None
    )
    return Parts(track=track, origin=origin, notes=notes)


def _number(where: str, text: str | None, name: str, most: float) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = float("nan")
    if not abs(value) <= most:
        raise InputError(f"{where}: {name}: expected a number, {most:g} at most, found {text!r}")
    return value


def _time_ns(where: str, text: str | None) -> int:
    found = _TIME.fullmatch(text or "")
    if found is None:
        raise InputError(f"{where}: time: expected 2026-05-01T10:00:00.000Z, found {text!r}")
    *whole, fraction = found.groups()
    seconds = calendar.timegm(tuple(map(int, whole)))
    return seconds * 10**9 + int((fraction or "").ljust(9, "0"))


IMPORTER = Importer(
    summary="GNSS tracks, GPX: points with lat, lon, ele and time; with --heading course",
    gives=("poses",),
    tested_on="small files after the published layout",
    read=read,
)
