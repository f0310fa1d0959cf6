"""GNSS fixes of receivers (NMEA 0183): places from GGA, the date from RMC or ZDA, headings from HDT or THS, sigmas from GST.

Heights are those above the ellipsoid: GGA's above the sea plus its separation of the geoid. Without headings, `--heading
course` takes the direction of travel.
"""

from __future__ import annotations

import calendar
from dataclasses import dataclass
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np

from crowdmap_torch.io.budget import read_text
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing import headings
from crowdmap_torch.io.formats.composing.lines import Line
from crowdmap_torch.io.formats.composing.parts import Asked, Importer, Parts
from crowdmap_torch.io.formats.composing.sources import the_one

_DAY_NS = 86_400 * 10**9


@dataclass
class _Epoch:
    """What sentences of one time of day say."""

    line: Line
    time_ns: int
    """Of the day."""
    place: tuple[float, float, float] | None = None
    heading_deg: float | None = None
    sigma: tuple[float, float, float] | None = None


def read(sources: tuple[Path, ...], asked: Asked) -> Parts:
    """The fixes of one file."""
    path = the_one(sources, "a text file of NMEA sentences")
    epochs, date_ns, notes = _epochs(path)
    fixes = [epoch for epoch in epochs if epoch.place is not None]
    if not fixes:
        raise InputError(f"{path}: has no GGA sentence with a fix; expected one for each place")
    if date_ns is None:
        raise InputError(f"{path}: has no date; expected an RMC or ZDA sentence")
    time_of_day = np.array([epoch.time_ns for epoch in fixes], dtype=np.int64)
    # A drive through midnight: the clock begins anew.
    t_ns = (
        date_ns + time_of_day + _DAY_NS * np.cumsum(np.diff(time_of_day, prepend=0) < -_DAY_NS // 2)
    )
    for before, now, epoch in zip(t_ns, t_ns[1:], fixes[1:], strict=False):
        if now <= before:
            raise epoch.line.fault("its time is not after that of the fix before; sort the file")
    told = [epoch.heading_deg for epoch in fixes]
    if (
        asked.heading != headings.COURSE
        and any(h is None for h in told)
        and any(h is not None for h in told)
    ):
        kept = [epoch for epoch in fixes if epoch.heading_deg is not None]
        notes = (*notes, f"{len(fixes) - len(kept)} fixes left out: without a heading")
        t_ns, fixes = t_ns[[h is not None for h in told]], kept
    heading = None
    if all(epoch.heading_deg is not None for epoch in fixes):
        heading = np.radians([epoch.heading_deg or 0.0 for epoch in fixes])
    sigma = None
    if all(epoch.sigma is not None for epoch in fixes):
        sigma = np.array([epoch.sigma for epoch in fixes])
    place = np.array([epoch.place for epoch in fixes])
    track, origin, more = headings.fixes(
        path, t_ns, place, asked, heading=heading, sigma_position=sigma
    )
    return Parts(track=track, origin=origin, notes=(*notes, *more))


def _epochs(path: Path) -> tuple[list[_Epoch], int | None, tuple[str, ...]]:
    """Epochs in the order of the file, the first date [ns], and what was left out."""
    epochs: list[_Epoch] = []
    date_ns: int | None = None
    broken = no_fix = above_sea = 0
    for number, text in enumerate(read_text(path).splitlines(), start=1):
        start = text.find("$")
        if start < 0:
            continue
        body, star, checksum = text[start + 1 :].strip().partition("*")
        if star and checksum[:2].upper() != f"{reduce(xor, body.encode(), 0):02X}":
            broken += 1
            continue
        line = Line(path, number, tuple(body.split(",")))
        kind = line.cells[0][2:]
        if kind in ("RMC", "ZDA") and date_ns is None:
            date_ns = _date_ns(line, kind)
        if kind == "GGA":
            if len(line.cells) < 12:
                raise line.fault(f"GGA with {len(line.cells)} values; expected 12 at least")
            if line.cells[6] in ("", "0"):
                no_fix += 1
                continue
            above_sea += not line.cells[11]
            epochs.append(_Epoch(line, _time_ns(line, 1), _place(line)))
        elif kind == "GST" and epochs and len(line.cells) > 8 and all(line.cells[6:9]):
            north, east, up = (line.real(k, "sigma") for k in (6, 7, 8))
            if _time_ns(line, 1) == epochs[-1].time_ns:
                epochs[-1].sigma = (east, north, up)
        elif kind in ("HDT", "THS") and epochs and len(line.cells) > 1 and line.cells[1]:
            # These have no time: they belong to the fix before.
            epochs[-1].heading_deg = line.real(1, "heading")
    counts = (
        (broken, "sentences left out: their checksum is wrong"),
        (no_fix, "GGA sentences without a fix"),
        (
            above_sea,
            "heights above the sea, not the ellipsoid: the separation of the geoid is empty",
        ),
    )
    return epochs, date_ns, tuple(f"{n} {what}" for n, what in counts if n)


def _time_ns(line: Line, cell: int) -> int:
    text = line.cells[cell]
    if len(text) < 6 or not text[:6].isdigit():
        raise line.fault(f"time: expected hhmmss.s, found {text!r}")
    whole = int(text[:2]) * 3600 + int(text[2:4]) * 60 + int(text[4:6])
    fraction = text[7:16] if text[6:7] == "." else ""
    if fraction and not fraction.isdigit():
        raise line.fault(f"time: expected hhmmss.s, found {text!r}")
    return whole * 10**9 + int(fraction.ljust(9, "0") or 0)


def _date_ns(line: Line, kind: str) -> int | None:
    cells = line.cells
    try:
        if kind == "RMC":
            day, month, year = (int(cells[9][k : k + 2]) for k in (0, 2, 4))
            year += 2000 if year < 80 else 1900
        else:
            day, month, year = (int(cells[k]) for k in (2, 3, 4))
        return calendar.timegm((year, month, day, 0, 0, 0)) * 10**9
    except (ValueError, IndexError):
        # Receivers that do not know the date yet leave it empty.
        return None


def _place(line: Line) -> tuple[float, float, float]:
    lat, lon = _degrees(line, 2, "NS"), _degrees(line, 4, "EW")
    above_sea = line.real(9, "altitude")
    separation = line.real(11, "separation of the geoid") if line.cells[11] else 0.0
    return lat, lon, above_sea + separation


def _degrees(line: Line, cell: int, signs: str) -> float:
    """Degrees of ddmm.mm or dddmm.mm and a letter."""
    value, letter = line.real(cell, "place"), line.cells[cell + 1]
    if letter not in tuple(signs):
        raise line.fault(f"expected one of the letters {signs}, found {letter!r}")
    degrees = int(value / 100) + value % 100 / 60
    return degrees if letter == signs[0] else -degrees


IMPORTER = Importer(
    summary="GNSS fixes of receivers, NMEA 0183: GGA, RMC or ZDA, HDT or THS, GST",
    gives=("poses",),
    tested_on="small files after the published layout",
    read=read,
)
