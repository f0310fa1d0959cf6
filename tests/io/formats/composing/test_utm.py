from __future__ import annotations

import numpy as np
import pytest

from crowdmap_torch.io.formats.composing import utm


def test_a_place_is_where_proj_has_it():
    # pyproj 3.7 (PROJ 9): EPSG:32617, and the convergence of its meridians.
    place = np.array([40.44177902989321, -80.01294377242584])
    grid = utm.grid_from_geodetic(place, 17)
    np.testing.assert_allclose(grid, (583710.0070315006, 4477259.999832617), rtol=0, atol=1e-6)
    assert np.degrees(utm.convergence(place, 17)) == pytest.approx(0.6403158475, abs=1e-7)


def test_there_and_back_is_where_it_was():
    rng = np.random.default_rng(0)
    place = np.stack((rng.uniform(1, 80, 50), 9 + rng.uniform(-4, 4, 50)), axis=-1)
    back = utm.geodetic_from_grid(utm.grid_from_geodetic(place, 32), 32)
    np.testing.assert_allclose(back, place, rtol=0, atol=1e-12)


def test_the_grid_agrees_with_pyproj_everywhere():
    pyproj = pytest.importorskip("pyproj", reason="pyproj comes with crowdmap_torch[gis]")
    rng = np.random.default_rng(0)
    for zone in (10, 18, 33):
        to_grid = pyproj.Transformer.from_crs(4326, 32600 + zone, always_xy=True)
        lat, lon = rng.uniform(1, 80, 100), 6 * zone - 183 + rng.uniform(-4, 4, 100)
        expected = np.stack(to_grid.transform(lon, lat), axis=-1)
        found = utm.grid_from_geodetic(np.stack((lat, lon), axis=-1), zone)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)
