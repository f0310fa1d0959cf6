"""Tiles of the earth: HERE's names, borders, poles, the antimeridian."""

from __future__ import annotations

import numpy as np
import pytest

from crowdmap_torch.geometry import quadtree


def named(lon: float, lat: float, level: int) -> str:
    tile = quadtree.tiles_at(np.array([lon]), np.array([lat]), level)
    return quadtree.quadkeys(tile, level)[0]


def test_the_brandenburg_gate_is_where_here_has_it() -> None:
    assert named(13.37770, 52.51627, 14) == "12201203120220"
    assert quadtree.tile_numbers(["12201203120220"]) == (377894440,)


@pytest.mark.parametrize("level", [1, 2, 7, 14, quadtree.MAX_LEVEL])
def test_names_and_tiles_are_one_to_one(level: int) -> None:
    draw = np.random.default_rng(0)
    lon, lat = draw.uniform(-180, 180, 500), draw.uniform(-90, 90, 500)
    tile = quadtree.tiles_at(lon, lat, level)
    names = quadtree.quadkeys(tile, level)
    assert all(map(quadtree.is_quadkey, names))
    assert np.array_equal(quadtree.tiles_of(names), tile)
    west, south, east, north = quadtree.bounds_deg(tile, level).T
    assert ((west <= lon) & (lon < east) & (south <= lat) & (lat < north)).all()


@pytest.mark.parametrize("level", [3, 14, quadtree.MAX_LEVEL])
def test_south_and_west_borders_belong_to_the_tile(level: int) -> None:
    draw = np.random.default_rng(1)
    rows = 2 ** (level - 1)
    tile = np.stack((draw.integers(1, 2 * rows, 200), draw.integers(1, rows, 200)), axis=-1)
    west, south, _, _ = quadtree.bounds_deg(tile, level).T
    assert np.array_equal(quadtree.tiles_at(west, south, level), tile)
    # The next number below, however near.
    before = quadtree.tiles_at(np.nextafter(west, -999), np.nextafter(south, -999), level)
    assert np.array_equal(before, tile - 1)


def test_the_antimeridian_and_the_poles_have_one_tile_each() -> None:
    lon, lat = np.array([-180.0, 180.0, 0.0, 0.0]), np.array([0.0, 0.0, 90.0, -90.0])
    tile = quadtree.tiles_at(lon, lat, 5)
    assert tile.tolist() == [[0, 8], [0, 8], [16, 15], [16, 0]]


def test_a_tile_is_in_that_of_the_level_above() -> None:
    assert named(-117.2, 32.9, 14).startswith(named(-117.2, 32.9, 9))


def test_no_place_has_no_tiles_either() -> None:
    none = np.zeros(0)
    assert quadtree.tiles_at(none, none, 14).shape == (0, 2)
    assert quadtree.quadkeys(quadtree.tiles_of(()), 14) == ()


@pytest.mark.parametrize("name", ["", "2", "0124", "0a", "0" * 25])
def test_what_names_no_tile_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="digits 0 to 3"):
        quadtree.tiles_of([name])


@pytest.mark.parametrize("place", [(180.1, 0.0), (0.0, 90.1), (float("nan"), 0.0)])
def test_what_is_no_place_is_refused(place: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="-180 to 180"):
        named(*place, 14)


def test_a_level_that_nobody_has_is_refused() -> None:
    with pytest.raises(ValueError, match="1 to 24"):
        named(0.0, 0.0, 0)
