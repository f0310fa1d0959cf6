"""Positions that are those of the last fix: a receiver tells of a place less often than a camera takes pictures.

Whoever joins the two tables by "the last one before" has a car that stays where it is for some frames and then leaps. Judged
without units, as these may be wrong too.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

_DRIVES = 0.3
"""A leap over all frames since the one before it is driven at more than this share of the usual speed; a car that stood does
not."""
_STILL = 1e-6
"""A step shorter than this share of the longest one is none: a place went through a mount and back."""
_LAST = 1.5
"""A position is held for at most so many times as long as is usual."""
_LEAST_SHARE = 0.1
"""Share of the moving frames that have to be held: a car that crawls by rounded positions has fewer."""
_LEAST_LEAPS = 5
"""Fewer tell nothing."""


def held_frames(
    t: Float[np.ndarray, " f"], position: Float[np.ndarray, "f 3"]
) -> Bool[np.ndarray, " f"]:
    """Frames of a car that drives whose position is that of an earlier one; none where those are few. `t` in any unit."""
    none = np.zeros(len(t), dtype=bool)
    step = np.sqrt(np.square(np.diff(position, axis=0)).sum(-1))
    if len(step) < _LEAST_LEAPS:
        return none
    leap = np.flatnonzero(step > _STILL * step.max())
    if len(leap) < _LEAST_LEAPS:
        return none
    # A fix is new in the frame behind its leap, and holds until the next leap.
    fix = np.concatenate(([0], leap + 1))
    lasts = np.diff(t[fix])
    speed = step[leap] / np.maximum(lasts, 1e-300)
    drives = speed > _DRIVES * np.median(speed)
    held = (np.diff(fix) - 1)[drives].sum()
    if held < _LEAST_SHARE * (held + drives.sum()):
        return none
    # Of a car that stood for long only the end is not where it was.
    longest = _LAST * np.median(lasts[drives])
    until = np.append(t[fix[1:]], t[fix[-1]] + longest if drives[-1] else -np.inf)
    last = np.searchsorted(fix, np.arange(len(t)), side="right") - 1
    is_fresh = np.isin(np.arange(len(t)), fix)
    is_held = ~is_fresh & (until[last] - t < longest) & (until[last] > t)
    # Poses that froze now and then are held for longer than is usual.
    share = is_held.sum() / (is_held.sum() + drives.sum())
    return is_held if share >= _LEAST_SHARE else none
