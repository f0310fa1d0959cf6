"""A city's streets: lines that cross, the ground they lie on, and what stands between them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.ndimage import distance_transform_edt

from crowdmap_torch.ranges import Length, LengthOrNone, Range, Settings, Share
from crowdmap_torch.simulate.roads import SPACING_M, Road, RoadShape

Corner = tuple[int, int]
"""Which street that runs north, and which one that runs east: they cross there."""
Block = tuple[Corner, Corner]
"""A street from one crossing to the next one, named by both; the first is the one further west or south."""
_CORNER_M = 5.0
"""Markers end this far before the side of the street that crosses [m]."""
_CELL_M = 2.0
_SIGHT_STEP_M = 3.0


@dataclass(frozen=True)
class CityConfig(Settings):
    """Streets that cross, on a square."""

    square_m: Annotated[float, Range(0, 1e4, "metres: none to 10 km")] = 0.0
    """Width of the square; 0: the world is one road."""
    street_every_m: Annotated[float, Range(80, 2000, "metres: 80 m to 2 km")] = 250.0
    """Distance between streets that run the same way."""
    street_shift_m: LengthOrNone = 30.0
    """Most by which a street is shifted to its side: blocks differ."""
    corner_shift_m: LengthOrNone = 6.0
    """Most by which a single crossing is shifted: streets wind."""
    wide_share: Share = 0.4
    """Share of the streets that have all lanes of `lanes_ahead` and `lanes_back`; others have one each way."""
    turn_share: Share = 0.45
    """Probability that a drive turns at a crossing, left and right alike."""
    corner_sign_share: Share = 0.5
    """Probability of a post with a street's name where a street meets a crossing; a sign to stop comes with it where
    the street that crosses is wider and has no traffic light."""
    setback_m: Length = 15.0
    """Houses stand this far from the middle of a street; nobody sees a sign through them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        shifted = 2 * (self.street_shift_m + self.corner_shift_m)
        if self.square_m and self.square_m < self.street_every_m:
            raise ValueError(
                f"square_m: expected 0 (one road) or street_every_m ({self.street_every_m:g}) at least, "
                f"found {self.square_m:g}"
            )
        if self.square_m and shifted > self.street_every_m - 60.0:
            raise ValueError(
                f"street_shift_m and corner_shift_m: streets {self.street_every_m:g} m apart may come as near as "
                f"{self.street_every_m - shifted:g} m; expected 60 m at least: make them smaller"
            )


