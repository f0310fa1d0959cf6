"""Ways of drives through a city: straight on, to the left and to the right, each in the lane that it takes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from crowdmap_torch.simulate.roads import SPACING_M, Road
from crowdmap_torch.simulate.street_grid import Block, Corner, StreetGrid, even_way

_CHANGE_M = 45.0
"""Way over which a car changes lanes."""
_SMOOTH_M = 1.5
"""Ways are smoothed by this: nobody turns the wheel at once [m]."""
_BEFORE_LINE_M = 3.0
"""Cameras stop this far before the end of a street's markers."""


@dataclass(frozen=True)
class Route:
    """A way along the middles of lanes."""

    road: Road
    lights: Float[np.ndarray, " l"]
    """Stations where cars stop if a light is red."""


def drive_route(
    grid: StreetGrid, length_m: float, rng: np.random.Generator, *, changes_per_km: float
) -> Route:
    """A random route of at least `length_m`."""
    corners = random_corners(grid, length_m, rng)
    blocks = list(pairwise(corners))
    turns = [_turn(a, b, d) for (a, b), (_, d) in pairwise(blocks)] + [0]
    pieces: list[np.ndarray] = []
    stops, lane = [], 0
    for number, ((begin, end), turn) in enumerate(zip(blocks, turns, strict=True)):
        block, lanes = _block(begin, end), grid.lanes_of(_block(begin, end))
        came = turns[number - 1] if number else 0
        if number == 0:
            lane = int(rng.integers(lanes))
        elif came:
            lane = lanes - 1 if came < 0 else 0
        aim = lane
        if turn:
            aim = lanes - 1 if turn < 0 else 0
        elif lanes > 1 and rng.random() < changes_per_km * len(grid.way[block]) * SPACING_M / 1000:
            aim = lane + (1 if lane == 0 else -1)
        piece = _lane(grid, begin, end, (lane, aim), rng)
        if number == 0:
            piece = piece[int(rng.uniform(0.0, 0.5) * len(piece)) :]
        else:
            pieces.append(_over(pieces[-1], piece, came))
        pieces.append(piece)
        if grid.is_lit[end]:
            stops.append(len(pieces))
        lane = aim
    way = np.concatenate(pieces)
    run = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))))
    ends = np.cumsum([len(piece) for piece in pieces]) - 1
    smooth = even_way(gaussian_filter1d(even_way(way), _SMOOTH_M / SPACING_M, axis=0))
    smooth = smooth[20:-20]  # its ends are drawn inwards
    road = grid.road(smooth)
    lights = np.array([run[ends[count - 1]] for count in stops]) * road.length / run[-1]
    lights = lights - _BEFORE_LINE_M
    return Route(road, lights[(lights > 20.0) & (lights < road.length - 20.0)])


def random_corners(grid: StreetGrid, length_m: float, rng: np.random.Generator) -> list[Corner]:
    """Crossings one after another, until the way between them is long enough; every street is as likely as any other."""
    blocks = list(grid.way)
    begin, end = blocks[int(rng.integers(len(blocks)))]
    if rng.random() < 0.5:
        begin, end = end, begin
    corners, length = [begin, end], 0.0
    share = grid.config.turn_share
    while length < length_m + 20.0:
        (i, j), (k, m) = corners[-2:]
        ahead = (k - i, m - j)
        aims = {(k + ahead[0], m + ahead[1]): 1.0 - share}
        for side in (1, -1):
            aims[k - side * ahead[1], m + side * ahead[0]] = share / 2
        aims = {aim: p for aim, p in aims.items() if _block((k, m), aim) in grid.way}
        # Where a street ends at another, all ways alike: drives would gather along the city's border.
        chance = np.array([p if len(aims) == 3 else 1.0 for p in aims.values()])
        aim = list(aims)[int(rng.choice(len(aims), p=chance / chance.sum()))]
        block = _block((k, m), aim)
        # Markers' gaps are left out: across a crossing a turn is shorter than its street.
        length += len(grid.way[block]) * SPACING_M - sum(grid.gap(block, end) for end in block)
        corners.append(aim)
    return corners


def _block(a: Corner, b: Corner) -> Block:
    return (a, b) if a < b else (b, a)


def _turn(a: Corner, b: Corner, c: Corner) -> int:
    """1 to the left, -1 to the right, 0 straight on."""
    return (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0])


def _lane(
    grid: StreetGrid, begin: Corner, end: Corner, lanes: tuple[int, int], rng: np.random.Generator
) -> Float[np.ndarray, "n 2"]:
    """Points along a street in the direction of travel, from one lane to another."""
    block = _block(begin, end)
    way = grid.way[block] if block[0] == begin else grid.way[block][::-1]
    first = round(grid.gap(block, begin) / SPACING_M)
    last = len(way) - round(grid.gap(block, end) / SPACING_M)
    forward = np.gradient(way, axis=0)
    forward = (forward / np.linalg.norm(forward, axis=1, keepdims=True))[first:last]
    along = np.arange(last - first) * SPACING_M
    over = min(_CHANGE_M, 0.7 * along[-1])
    share = np.clip((along - rng.uniform(0.1, 0.9) * (along[-1] - over)) / over, 0, 1)
    share = share**3 * (10 - 15 * share + 6 * share**2)
    right = grid.lane_width * (lanes[0] + 0.5 + (lanes[1] - lanes[0]) * share)
    aside = np.stack((forward[:, 1], -forward[:, 0]), axis=-1)
    return (way[first:last] + right[:, None] * aside)[::5]


def _over(
    lane: Float[np.ndarray, "n 2"], following: Float[np.ndarray, "m 2"], turn: int
) -> Float[np.ndarray, "k 2"]:
    """A cubic over a crossing: of a quarter turn nearly a circle."""
    gap = following[0] - lane[-1]
    reach = float(np.linalg.norm(gap)) * (1.17 if turn else 1.0)
    out = reach * _direction(lane[-2:])
    into = reach * _direction(following[:2])
    u = np.linspace(0, 1, max(3, int(np.linalg.norm(gap) / 0.25)))[1:-1, None]
    h = (2 * u**3 - 3 * u**2 + 1, u**3 - 2 * u**2 + u, -2 * u**3 + 3 * u**2, u**3 - u**2)
    return h[0] * lane[-1] + h[1] * out + h[2] * following[0] + h[3] * into


def _direction(step: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, " 2"]:
    return (step[1] - step[0]) / np.linalg.norm(step[1] - step[0])
