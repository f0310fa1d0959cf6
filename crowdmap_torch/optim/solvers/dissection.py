"""The order of landmarks: nested dissection of what binds them, so that the factor of their matrix stays sparse.

A set of landmarks that parts the others in two is put behind both, and each part is ordered likewise (George, Nested
dissection of a regular finite element mesh, 1973). Where nothing parts them, those that are seen together stay together
(reverse Cuthill-McKee).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

_WORTH = 640
"""Columns up to which a part is not parted further."""
_THICKEST = 0.3
"""A set that parts a part is of no use if it holds more than this share of its columns."""


def near_each_other(coupled: csr_array) -> NDArray[np.int64]:
    """Positions of landmarks on a line: those that are bound by one row are near each other."""
    order = reverse_cuthill_mckee(csr_array(coupled.T @ coupled), symmetric_mode=True)
    position = np.empty(len(order), dtype=np.int64)
    position[order] = np.arange(len(order))
    return position


def dissected(
    bound: csr_array, width: NDArray[np.int64], position: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Positions of landmarks in the order of nested dissection.

    Each row of `bound` binds its landmarks to each other; they are so many columns `width`, and within a part they are
    ordered by `position`.
    """
    begun = np.argsort(position, kind="stable")
    if width.sum() <= _WORTH:
        return position
    placed: list[NDArray[np.int64]] = []
    # Parts from the last to the first, as they come off the stack.
    waiting = [(begun, True)]
    while waiting:
        part, may_part = waiting.pop()
        halves = _parted(bound, part, width) if may_part else None
        if halves is None:
            placed.append(part)
            continue
        before, between, behind = halves
        waiting += [(before, True), (behind, True), (between, False)]
    order = np.concatenate(placed[::-1])
    found = np.empty_like(position)
    found[order] = np.arange(len(order))
    return found


_Halves = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]


def _parted(bound: csr_array, part: NDArray[np.int64], width: NDArray[np.int64]) -> _Halves | None:
    """A part as what is before, what is between, and what is behind; None where it is not to be parted."""
    columns = width[part]
    total = columns.sum()
    if total <= _WORTH:
        return None
    own = bound[:, part]
    own = own[np.diff(own.indptr) > 0]
    back = own.T.tocsr()
    # From some landmark to one that is furthest from it, and from there.
    level = _levels(own, back, 0)
    if (level < 0).any():
        apart = level >= 0
        return part[apart], part[:0], part[~apart]
    level = _levels(own, back, int(level.argmax()))
    last = int(level.max())
    if last < 2:
        return None
    upto = np.cumsum(np.bincount(level, weights=columns))
    best: tuple[float, NDArray[np.bool_], NDArray[np.bool_]] | None = None
    for cut in range(last):
        before = level <= cut
        if not 0.2 * total <= upto[cut] <= 0.8 * total and last > 3:
            continue
        for near, far in ((before, ~before), (~before, before)):
            # Of one side those that touch the other.
            between = near & (back @ (own @ far.astype(np.int32)) > 0)
            inner, thick = near & ~between, columns[between].sum()
            smaller = min(columns[inner].sum(), columns[far].sum())
            score = thick + 0.3 * (total - 2 * smaller)
            if inner.any() and thick <= _THICKEST * total and (best is None or score < best[0]):
                best = (score, inner, between)
    if best is None:
        return None
    _, inner, between = best
    return part[inner], part[between], part[~inner & ~between]


def _levels(own: csr_array, back: csr_array, start: int) -> NDArray[np.int64]:
    """Steps from one landmark to each other, by the rows that bind them; -1: there is no way."""
    level = np.full(len(back.indptr) - 1, -1, dtype=np.int64)
    front = np.zeros(len(level), dtype=np.int32)
    front[start], step = 1, 0
    while front.any():
        level[front > 0] = step
        reached = back @ (own @ front) > 0
        front, step = (reached & (level < 0)).astype(np.int32), step + 1
    return level


def incidence(row: NDArray[np.int64], column: NDArray[np.int64], columns: int) -> csr_array:
    """Which row holds which column, each once."""
    rows = int(row.max()) + 1 if len(row) else 1
    once = np.unique(np.stack((row, column)), axis=1)
    return csr_array(
        (np.ones(once.shape[1], dtype=np.int32), (once[0], once[1])), shape=(rows, columns)
    )
