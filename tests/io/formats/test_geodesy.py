from __future__ import annotations

import numpy as np
import pytest

from crowdmap_torch.io.formats import geodesy
from crowdmap_torch.tables import Origin

ORIGINS = [
    Origin(32.9, -117.2, 120.0),
    Origin(0.0, 0.0, 0.0),
    Origin(-54.8, 179.999, -30.0),
    Origin(89.9, 10.0, 3000.0),
    Origin(-90.0, 0.0, 2800.0),
]


def scattered(count: int, far_m: float) -> np.ndarray:
    return np.random.default_rng(5).uniform(-far_m, far_m, (count, 3)) * (1, 1, 0.01)


@pytest.mark.parametrize("origin", ORIGINS, ids=lambda o: f"{o.lat_deg:g},{o.lon_deg:g}")
@pytest.mark.parametrize("far_m", [100.0, 1e6])
def test_a_place_comes_back_from_the_ellipsoid(origin: Origin, far_m: float):
    point = scattered(200, far_m)
    back = geodesy.local_from_geodetic(geodesy.geodetic_from_local(point, origin), origin)
    # A degree has 111 km, and 180 degrees have steps of 3e-14: 3e-9 m.
    np.testing.assert_allclose(back, point, rtol=0, atol=1e-8)


def test_the_origin_is_where_it_says():
    for origin in ORIGINS:
        lat, _, height = geodesy.geodetic_from_local(np.zeros(3), origin)
        assert lat == pytest.approx(origin.lat_deg, abs=1e-12)
        assert height == pytest.approx(origin.height_m, abs=1e-8)


def test_the_axes_are_east_north_and_up():
    origin = ORIGINS[0]
    place = geodesy.geodetic_from_local(100 * np.eye(3), origin)
    assert place[0, 1] > origin.lon_deg and place[1, 0] > origin.lat_deg
    np.testing.assert_allclose(place[2], [origin.lat_deg, origin.lon_deg, 220.0], atol=1e-8)
    # 100 m along the ground, by the ellipsoid's radii of curvature there.
    sin_sq = np.sin(np.radians(origin.lat_deg)) ** 2
    e_sq = 0.00669437999014
    across = 6378137 / np.sqrt(1 - e_sq * sin_sq)
    along = across * (1 - e_sq) / (1 - e_sq * sin_sq)
    assert np.radians(place[1, 0] - origin.lat_deg) == pytest.approx(100 / (along + 120), rel=1e-6)
    lon = np.radians(place[0, 1] - origin.lon_deg) * np.cos(np.radians(origin.lat_deg))
    assert lon == pytest.approx(100 / (across + 120), rel=1e-6)


def test_the_tangent_plane_rises_above_the_ellipsoid():
    height = geodesy.geodetic_from_local(np.array([1e4, 0.0, 0.0]), ORIGINS[1])[2]
    assert height == pytest.approx(np.hypot(6378137, 1e4) - 6378137, abs=1e-6)


def test_rotations_to_the_earth_frame_are_rotations():
    for origin in ORIGINS:
        R = geodesy.R_ecef_local(origin)
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-15)
        assert np.linalg.det(R) == pytest.approx(1)


def test_pyproj_says_the_same():
    pyproj = pytest.importorskip("pyproj", reason="pyproj (extra [gis]) is not installed")
    for origin in ORIGINS:
        at = f"+lon_0={origin.lon_deg} +lat_0={origin.lat_deg} +h_0={origin.height_m}"
        to_local = pyproj.Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad"
            f" +step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 {at}"
        )
        point = scattered(50, 1e5)
        lat, lon, height = geodesy.geodetic_from_local(point, origin).T
        np.testing.assert_allclose(
            np.stack(to_local.transform(lon, lat, height), axis=-1), point, rtol=0, atol=1e-8
        )
