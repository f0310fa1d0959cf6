"""Tiles of the earth: a quadtree over WGS84 longitude and latitude, as HERE and NDS number it.

At level L the earth is 2^L columns from longitude -180 eastwards, and rows of the same 360 / 2^L degrees from
latitude -90 northwards, of which the 2^(L-1) up to the north pole are used. A tile's quadkey has a digit for each
level, the coarsest first: twice the bit of the row plus the bit of the column (HERE, "Map tiling"). NDS has the same
grid, one level lower ("Tiling scheme" of its specification).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

MAX_LEVEL = 24
"""Tiles of 2 m: below that nobody keeps maps in tiles. Borders of tiles are exact numbers."""


def tiles_at(
    lon_deg: Float[np.ndarray, " n"], lat_deg: Float[np.ndarray, " n"], level: int
) -> Int[np.ndarray, "n 2"]:
    """Column and row of the tile that holds each place; its south and west borders belong to it.

    Longitude 180 is -180, the north pole belongs to the uppermost row. ValueError for what is no place on the earth.
    """
    _refuse_level(level)
    lon, lat = (np.asarray(angle, dtype=np.float64) for angle in (lon_deg, lat_deg))
    if not ((np.abs(lon) <= 180) & (np.abs(lat) <= 90)).all():
        raise ValueError("expected longitudes in -180 to 180 and latitudes in -90 to 90 degrees")
    column = _floor(lon, 180.0, level) % 2**level
    row = np.minimum(_floor(lat, 90.0, level), 2 ** (level - 1) - 1)
    return np.stack((column, row), axis=-1)


def _floor(angle: Float[np.ndarray, " n"], begin: float, level: int) -> Int[np.ndarray, " n"]:
    """The tile of each angle in a row of tiles from `-begin` on."""
    side = 360 / 2**level
    found = np.floor((angle + begin) / side).astype(np.int64)
    # The sum is rounded, borders are not.
    found -= angle < found * side - begin
    return found + (angle >= (found + 1) * side - begin)


def quadkeys(tile: Int[np.ndarray, "n 2"], level: int) -> tuple[str, ...]:
    """The names of tiles, a digit for each level."""
    bits = (np.asarray(tile)[:, None, :] >> np.arange(level)[::-1, None]) & 1
    digits = (bits @ np.array([1, 2])).astype(np.uint8) + ord("0")
    return tuple(bytes(one).decode("ascii") for one in digits)


def tiles_of(names: Sequence[str]) -> Int[np.ndarray, "n 2"]:
    """Column and row of each quadkey; ValueError for what is none."""
    for name in names:
        if not is_quadkey(name):
            raise ValueError(
                f"expected 1 to {MAX_LEVEL} digits 0 to 3, the first 0 or 1, found {name!r}"
            )
    steps = [[(int(digit) & 1, int(digit) >> 1) for digit in name] for name in names]
    places = [[2**k for k in reversed(range(len(name)))] for name in names]
    pairs = [np.array(p) @ np.array(s) for p, s in zip(places, steps, strict=True)]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def is_quadkey(name: str) -> bool:
    """Whether a text names a tile of the earth: at the coarsest level the upper row lies beyond the pole."""
    return 1 <= len(name) <= MAX_LEVEL and name[0] in "01" and set(name) <= set("0123")


def tile_numbers(names: Sequence[str]) -> tuple[int, ...]:
    """HERE's tile numbers: quadkeys in base 4 behind a 1, which keeps their leading zeros."""
    return tuple(int(f"1{name}", 4) for name in names)


def bounds_deg(tile: Int[np.ndarray, "n 2"], level: int) -> Float[np.ndarray, "n 4"]:
    """West, south, east and north of tiles [deg]; east and north belong to the next ones."""
    _refuse_level(level)
    low = np.asarray(tile) * (360 / 2**level) - np.array([180.0, 90.0])
    high = (np.asarray(tile) + 1) * (360 / 2**level) - np.array([180.0, 90.0])
    return np.concatenate((low, high), axis=-1)


def _refuse_level(level: int) -> None:
    if not 1 <= level <= MAX_LEVEL:
        raise ValueError(f"expected a level of 1 to {MAX_LEVEL}, found {level}")
