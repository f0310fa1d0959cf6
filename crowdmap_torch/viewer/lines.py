"""Lines with fewer points: none is further than a tolerance from where the line was (Douglas and Peucker, 1973)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def simplified(point: Float[np.ndarray, "p d"], tolerance: float) -> Int[np.ndarray, " k"]:
    """Rows of a line's points that keep every other one within `tolerance` of the chord between its neighbours."""
    last = len(point) - 1
    if last < 2:
        return np.arange(len(point))
    keep = np.zeros(len(point), dtype=bool)
    keep[[0, last]] = True
    pending = [(0, last)]
    while pending:
        a, b = pending.pop()
        if b - a < 2:
            continue
        inside = point[a + 1 : b] - point[a]
        chord = point[b] - point[a]
        along = np.clip(inside @ chord / max(float(chord @ chord), 1e-12), 0.0, 1.0)
        away = np.square(inside - along[:, None] * chord).sum(-1)
        worst = int(away.argmax())
        if away[worst] > tolerance**2:
            middle = a + 1 + worst
            keep[middle] = True
            pending += [(a, middle), (middle, b)]
    return np.flatnonzero(keep)
