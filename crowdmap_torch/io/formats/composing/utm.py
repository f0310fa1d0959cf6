"""Places of the UTM grid, by Krueger's series as Karney has it (2011, to the fifth order: micrometres within a zone)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from crowdmap_torch.io.formats.geodesy import FLATTENING, SEMI_MAJOR_M

_SCALE, _FALSE_EASTING_M, _FALSE_NORTHING_M = 0.9996, 500_000.0, 10_000_000.0
_N = FLATTENING / (2 - FLATTENING)
_RADIUS_M = SEMI_MAJOR_M / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64 + _N**6 / 256)
_ALPHA = (
    _N / 2 - 2 / 3 * _N**2 + 5 / 16 * _N**3 + 41 / 180 * _N**4 - 127 / 288 * _N**5,
    13 / 48 * _N**2 - 3 / 5 * _N**3 + 557 / 1440 * _N**4 + 281 / 630 * _N**5,
    61 / 240 * _N**3 - 103 / 140 * _N**4 + 15061 / 26880 * _N**5,
    49561 / 161280 * _N**4 - 179 / 168 * _N**5,
    34729 / 80640 * _N**5,
)
_ECCENTRICITY = np.sqrt(FLATTENING * (2 - FLATTENING))


def grid_from_geodetic(lat_lon: Float[np.ndarray, "*n 2"], zone: int) -> Float[np.ndarray, "*n 2"]:
    """Easting and northing [m] of latitudes and longitudes [deg] in a zone, of the northern hemisphere's numbering."""
    lat, lon = np.moveaxis(np.radians(lat_lon), -1, 0)
    away = lon - np.radians(_meridian_deg(zone))
    sin = np.sin(lat)
    # The tangent of the conformal latitude.
    tau = np.sinh(np.arctanh(sin) - _ECCENTRICITY * np.arctanh(_ECCENTRICITY * sin))
    xi, eta = np.arctan2(tau, np.cos(away)), np.arcsinh(np.sin(away) / np.hypot(tau, np.cos(away)))
    x, y = eta.copy(), xi.copy()
    for k, alpha in enumerate(_ALPHA, start=1):
        y += alpha * np.sin(2 * k * xi) * np.cosh(2 * k * eta)
        x += alpha * np.cos(2 * k * xi) * np.sinh(2 * k * eta)
    grid = np.stack((x, y), axis=-1) * _RADIUS_M * _SCALE
    return grid + np.array([_FALSE_EASTING_M, 0.0])


def geodetic_from_grid(
    east_north: Float[np.ndarray, "*n 2"], zone: int
) -> Float[np.ndarray, "*n 2"]:
    """The way back, by Newton's method on the way there: to the last digit."""
    target = np.asarray(east_north, dtype=np.float64)
    # From a sphere's answer: every step squares the error.
    lat = np.degrees((target[..., 1]) / (_SCALE * _RADIUS_M))
    lon = _meridian_deg(zone) + np.degrees(
        (target[..., 0] - _FALSE_EASTING_M) / (_SCALE * _RADIUS_M * np.cos(np.radians(lat)))
    )
    place = np.stack((lat, lon), axis=-1)
    step = 1e-5
    for _ in range(8):
        at = grid_from_geodetic(place, zone)
        columns = [
            (grid_from_geodetic(place + d, zone) - grid_from_geodetic(place - d, zone)) / (2 * step)
            for d in (np.array([step, 0.0]), np.array([0.0, step]))
        ]
        J = np.stack(columns, axis=-1)
        place = place + np.linalg.solve(J, (target - at)[..., None])[..., 0]
    return place


def convergence(lat_lon: Float[np.ndarray, " 2"], zone: int) -> float:
    """How far grid north is clockwise from true north at a place [rad]."""
    ahead = np.array([1e-5, 0.0])
    east, north = grid_from_geodetic(lat_lon + ahead, zone) - grid_from_geodetic(
        lat_lon - ahead, zone
    )
    # True north in the grid's axes; grid north lies to the other side of it.
    return float(-np.arctan2(east, north))


def _meridian_deg(zone: int) -> float:
    return 6.0 * zone - 183.0
