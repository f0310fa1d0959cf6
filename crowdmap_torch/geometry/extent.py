"""How far points reach, in words."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor


def extent(point_world: Float[Tensor, "n 3"]) -> str:
    """Metres east and north that points reach over, such as `250 x 96 m`; those that are not finite are passed over."""
    place = point_world[point_world.isfinite().all(-1), :2]
    east, north = (place.amax(0) - place.amin(0)).tolist() if len(place) else (0.0, 0.0)
    return f"{east:,.0f} x {north:,.0f} m"
