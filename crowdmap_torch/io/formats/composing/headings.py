"""Poses of vehicles whose files say headings, or nothing but where they were: link axes are forward, left, up."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.parts import Asked, Track
from crowdmap_torch.io.formats.geodesy import R_ecef_local, local_from_ecef, local_from_geodetic
from crowdmap_torch.tables import Origin

COURSE = "course"
LEVEL_NOTE = "pitch and roll do not stand in the file: the vehicle is taken to stand level"
_COURSE_M = 2.0
"""How far a vehicle must have come to show which way it goes."""


def rotation(
    heading: Float[np.ndarray, " n"], pitch: Float[np.ndarray, " n"], roll: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3 3"]:
    """R_enu_flu of headings clockwise from north, pitches nose up and rolls right side down [rad]."""
    yaw = np.pi / 2 - heading
    zero, one = np.zeros_like(yaw), np.ones_like(yaw)

    def turn(angle: np.ndarray, rows: tuple[tuple[str, ...], ...]) -> np.ndarray:
        values = {"0": zero, "1": one, "c": np.cos(angle), "s": np.sin(angle), "-s": -np.sin(angle)}
        return np.stack([np.stack([values[x] for x in row], -1) for row in rows], -2)

    about_z = turn(yaw, (("c", "-s", "0"), ("s", "c", "0"), ("0", "0", "1")))
    # Nose up is a negative turn about the axis to the left.
    about_y = turn(-pitch, (("c", "0", "s"), ("0", "1", "0"), ("-s", "0", "c")))
    about_x = turn(roll, (("1", "0", "0"), ("0", "c", "-s"), ("0", "s", "c")))
    return about_z @ about_y @ about_x


def course(position: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Headings [rad] along the way, from at least `_COURSE_M` behind to as much ahead; a vehicle that stands keeps its own.

    ValueError if it never comes that far.
    """
    way = np.concatenate(
        ([0.0], np.cumsum(np.sqrt(np.square(np.diff(position[:, :2], axis=0)).sum(-1))))
    )
    if way[-1] < _COURSE_M:
        raise ValueError(f"the vehicle moves {way[-1]:.1f} m; expected {_COURSE_M:g} m at least")
    before = np.clip(np.searchsorted(way, way - _COURSE_M / 2, side="right") - 1, 0, None)
    after = np.clip(np.searchsorted(way, way + _COURSE_M / 2), None, len(way) - 1)
    east, north = (position[after] - position[before])[:, :2].T
    return np.arctan2(east, north)


def fixes(
    source: Path,
    t_ns: Int[np.ndarray, " n"],
    place: Float[np.ndarray, "n 3"],
    asked: Asked,
    *,
    heading: Float[np.ndarray, " n"] | None,
    pitch: Float[np.ndarray, " n"] | None = None,
    roll: Float[np.ndarray, " n"] | None = None,
    sigma_position: Float[np.ndarray, "n 3"] | None = None,
) -> tuple[Track, Origin, tuple[str, ...]]:
    """Poses of an antenna at places (latitude, longitude [deg], height [m]) with angles [rad], their origin, and notes.

    The origin is the one asked for, or the first place. InputError if there is no heading and none was asked to be made.
    """
    origin = asked.origin or Origin(*place[0].tolist())
    position = local_from_geodetic(place, origin)
    track = at_positions(source, t_ns, position, asked, heading=heading, pitch=pitch, roll=roll)
    notes = () if pitch is not None or roll is not None else (LEVEL_NOTE,)
    return replace(track, sigma_position=sigma_position), origin, notes


def at_positions(
    source: Path,
    t_ns: Int[np.ndarray, " n"],
    position: Float[np.ndarray, "n 3"],
    asked: Asked,
    *,
    heading: Float[np.ndarray, " n"] | None,
    pitch: Float[np.ndarray, " n"] | None = None,
    roll: Float[np.ndarray, " n"] | None = None,
) -> Track:
    """Poses at positions in East-North-Up, with headings that the file has or with those of the way."""
    if asked.heading == COURSE:
        try:
            heading = course(position)
        except ValueError as error:
            raise InputError(f"{source}: no heading from the way: {error}") from error
    if heading is None:
        raise InputError(
            f"{source}: has no headings; give a file that has, or --heading course to take the direction "
            "of travel for them (good where the vehicle does not turn on the spot or drive backwards)"
        )
    level = np.zeros(len(heading))
    T = np.tile(np.eye(4), (len(position), 1, 1))
    T[:, :3, :3] = rotation(
        heading, level if pitch is None else pitch, level if roll is None else roll
    )
    T[:, :3, 3] = position
    return Track(source, t_ns, T, world="enu", link="flu")


def earth_centred(
    source: Path,
    t_ns: Int[np.ndarray, " n"],
    T_ecef_link: Float[np.ndarray, "n 4 4"],
    origin: Origin,
    link: str,
) -> Track:
    """Poses of an earth-centred world in the local frame of an origin."""
    T = np.tile(np.eye(4), (len(T_ecef_link), 1, 1))
    T[:, :3, :3] = R_ecef_local(origin).T @ T_ecef_link[:, :3, :3]
    T[:, :3, 3] = local_from_ecef(T_ecef_link[:, :3, 3], origin)
    return Track(source, t_ns, T, world="enu", link=link)
