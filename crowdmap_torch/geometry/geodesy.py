"""Between WGS84 and the local East-North-Up frame that touches the ellipsoid at an origin."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from pyproj import Transformer
from pyproj.enums import TransformDirection
from torch import Tensor


def enu_from_wgs84(
    wgs84: Float[Tensor, "*batch 3"], *, lat_deg: float, lon_deg: float, height_m: float
) -> Float[Tensor, "*batch 3"]:
    """East, north, up [m] of points given as latitude, longitude [deg], ellipsoidal height [m]."""
    pipeline = _topocentric(lat_deg, lon_deg, height_m)
    lat, lon, height = _columns(wgs84)
    return _tensor(tuple(pipeline.transform(lon, lat, height, errcheck=True)), like=wgs84)


def wgs84_from_enu(
    enu: Float[Tensor, "*batch 3"], *, lat_deg: float, lon_deg: float, height_m: float
) -> Float[Tensor, "*batch 3"]:
    """Latitude, longitude [deg], ellipsoidal height [m] of points given as east, north, up [m]."""
    pipeline = _topocentric(lat_deg, lon_deg, height_m)
    inverse = TransformDirection.INVERSE
    east, north, up = _columns(enu)
    lon, lat, height = pipeline.transform(east, north, up, direction=inverse, errcheck=True)
    return _tensor((lat, lon, height), like=enu)


@lru_cache(maxsize=16)
def _topocentric(lat_deg: float, lon_deg: float, height_m: float) -> Transformer:
    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        "+step +proj=cart +ellps=WGS84 +step +proj=topocentric +ellps=WGS84 "
        f"+lat_0={lat_deg!r} +lon_0={lon_deg!r} +h_0={height_m!r}"
    )


def _columns(points: Tensor) -> tuple[np.ndarray, ...]:
    # Copies, in one dimension: PROJ writes where it reads, and makes floats of arrays without one.
    flat = points.detach().cpu().double().reshape(-1, 3)
    return tuple(column.numpy().copy() for column in flat.unbind(-1))


def _tensor(columns: tuple[np.ndarray, ...], like: Tensor) -> Tensor:
    return torch.from_numpy(np.stack(columns, axis=-1)).to(like).reshape(like.shape)
