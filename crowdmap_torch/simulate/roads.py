"""Roads as ribbons: a centre line with curves, grades and bank, and the surface on both sides.

A place on the road is its station `s` along the centre line [m] and its offset `d` to the left
of it [m]. The surface is smooth but nowhere exactly a plane: grade and bank change.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from crowdmap_torch.ranges import Angle, Degrees, LengthOrNone, Settings, Share

SPACING_M = 0.1
"""Distance between samples of a centre line; its chords are off a 15 m curve by under 0.1 mm."""


@dataclass(frozen=True)
class Road:
    """The samples of a centre line, `SPACING_M` apart, and the directions there."""

    centre: Float[np.ndarray, "n 3"]
    forward: Float[np.ndarray, "n 3"]
    left: Float[np.ndarray, "n 3"]
    """Unit vector in the surface, square to `forward`; bank tilts it."""
    left_rate: Float[np.ndarray, "n 3"]
    """Derivative of `left` by the station [1/m]."""
    curvature: Float[np.ndarray, " n"]
    """Of the centre line in the top view, positive to the left [1/m]."""
    closed: bool
    """True if the last sample is the first one again."""

    @property
    def length(self) -> float:
        """Length of the centre line [m]."""
        return (len(self.centre) - 1) * SPACING_M

    def wrap(self, station: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """Stations brought into `[0, length]`: round the block, or cut off at the ends."""
        if self.closed:
            return np.asarray(np.mod(station, self.length))
        return np.asarray(np.clip(station, 0.0, self.length))

    def surface(
        self, station: Float[np.ndarray, "*batch"], offset: Float[np.ndarray, "*batch"]
    ) -> Float[np.ndarray, "*batch 3"]:
        """World points of the road surface."""
        return self._at(self.centre, station) + offset[..., None] * self._at(self.left, station)

    def leftwards(self, station: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch 3"]:
        """Unit vectors in the surface, to the left of those who drive along the stations."""
        return self._at(self.left, station)

    def tangent_frame(
        self,
        station: Float[np.ndarray, "*batch"],
        offset: Float[np.ndarray, "*batch"],
        offset_rate: Float[np.ndarray, "*batch"] | float = 0.0,
    ) -> Float[np.ndarray, "*batch 3 3"]:
        """Rotation `R_world_vehicle` (x ahead, y left, z up) in the exact tangent plane.

        `offset_rate` is the derivative of the offset by the station: the way of a lane change.
        """
        left = self._at(self.left, station)
        along = self._at(self.forward, station) + np.asarray(offset)[..., None] * self._at(
            self.left_rate, station
        )
        up = _unit(np.cross(along, left))
        ahead = _unit(along + np.broadcast_to(offset_rate, offset.shape)[..., None] * left)
        return np.stack((ahead, np.cross(up, ahead), up), axis=-1)

    def curvature_at(self, station: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """Curvature of the centre line [1/m]."""
        return self._at(self.curvature[:, None], station)[..., 0]

    def _at(
        self, samples: Float[np.ndarray, "n k"], station: Float[np.ndarray, "*batch"]
    ) -> Float[np.ndarray, "*batch k"]:
        place = self.wrap(np.asarray(station, dtype=np.float64)) / SPACING_M
        below = np.clip(place.astype(np.int64), 0, len(samples) - 2)
        share = (place - below)[..., None]
        return (1 - share) * samples[below] + share * samples[below + 1]


@dataclass(frozen=True)
class RoadShape(Settings):
    """How much a road turns, climbs and leans; each is a sum of waves of random phase."""

    heading_deg: Angle = 20.0
    """Amplitude of the heading; curves are `heading / wavelength` sharp."""
    heading_wavelength_m: LengthOrNone = 400.0
    grade: Share = 0.02
    """Largest slope, metres per metre."""
    grade_wavelength_m: LengthOrNone = 300.0
    bank_deg: Degrees = 1.5
    """Largest bank."""
    bank_wavelength_m: LengthOrNone = 250.0


def open_road(shape: RoadShape, length_m: float, rng: np.random.Generator) -> Road:
    """A winding road from one end to another."""
    station = _stations(length_m)
    heading_0 = rng.uniform(0, 2 * np.pi)
    heading = heading_0 + np.radians(shape.heading_deg) * _waves(
        station, shape.heading_wavelength_m, rng
    )
    grade = shape.grade * _waves(station, shape.grade_wavelength_m, rng)
    bank = np.radians(shape.bank_deg) * _waves(station, shape.bank_wavelength_m, rng)
    return _ribbon(heading, np.arctan(grade), bank, closed=False)


def block_road(shape: RoadShape, length_m: float, rng: np.random.Generator) -> Road:
    """A closed block of about `length_m`, round to the left: four sides, four rounded corners."""
    # A quarter turn with a raised-cosine curvature: about 12 m of radius in its middle.
    corner_m = 38.0
    station = _stations(max(length_m, 8 * corner_m))
    length = station[-1]
    # The profile repeats after half a round, so the way closes whatever a corner looks like.
    half = length / 2
    first, second = 0.2 * half, (0.2 + rng.uniform(0.52, 0.58)) * half
    corners = np.array([first, second, half + first, half + second])
    turns = _turn((station[:, None] - corners) / corner_m).sum(-1)
    heading = rng.uniform(0, 2 * np.pi) + np.pi / 2 * turns
    periodic = 2 * np.pi * station / length
    phases = rng.uniform(0, 2 * np.pi, 2)
    waves = 0.6 * np.sin(2 * periodic + phases[0]) + 0.4 * np.sin(5 * periodic + phases[1])
    bank = np.radians(shape.bank_deg) * np.sin(3 * periodic + rng.uniform(0, 2 * np.pi))
    return _ribbon(heading, np.arctan(shape.grade * waves), bank, closed=True)


def _turn(x: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """A step from 0 to 1 over x in [-1/2, 1/2], its derivative a raised cosine."""
    x = np.clip(x, -0.5, 0.5)
    return x + 0.5 + np.sin(2 * np.pi * x) / (2 * np.pi)


def _ribbon(
    heading: Float[np.ndarray, " n"],
    grade: Float[np.ndarray, " n"],
    bank: Float[np.ndarray, " n"],
    *,
    closed: bool,
) -> Road:
    forward = np.stack(
        (np.cos(heading) * np.cos(grade), np.sin(heading) * np.cos(grade), np.sin(grade)), axis=-1
    )
    level_left = np.stack((-np.sin(heading), np.cos(heading), np.zeros_like(heading)), axis=-1)
    left = np.cos(bank)[:, None] * level_left + np.sin(bank)[:, None] * np.cross(
        forward, level_left
    )
    steps = 0.5 * SPACING_M * (forward[1:] + forward[:-1])
    centre = np.concatenate((np.zeros((1, 3)), np.cumsum(steps, axis=0)))
    if closed:
        # What grade and rounding leave open (centimetres) is spread over the whole round.
        centre -= np.linspace(0, 1, len(centre))[:, None] * centre[-1]
    centre -= centre.mean(0)
    return Road(
        centre=centre,
        forward=forward,
        left=left,
        left_rate=np.gradient(left, SPACING_M, axis=0),
        curvature=np.gradient(heading, SPACING_M),
        closed=closed,
    )


def _stations(length_m: float) -> Float[np.ndarray, " n"]:
    return np.arange(round(length_m / SPACING_M) + 1) * SPACING_M


def _waves(
    station: Float[np.ndarray, " n"], wavelength: float, rng: np.random.Generator
) -> Float[np.ndarray, " n"]:
    """Three waves of random phase and somewhat random length, scaled to a largest value of one."""
    lengths = wavelength * np.array([1.0, 0.61, 1.73]) * rng.uniform(0.85, 1.15, 3)
    phases = rng.uniform(0, 2 * np.pi, 3)
    weights = np.array([1.0, 0.35, 0.5])
    waves = (weights * np.sin(2 * np.pi * station[:, None] / lengths + phases)).sum(-1)
    return waves / weights.sum()


def _unit(v: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)
