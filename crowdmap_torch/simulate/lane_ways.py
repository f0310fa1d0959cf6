"""The longest way that a car can drive along the lanes of a map: from lane to lane, and straight over gaps between them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from crowdmap_torch.io.formats.exporters.carriageways import Carriageways

_CROSSING_M = 40.0
"""Lanes go on beyond crossings that are no wider [m]."""
_TURN = 0.5
"""Cosine of the largest turn over a crossing."""
_EVERY_M = 1.0


def longest_way(ways: Carriageways) -> Float[np.ndarray, "n 3"]:
    """Points of the longest way, in the direction of travel; none if there is no lane."""
    lanes = _lanes(ways)
    after = [_followers(lanes, number) for number in range(len(lanes))]
    length = [float(np.linalg.norm(np.diff(lane, axis=0), axis=1).sum()) for lane in lanes]
    best: tuple[float, list[int]] = (0.0, [])
    for first in range(len(lanes)):
        way = [first]
        while True:
            open_ = [k for k in after[way[-1]] if k not in way]
            if not open_:
                break
            way.append(max(open_, key=lambda k: length[k]))
        total = sum(length[k] for k in way)
        if total > best[0]:
            best = (total, way)
    points: list[np.ndarray] = []
    for number in best[1]:
        if points:
            points.append(_over(points[-1], lanes[number]))
        points.append(lanes[number])
    return np.concatenate(points) if points else np.zeros((0, 3))


def _lanes(ways: Carriageways) -> list[Float[np.ndarray, "_ 3"]]:
    """Middles of lanes that share points with those that follow them, joined."""
    begin, end = [], []
    for cell in ways.cells:
        left = ways.nodes(cell.left, cell.is_left_reversed)
        right = ways.nodes(cell.right, cell.is_right_reversed)
        begin.append((int(left[0]), int(right[0])))
        end.append((int(left[-1]), int(right[-1])))
    starting = {tips: number for number, tips in enumerate(begin)}
    follows = {number: starting[tips] for number, tips in enumerate(end) if tips in starting}
    followed = set(follows.values())
    lanes, used = [], set()
    for first in sorted(range(len(ways.cells)), key=lambda number: number in followed):
        points = []
        number: int | None = first
        while number is not None and number not in used:
            used.add(number)
            points.append(_middle(ways, number))
            number = follows.get(number)
        if points:
            lanes.append(np.concatenate(points))
    return lanes


def _middle(ways: Carriageways, number: int) -> Float[np.ndarray, "n 3"]:
    cell = ways.cells[number]
    left = ways.points(cell.left, cell.is_left_reversed)
    right = ways.points(cell.right, cell.is_right_reversed)
    share = np.linspace(0, 1, max(2, len(left), len(right)))
    sides = [
        np.stack([np.interp(share, np.linspace(0, 1, len(side)), side[:, k]) for k in range(3)], -1)
        for side in (left, right)
    ]
    return (sides[0] + sides[1]) / 2


def _followers(lanes: list[Float[np.ndarray, "_ 3"]], number: int) -> list[int]:
    """Lanes that begin ahead of the end of one, over a crossing at the most."""
    tip, onward = lanes[number][-1], _direction(lanes[number], -1)
    found = []
    for other, lane in enumerate(lanes):
        gap = lane[0] - tip
        away = float(np.linalg.norm(gap[:2]))
        if other == number or away > _CROSSING_M:
            continue
        ahead = away < 2.0 or (
            gap[:2] @ onward > _TURN * away and gap[:2] @ _direction(lane, 0) > _TURN * away
        )
        if ahead and onward @ _direction(lane, 0) > _TURN and abs(gap[2]) < 2.0:
            found.append(other)
    return found


def _direction(lane: Float[np.ndarray, "n 3"], end: int) -> Float[np.ndarray, " 2"]:
    reach = min(5, len(lane) - 1)
    step = lane[reach, :2] - lane[0, :2] if end == 0 else lane[-1, :2] - lane[-1 - reach, :2]
    return step / max(float(np.linalg.norm(step)), 1e-12)


def _over(
    lane: Float[np.ndarray, "n 3"], following: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "k 3"]:
    """A cubic from the end of a lane to the beginning of the next."""
    gap = following[0] - lane[-1]
    away = float(np.linalg.norm(gap[:2]))
    u = np.linspace(0, 1, max(2, int(away / _EVERY_M)) + 1)[1:-1, None]
    out = np.append(_direction(lane, -1), 0.0) * away
    into = np.append(_direction(following, 0), 0.0) * away
    h = (2 * u**3 - 3 * u**2 + 1, u**3 - 2 * u**2 + u, -2 * u**3 + 3 * u**2, u**3 - u**2)
    return h[0] * lane[-1] + h[1] * out + h[2] * following[0] + h[3] * into
