"""How far a drive's positions jump from frame to frame: by what no car does within four frames.

A car's way over a second is a parabola to a centimetre; what positions are off it is noise, and the random walk of their
drift, whose share is known. Single drives are mapped by the noise that is configured or, where the frames so far show more,
by what they show: links from frame to frame and triangulations rest on it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.tables import Journey

_FRAMES = 4
_MOST_SPAN_NS = 1_000_000_000
"""Frames further apart than this in all tell nothing: meanwhile a car may do as it likes."""
_LEAST_WAY_M = 0.5
"""A car that moves less meanwhile stands, and positions are held then: they tell nothing of others."""
_MOST = 10.0
"""So many times what is configured, at most: positions that stand still and leap are no noise."""
_FAR_SQ = 9.0
"""A jump counts as no more than so many times the variance: a single leap is no noise either."""
_SLACK = 0.2
"""So much of the variance's logarithm is chance."""
_PRIOR_FRAMES, _MEMORY_FRAMES = 10, 200
"""Frames that what is configured counts for, and those that an estimate remembers."""


class WhiteNoise:
    """The noise of a drive's positions as its frames so far show it; never looks ahead."""

    def __init__(self, positioning: PositioningNoise) -> None:
        self._given_m = positioning.white_sigma_m
        self._walk_m = positioning.walk_m
        self._variance = self._given_m**2
        self._frames = 0
        self._t_ns = np.zeros(0, dtype=np.int64)
        self._position = np.zeros((0, 3))

    @property
    def sigma_m(self) -> float:
        """1-sigma by axis [m]: at least what is configured."""
        found_m = math.sqrt(self._variance * math.exp(-_SLACK))
        return min(max(found_m, self._given_m), _MOST * self._given_m)

    def follow(
        self, t_ns: Int[np.ndarray, " f"], position: Float[np.ndarray, "f 3"]
    ) -> Float[np.ndarray, " f"]:
        """`sigma_m` after each of the next frames, by their times and positions."""
        t_ns = np.concatenate((self._t_ns, t_ns))
        position = np.concatenate((self._position, position))
        known, sigma = len(self._t_ns), np.full(len(t_ns), self.sigma_m)
        for at, square in enumerate(_squares(t_ns, position, self._walk_m)[known:].tolist()):
            if not math.isnan(square):
                self._learn(square)
            sigma[known + at] = self.sigma_m
        self._t_ns, self._position = t_ns[1 - _FRAMES :], position[1 - _FRAMES :]
        return sigma[known:]

    def _learn(self, square: float) -> None:
        self._frames += 1
        gain = 1 / min(self._frames + _PRIOR_FRAMES, _MEMORY_FRAMES)
        learned = self._variance + gain * (min(square, _FAR_SQ * self._variance) - self._variance)
        # From less it would take its time to find that there is noise.
        self._variance = max(learned, self._given_m**2)


def _squares(
    t_ns: Int[np.ndarray, " f"], position: Float[np.ndarray, "f 3"], walk_m: float
) -> Float[np.ndarray, " f"]:
    """For each frame the variance that white noise would have by the last four positions; NaN where they tell nothing.

    Their third divided difference, which a parabola has none of, without what a random walk of `walk_m` adds to it.
    """
    square = np.full(len(t_ns), np.nan)
    windows = len(t_ns) - _FRAMES + 1
    if windows < 1:
        return square
    # Sums are written out: frame by frame they have the same bits as all at once.
    when = [t_ns[k : k + windows] for k in range(_FRAMES)]
    place = [position[k : k + windows] for k in range(_FRAMES)]
    usable = (when[-1] - when[0] <= _MOST_SPAN_NS) & np.all(np.diff(when, axis=0) > 0, axis=0)
    usable &= _length(place[-1] - place[0]) > _LEAST_WAY_M
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = []
        for own in when:
            apart = [(own - other) * 1e-9 for other in when if other is not own]
            weight.append(1 / (apart[0] * apart[1] * apart[2]))
        a, b, c, d = weight
        norm_sq = a * a + b * b + c * c + d * d
        off = (a * place[0].T + b * place[1].T + c * place[2].T + d * place[3].T).T
        mean_sq = (off[:, 0] ** 2 + off[:, 1] ** 2 + off[:, 2] ** 2) / (3 * norm_sq)
        walked = 0.0
        for step, ahead in enumerate((b + c + d, c + d, d)):
            way = _length(place[step + 1] - place[step])
            walked = walked + ahead * ahead * way / norm_sq
        found = np.maximum(mean_sq - walk_m**2 * walked, 0.0)
    square[_FRAMES - 1 :] = np.where(usable, found, np.nan)
    return square


def _length(move: Float[np.ndarray, "f 3"]) -> Float[np.ndarray, " f"]:
    return np.sqrt(move[:, 0] ** 2 + move[:, 1] ** 2 + move[:, 2] ** 2)


def white_noise_along(journey: Journey, positioning: PositioningNoise) -> Float[np.ndarray, " f"]:
    """1-sigma of a journey's positions by axis [m], as at each frame those up to it show it."""
    t_ns, position = (x.cpu().numpy() for x in (journey.t_ns, journey.T_world_camera[:, :3, 3]))
    return WhiteNoise(positioning).follow(t_ns, position)


def with_white_noise(positioning: PositioningNoise, journey: Journey) -> PositioningNoise:
    """The noise of positions with that from frame to frame as a journey shows it: in half of its frames it is less."""
    found = white_noise_along(journey, positioning)
    return (
        replace(positioning, white_sigma_m=float(np.median(found))) if len(found) else positioning
    )
