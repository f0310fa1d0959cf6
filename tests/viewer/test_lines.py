from __future__ import annotations

from itertools import pairwise

import numpy as np

from crowdmap_torch.viewer.lines import simplified


def away(point: np.ndarray, kept: np.ndarray) -> float:
    """How far the points are from the line through those that were kept."""
    worst = 0.0
    for a, b in pairwise(kept):
        chord = point[b] - point[a]
        inside = point[a : b + 1] - point[a]
        share = np.clip(inside @ chord / max(chord @ chord, 1e-12), 0, 1)
        worst = max(worst, float(np.linalg.norm(inside - share[:, None] * chord, axis=1).max()))
    return worst


def test_no_point_is_further_away_than_the_tolerance() -> None:
    s = np.linspace(0, 12, 900)
    curve = np.stack((40 * s, 30 * np.sin(s), 2 * np.cos(3 * s)), axis=-1)
    for tolerance in (0.01, 0.3, 5.0):
        kept = simplified(curve, tolerance)
        assert kept[0] == 0 and kept[-1] == len(curve) - 1
        assert away(curve, kept) <= tolerance
        assert len(kept) < len(curve)


def test_a_straight_line_has_two_points() -> None:
    line = np.linspace(0, 1, 50)[:, None] * np.array([3.0, 4.0, 5.0])
    assert simplified(line, 1e-6).tolist() == [0, 49]


def test_short_and_closed_lines_are_lines() -> None:
    assert simplified(np.zeros((0, 3)), 0.1).tolist() == []
    assert simplified(np.zeros((2, 3)), 0.1).tolist() == [0, 1]
    turn = np.linspace(0, 2 * np.pi, 40)
    circle = np.stack((np.cos(turn), np.sin(turn)), axis=-1)
    assert away(circle, simplified(circle, 0.05)) <= 0.05
