"""Places on the WGS84 ellipsoid and in the local East-North-Up frame of an origin, exact to rounding, both ways.

Every step is a closed formula or converges to the last digit, so a place that goes there and comes back has
moved by less than 1e-8 m anywhere within 1,000 km of the origin.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from crowdmap_torch.tables import Origin

SEMI_MAJOR_M = 6378137.0
"""WGS84's radius at the equator [m], by definition."""
FLATTENING = 1 / 298.257223563
"""WGS84's flattening, by definition."""
_E_SQ = FLATTENING * (2 - FLATTENING)
_LATITUDE_STEPS = 6
"""Each shrinks the error of a latitude by 1e-3 or more near the ground: from 1e-3 rad at worst, three would do."""


def geodetic_from_local(
    point_world: Float[np.ndarray, "*n 3"], origin: Origin
) -> Float[np.ndarray, "*n 3"]:
    """Latitude [deg], longitude [deg, -180 to 180] and height above the ellipsoid [m] of points of the local frame."""
    return geodetic_from_ecef(ecef_from_local(point_world, origin))


def local_from_geodetic(
    place: Float[np.ndarray, "*n 3"], origin: Origin
) -> Float[np.ndarray, "*n 3"]:
    """East, north, up [m] of places given as latitude [deg], longitude [deg], height above the ellipsoid [m]."""
    return local_from_ecef(ecef_from_geodetic(place), origin)


def ecef_from_local(
    point_world: Float[np.ndarray, "*n 3"], origin: Origin
) -> Float[np.ndarray, "*n 3"]:
    """Earth-centred, earth-fixed coordinates [m] of points of the local frame."""
    return point_world @ R_ecef_local(origin).T + _ecef_origin(origin)


def local_from_ecef(
    point_ecef: Float[np.ndarray, "*n 3"], origin: Origin
) -> Float[np.ndarray, "*n 3"]:
    """Points of the local frame [m] from earth-centred, earth-fixed coordinates [m]."""
    return (point_ecef - _ecef_origin(origin)) @ R_ecef_local(origin)


def R_ecef_local(origin: Origin) -> Float[np.ndarray, "3 3"]:
    """Rotation from East-North-Up at an origin to the earth-centred, earth-fixed frame."""
    lat, lon = np.radians([origin.lat_deg, origin.lon_deg])
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    return np.array(
        [
            [-sin_lon, -sin_lat * cos_lon, cos_lat * cos_lon],
            [cos_lon, -sin_lat * sin_lon, cos_lat * sin_lon],
            [0.0, cos_lat, sin_lat],
        ]
    )


def ecef_from_geodetic(place: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Earth-centred, earth-fixed coordinates [m] of places given as latitude, longitude [deg] and height [m]."""
    place = np.asarray(place, dtype=np.float64)
    lat, lon, height = np.radians(place[..., 0]), np.radians(place[..., 1]), place[..., 2]
    across = SEMI_MAJOR_M / np.sqrt(1 - _E_SQ * np.sin(lat) ** 2)
    axis_distance = (across + height) * np.cos(lat)
    z = (across * (1 - _E_SQ) + height) * np.sin(lat)
    return np.stack((axis_distance * np.cos(lon), axis_distance * np.sin(lon), z), axis=-1)


def geodetic_from_ecef(point_ecef: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Latitude [deg], longitude [deg] and height [m] of earth-centred, earth-fixed points within 1,000 km of the ground.

    Bowring's iteration on the reduced latitude (1976).
    """
    x, y, z = np.moveaxis(np.asarray(point_ecef, dtype=np.float64), -1, 0)
    axis_distance = np.hypot(x, y)
    semi_minor = SEMI_MAJOR_M * (1 - FLATTENING)
    second_e_sq = _E_SQ / (1 - _E_SQ)
    reduced = np.arctan2(z, (1 - FLATTENING) * axis_distance)
    lat = reduced
    for _ in range(_LATITUDE_STEPS):
        lat = np.arctan2(
            z + second_e_sq * semi_minor * np.sin(reduced) ** 3,
            axis_distance - _E_SQ * SEMI_MAJOR_M * np.cos(reduced) ** 3,
        )
        reduced = np.arctan2((1 - FLATTENING) * np.sin(lat), np.cos(lat))
    sin_lat = np.sin(lat)
    height = (
        axis_distance * np.cos(lat)
        + z * sin_lat
        - SEMI_MAJOR_M * np.sqrt(1 - _E_SQ * np.square(sin_lat))
    )
    return np.stack((np.degrees(lat), np.degrees(np.arctan2(y, x)), height), axis=-1)


def _ecef_origin(origin: Origin) -> Float[np.ndarray, " 3"]:
    return ecef_from_geodetic(np.array([origin.lat_deg, origin.lon_deg, origin.height_m]))
