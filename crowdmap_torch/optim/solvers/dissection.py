"""The order of landmarks: nested dissection of what binds them, so that the factor of their matrix stays sparse.

A set of landmarks that parts the others in two is put behind both, and each part is ordered likewise (George, Nested
dissection of a regular finite element mesh, 1973). Where to part, the Fiedler vector says, by which landmarks that are bound
to each other are near each other (Pothen, Simon and Liou, Partitioning sparse matrices with eigenvectors of graphs, 1990).
Where nothing parts them, those that are seen together stay together (reverse Cuthill-McKee).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import reverse_cuthill_mckee
from scipy.sparse.linalg import ArpackNoConvergence, eigsh

_WORTH = 640
"""Columns up to which a part is not parted further."""
_THICKEST = 0.3
"""A set that parts a part is of no use if it holds more than this share of its columns."""
_SHARES = np.linspace(0.3, 0.7, 21)
"""Where a part is tried to be parted, as shares of its columns."""
_UNEVEN = 0.03
"""Columns that a thinner set may save for each by which the halves differ."""
_PRECISION = 1e-3
"""Of a Fiedler vector: an order is all that it is for."""


class Order(NamedTuple):
    """Where landmarks stand on a line."""

    position: NDArray[np.int64]
    section: NDArray[np.int64]
    """Sections of the line, one behind the other: what is in the next one is bound to others behind it alone."""


def near_each_other(coupled: csr_array) -> NDArray[np.int64]:
    """Positions of landmarks on a line: those that are bound by one row are near each other."""
    order = reverse_cuthill_mckee(csr_array(coupled.T @ coupled), symmetric_mode=True)
    position = np.empty(len(order), dtype=np.int64)
    position[order] = np.arange(len(order))
    return position


def dissected(bound: csr_array, width: NDArray[np.int64], position: NDArray[np.int64]) -> Order:
    """The order of nested dissection, of which each half but the first begins a section.

    Each row of `bound` binds its landmarks to each other; they are so many columns `width`, and within a part they are
    ordered by `position`.
    """
    begun = np.argsort(position, kind="stable")
    if width.sum() <= _WORTH:
        return Order(position, np.zeros_like(position))
    placed: list[tuple[NDArray[np.int64], bool]] = []
    # Parts from the last to the first, as they come off the stack; whether a section ends behind them.
    waiting = [(begun, True, False)]
    while waiting:
        part, may_part, ends = waiting.pop()
        halves = _parted(bound, part, width) if may_part else None
        if halves is None:
            placed.append((part, ends))
            continue
        before, between, behind = halves
        # What is behind the last of `behind` may share a section with it: it is bound to all of that anyway.
        waiting += [(before, True, True), (behind, True, ends and not len(between))]
        if len(between):
            waiting.append((between, False, ends))
    parts = placed[::-1]
    order = np.concatenate([part for part, _ in parts])
    found, section = np.empty_like(position), np.empty_like(position)
    found[order] = np.arange(len(order))
    number = np.cumsum([0, *[ends for _, ends in parts[:-1]]])
    section[order] = np.repeat(number, [len(part) for part, _ in parts])
    return Order(found, section)


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
    level = _levels(own, back, 0)
    if (level < 0).any():
        apart = level >= 0
        return part[apart], part[:0], part[~apart]
    order = np.argsort(_fiedler(own, back), kind="stable")
    upto = np.cumsum(columns[order])
    best: tuple[float, NDArray[np.bool_], NDArray[np.bool_]] | None = None
    for share in _SHARES:
        before = np.zeros(len(part), dtype=bool)
        before[order[: np.searchsorted(upto, share * total)]] = True
        for near, far in ((before, ~before), (~before, before)):
            # Of one side those that touch the other.
            between = near & (back @ (own @ far.astype(np.int32)) > 0)
            inner, thick = near & ~between, columns[between].sum()
            smaller = min(columns[inner].sum(), columns[far].sum())
            score = thick + _UNEVEN * (total - 2 * smaller)
            if inner.any() and thick <= _THICKEST * total and (best is None or score < best[0]):
                best = (score, inner, between)
    if best is None:
        return None
    _, inner, between = best
    return part[inner], part[between], part[~inner & ~between]


def _fiedler(own: csr_array, back: csr_array) -> NDArray[np.float64]:
    """A number of every landmark: those that are bound to each other have about the same."""
    alike = csr_array((back @ own).astype(np.float64))
    alike.setdiag(0)
    root = 1 / np.sqrt(np.maximum(alike.sum(1), 1e-9))
    scale = diags_array(root)
    begin = np.sin(np.arange(1.0, len(root) + 1))
    how = {"which": "LA", "v0": begin, "tol": _PRECISION}
    try:
        _, vectors = eigsh(scale @ alike @ scale, k=2, **how)
    except ArpackNoConvergence:
        # Steps from a landmark that is furthest from some other.
        return _levels(own, back, int(_levels(own, back, 0).argmax())).astype(np.float64)
    found = vectors[:, 0] * root
    return found * np.sign(found[np.abs(found).argmax()])


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
