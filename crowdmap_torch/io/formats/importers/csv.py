"""Poses or GNSS fixes in a table of your own: CSV with a header of known names, in any order; other columns are not used.

Time: `t_ns`, `t_us`, `t_ms` or `t_s`. Place: `lat_deg lon_deg height_m` (WGS84, above the ellipsoid), or `x y z` [m].
Rotation: `qx qy qz qw`, or `heading_deg` (clockwise from north) with `pitch_deg` (nose up) and `roll_deg` (right side down)
if known; axes are then forward, left, up, and x y z count east, north, up. Optional: `frame`, `sigma_e sigma_n sigma_u`
[m], `sigma_rot` [rad].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing import headings
from crowdmap_torch.io.formats.composing.lines import TIME_UNITS, Line, poses, read_table, times
from crowdmap_torch.io.formats.composing.parts import Asked, Importer, Parts, Track
from crowdmap_torch.io.formats.composing.sources import the_one

_PLACE, _POSITION = ("lat_deg", "lon_deg", "height_m"), ("x", "y", "z")
_QUATERNION, _HEADING = ("qx", "qy", "qz", "qw"), "heading_deg"
_SIGMA, _SIGMA_ROTATION = ("sigma_e", "sigma_n", "sigma_u"), "sigma_rot"


def read(sources: tuple[Path, ...], asked: Asked) -> Parts:
    """The poses of one table."""
    path = the_one(sources, "a CSV file with a header")
    table = _Table(path, *read_table(path))
    t_ns = table.times()
    is_geodetic, is_turned = table.has(_PLACE), table.has(_QUATERNION)
    if is_geodetic == table.has(_POSITION):
        raise InputError(
            f"{path}: expected either columns {' '.join(_PLACE)} or {' '.join(_POSITION)}; found "
            f"{', '.join(table.head)}"
        )
    if is_turned:
        if is_geodetic:
            raise InputError(
                f"{path}: quaternions beside latitudes: to which axes do they turn? Expected heading_deg "
                "(and pitch_deg, roll_deg), or x y z"
            )
        T = poses(table.lines, table.numbers(_POSITION), table.numbers(_QUATERNION))
        return Parts(track=table.finished(Track(path, t_ns, T, world=None, link=None)))
    heading, pitch, roll = (table.angle(name) for name in (_HEADING, "pitch_deg", "roll_deg"))
    if is_geodetic:
        place = table.numbers(_PLACE)
        _refuse_no_place(table, place)
        track, origin, notes = headings.fixes(
            path, t_ns, place, asked, heading=heading, pitch=pitch, roll=roll
        )
        return Parts(track=table.finished(track), origin=origin, notes=notes)
    track = headings.at_positions(
        path, t_ns, table.numbers(_POSITION), asked, heading=heading, pitch=pitch, roll=roll
    )
    notes = () if pitch is not None or roll is not None else (headings.LEVEL_NOTE,)
    return Parts(track=table.finished(track), notes=notes)


class _Table:
    """The columns of a table by their names."""

    def __init__(self, path: Path, head: tuple[str, ...], lines: list[Line]) -> None:
        self.path, self.head, self.lines = path, head, lines
        twice = sorted({name for name in head if head.count(name) > 1})
        if twice:
            raise InputError(f"{path}: column {twice[0]!r} is there twice; expected it once")

    def has(self, names: Sequence[str]) -> bool:
        """Whether all of some columns are there; InputError if only some are."""
        there = [name for name in names if name in self.head]
        if there and len(there) < len(names):
            missing = next(name for name in names if name not in self.head)
            raise InputError(f"{self.path}: column {missing!r} is missing beside {there[0]!r}")
        return bool(there)

    def numbers(self, names: Sequence[str]) -> Float[np.ndarray, "n k"]:
        """Finite numbers of some columns."""
        cells = [self.head.index(name) for name in names]
        rows = [
            [line.real(cell, name) for cell, name in zip(cells, names, strict=True)]
            for line in self.lines
        ]
        return np.array(rows, dtype=np.float64)

    def angle(self, name: str) -> Float[np.ndarray, " n"] | None:
        """Angles of a column [rad], if it is there."""
        return np.radians(self.numbers((name,))[:, 0]) if name in self.head else None

    def times(self) -> Int[np.ndarray, " n"]:
        """Times that grow from row to row [ns]."""
        there = [unit for unit in TIME_UNITS if f"t_{unit}" in self.head]
        if len(there) != 1:
            raise InputError(
                f"{self.path}: {len(there)} columns of times; expected one of t_s, t_ms, t_us, t_ns"
            )
        return times(self.lines, self.head.index(f"t_{there[0]}"), there[0])

    def finished(self, track: Track) -> Track:
        """The track with the optional columns."""
        frame = sigma = sigma_rotation = None
        if "frame" in self.head:
            number = self.numbers(("frame",))[:, 0]
            frame = number.astype(np.int64)
            if (bad := number != frame).any():
                raise self.lines[int(bad.argmax())].fault("frame: expected a whole number")
        if self.has(_SIGMA):
            sigma = self.numbers(_SIGMA)
        if _SIGMA_ROTATION in self.head:
            sigma_rotation = self.numbers((_SIGMA_ROTATION,))[:, 0]
        return replace(
            track, frame_number=frame, sigma_position=sigma, sigma_rotation=sigma_rotation
        )


def _refuse_no_place(table: _Table, place: Float[np.ndarray, "n 3"]) -> None:
    bad = (np.abs(place[:, 0]) > 90) | (np.abs(place[:, 1]) > 180)
    if bad.any():
        raise table.lines[int(bad.argmax())].fault(
            "expected a latitude in -90 to 90 and a longitude in -180 to 180 degrees"
        )


IMPORTER = Importer(
    summary="poses or GNSS fixes with headings in a CSV with a header: t_s, lat_deg, ... (docs/OWN_DATA.md)",
    gives=("poses",),
    tested_on="small files after the published layout",
    read=read,
)
