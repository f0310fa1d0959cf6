"""The order of detections within a frame: by what they are, not by where they stood in the file.

FORMAT.md lets rows come in any order. Sums depend on the order of their terms in the last bits, so rows are sorted by their
content at the door: a file whose rows were shuffled gives the same map, bit by bit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int


def rows_by_content(
    usable: Bool[np.ndarray, " n"], frame: Int[np.ndarray, " n"], columns: Sequence[np.ndarray]
) -> Int[np.ndarray, " d"]:
    """The usable rows in the order of frames, those of one frame by each of the `columns` in turn.

    Rows that agree in all of them stay as they stood.
    """
    rows = np.flatnonzero(usable)
    return rows[np.lexsort([column[rows] for column in (*reversed(columns), frame)])]


def points_by_place(
    px: Float[np.ndarray, "p 2"], row: Int[np.ndarray, " p"]
) -> Int[np.ndarray, " p"]:
    """The points in the order of their rows, those of one row from the bottom of the image up, then from left to right."""
    return np.lexsort((px[:, 0], -px[:, 1], row))


def rank_of_lists(
    px: Float[np.ndarray, "p 2"], row: Int[np.ndarray, " p"], rows: int
) -> Int[np.ndarray, " n"]:
    """The rank of each row's list of points among all rows: equal for equal lists; points come in the order of rows."""
    count = np.bincount(row, minlength=rows)
    start = np.cumsum(count) - count
    rank = _rank_of_columns([count])
    # One point of all lists after the other, as long as some that have it are still alike.
    for k in range(int(count.max(initial=0))):
        tied = (np.bincount(rank, minlength=rows)[rank] > 1) & (count > k)
        if not tied.any():
            break
        point = np.full((rows, 2), np.nan)
        point[tied] = px[start[tied] + k]
        rank = _rank_of_columns([rank, point[:, 0], point[:, 1]])
    return rank


def _rank_of_columns(columns: Sequence[np.ndarray]) -> Int[np.ndarray, " n"]:
    """Each row's place when sorted by the columns in turn; equal rows share one."""
    order = np.lexsort(list(reversed(columns)))
    differs = np.zeros(len(order), dtype=bool)
    for column in columns:
        ordered = column[order]
        alike = (ordered[1:] == ordered[:-1]) | (
            (ordered[1:] != ordered[1:]) & (ordered[:-1] != ordered[:-1])
        )
        differs[1:] |= ~alike
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.cumsum(differs)
    return rank
