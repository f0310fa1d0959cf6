"""WGS84 and the local frame."""

from __future__ import annotations

import pytest
import torch

from crowdmap_torch.geometry.geodesy import enu_from_wgs84, wgs84_from_enu

SAN_DIEGO = {"lat_deg": 32.9, "lon_deg": -117.2, "height_m": 120.0}


def test_the_origin_is_zero():
    origin = torch.tensor([32.9, -117.2, 120.0], dtype=torch.float64)
    zero = torch.zeros(3, dtype=torch.float64)
    torch.testing.assert_close(enu_from_wgs84(origin, **SAN_DIEGO), zero, atol=1e-8, rtol=0)


@pytest.mark.parametrize(
    "origin",
    [
        SAN_DIEGO,
        {"lat_deg": -33.0, "lon_deg": 151.0, "height_m": -5.0},
        {"lat_deg": 69.0, "lon_deg": 179.9999, "height_m": 0.0},
    ],
)
def test_there_and_back_is_the_identity(origin):
    generator = torch.Generator().manual_seed(0)
    enu = 20_000 * torch.randn(4, 25, 3, generator=generator, dtype=torch.float64)
    enu[..., 2] /= 200
    back = enu_from_wgs84(wgs84_from_enu(enu, **origin), **origin)
    # coordinates of 6e6 m have 1e-9 m of rounding; PROJ's way back to geodetic is good to 1e-7 m
    # near the ground
    torch.testing.assert_close(back, enu, atol=1e-6, rtol=0)


def test_the_axes_point_east_north_and_up():
    step = torch.eye(3, dtype=torch.float64) * 100
    wgs84 = wgs84_from_enu(step, **SAN_DIEGO)
    east, north, up = wgs84
    assert east[1] > -117.2
    assert east[0].item() == pytest.approx(32.9, abs=1e-6)
    assert north[0] > 32.9
    assert north[1].item() == pytest.approx(-117.2, abs=1e-9)
    assert up[2].item() == pytest.approx(220.0, abs=1e-6)


def test_a_degree_of_latitude_has_the_length_of_the_ellipsoid():
    wgs84 = torch.tensor([[32.901, -117.2, 120.0]], dtype=torch.float64)
    north = enu_from_wgs84(wgs84, **SAN_DIEGO)[0, 1].item()
    # radius of curvature of the meridian at 32.9 degrees: 6,354,200 m, and 120 m of height
    assert north == pytest.approx(110.902, abs=0.01)