@dataclass(frozen=True)
class StreetGrid:
    """Streets from north to south and from east to west."""

    config: CityConfig
    lane_width: float
    lanes: tuple[tuple[int, ...], tuple[int, ...]]
    """Lanes each way of every street: of those that run north, from the west; of those that run east, from the south."""
    way: dict[Block, Float[np.ndarray, "_ 2"]]
    """Middle of each street from crossing to crossing, `SPACING_M` apart."""
    is_lit: Bool[np.ndarray, "n n"]
    """Whether a crossing has traffic lights."""
    wave: Float[np.ndarray, "w 2"]
    """Of the ground: wave vectors [rad/m]."""
    phase: Float[np.ndarray, " w"]
    rise: Float[np.ndarray, " w"]
    """Amplitudes [m]."""

    def lanes_of(self, block: Block) -> int:
        """Lanes each way."""
        (i, j), (k, _) = block
        return self.lanes[0][i] if i == k else self.lanes[1][j]

    def gap(self, block: Block, corner: Corner) -> float:
        """How far from the middle of a crossing a street's markers begin [m]."""
        (i, _), (k, _) = block
        across = self.lanes[1][corner[1]] if i == k else self.lanes[0][corner[0]]
        return across * self.lane_width + _CORNER_M

    def height(self, xy: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch"]:
        """Of the ground [m]: one smooth surface over the whole city."""
        return (self.rise * np.sin(xy @ self.wave.T + self.phase)).sum(-1)

    def slope(self, xy: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """Gradient of the height."""
        return (self.rise * np.cos(xy @ self.wave.T + self.phase)) @ self.wave

    def road(self, xy: Float[np.ndarray, "n 2"]) -> Road:
        """A ribbon that lies on the ground, along points that are `SPACING_M` apart."""
        centre = np.concatenate((xy, self.height(xy)[:, None]), axis=-1)
        slope = self.slope(xy)
        up = _unit(np.concatenate((-slope, np.ones((len(xy), 1))), axis=-1))
        forward = _unit(np.gradient(centre, axis=0))
        left = _unit(np.cross(up, forward))
        heading = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
        return Road(
            centre=centre,
            forward=forward,
            left=left,
            left_rate=np.gradient(left, SPACING_M, axis=0),
            curvature=np.gradient(heading, SPACING_M),
            closed=False,
        )

    def sees(
        self, eye: Float[np.ndarray, "d 2"], place: Float[np.ndarray, "d 2"]
    ) -> Bool[np.ndarray, " d"]:
        """True where no house stands between two places."""
        open_, low = self._open
        away = np.linalg.norm(place - eye, axis=-1).max(initial=0.0)
        seen = np.ones(len(eye), dtype=bool)
        for share in np.linspace(0, 1, max(2, int(away / _SIGHT_STEP_M) + 1)):
            cell = np.floor((eye + share * (place - eye) - low) / _CELL_M).astype(np.int64)
            inside = ((cell >= 0) & (cell < open_.shape)).all(-1)
            cell = np.clip(cell, 0, np.array(open_.shape) - 1)
            seen &= ~inside | open_[cell[:, 0], cell[:, 1]]
        return seen

    @cached_property
    def _open(self) -> tuple[Bool[np.ndarray, "x y"], Float[np.ndarray, " 2"]]:
        """Cells of the city where no house stands, and their lower left corner."""
        xy = np.concatenate([way[::10] for way in self.way.values()])
        low = xy.min(0) - 2 * self.config.setback_m
        shape = np.ceil((xy.max(0) + 2 * self.config.setback_m - low) / _CELL_M).astype(np.int64)
        is_off = np.ones(shape, dtype=bool)
        cell = np.floor((xy - low) / _CELL_M).astype(np.int64)
        is_off[cell[:, 0], cell[:, 1]] = False
        away = np.asarray(distance_transform_edt(is_off))
        return away * _CELL_M <= self.config.setback_m, low


def street_grid(
    config: CityConfig,
    shape: RoadShape,
    rng: np.random.Generator,
    *,
    lane_width: float,
    lanes: int,
    lights_per_km: float,
) -> StreetGrid:
    """The streets of a city; the wide ones have `lanes` each way."""
    count = round(config.square_m / config.street_every_m) + 1
    even = np.linspace(-config.square_m / 2, config.square_m / 2, count)
    east = even + config.street_shift_m * rng.uniform(-1, 1, count)
    north = even + config.street_shift_m * rng.uniform(-1, 1, count)
    corner = np.stack(np.meshgrid(east, north, indexing="ij"), axis=-1)
    corner = corner + config.corner_shift_m * rng.uniform(-1, 1, corner.shape)
    way: dict[Block, np.ndarray] = {}
    for k in range(count):
        for j, piece in enumerate(_pieces(corner[k])):
            way[(k, j), (k, j + 1)] = piece
        for i, piece in enumerate(_pieces(corner[:, k])):
            way[(i, k), (i + 1, k)] = piece
    is_wide = rng.random((2, count)) < config.wide_share
    of_all = tuple(tuple(lanes if wide else 1 for wide in row) for row in is_wide.tolist())
    lit = min(1.0, lights_per_km * config.street_every_m / 1000)
    angle = rng.uniform(0, 2 * np.pi, 4)
    length = shape.grade_wavelength_m * np.array([1.0, 1.4, 2.1, 3.0]) * rng.uniform(0.85, 1.15, 4)
    size = 2 * np.pi / length
    weight = np.array([0.2, 0.25, 0.25, 0.3])
    return StreetGrid(
        config=config,
        lane_width=lane_width,
        lanes=(of_all[0], of_all[1]),
        way=way,
        is_lit=rng.random((count, count)) < lit,
        wave=size[:, None] * np.stack((np.cos(angle), np.sin(angle)), axis=-1),
        phase=rng.uniform(0, 2 * np.pi, 4),
        # All waves at their steepest in one place and direction: the largest grade.
        rise=shape.grade * weight / size,
    )


def even_way(way: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    """Points `SPACING_M` apart along a way."""
    along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))))
    at = np.arange(int(along[-1] / SPACING_M) + 1) * SPACING_M
    return np.stack([np.interp(at, along, way[:, k]) for k in range(2)], axis=-1)


def _pieces(corner: Float[np.ndarray, "n 2"]) -> list[Float[np.ndarray, "_ 2"]]:
    """A smooth street through crossings, cut there."""
    at = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(corner, axis=0), axis=1))))
    spline = CubicSpline(at, corner, bc_type="natural")
    return [
        even_way(spline(np.linspace(first, last, max(2, round((last - first) / (SPACING_M / 2))))))
        for first, last in pairwise(at)
    ]


def _unit(v: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)
