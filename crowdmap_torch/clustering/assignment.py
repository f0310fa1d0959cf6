"""Gated bipartite matching, and the pairs of rows that lie within a window of each other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment
from torch import Tensor


def gated_matching(
    cost: Float[Tensor, "n m"], gate: float
) -> tuple[Int[Tensor, " k"], Int[Tensor, " k"]]:
    """Rows and columns of the partial matching that minimises the sum of costs, an unmatched pair counted as `gate`.

    Pairs that cost `gate` or more, infinity included, are never matched. One excellent pair is thus not given up for
    two poor ones. Rows come in ascending order.
    """
    row, column = match_arrays(cost.detach().cpu().numpy(), gate)
    return torch.from_numpy(row).to(cost.device), torch.from_numpy(column).to(cost.device)


def match_arrays(
    cost: Float[np.ndarray, "n m"], gate: float
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """`gated_matching` of NumPy's arrays, for loops over frames."""
    # What a match gains over none: where that is zero, an assignment of all rows may still pass through, and is
    # dropped.
    gain = np.maximum(gate - cost, 0)
    row, column = linear_sum_assignment(gain, maximize=True)
    matched = gain[row, column] > 0
    return row[matched], column[matched]


@dataclass(frozen=True)
class WindowPairs:
    """All pairs of rows whose times are at least 1 and at most a window apart, those of one later row adjacent."""

    first: Int[Tensor, " d"]
    """First earlier row that each row is paired with."""
    start: Int[Tensor, " d"]
    """Where the pairs of each later row start."""
    count: Int[Tensor, " d"]

    @property
    def total(self) -> int:
        """Number of pairs."""
        return int(self.count.sum())

    def to(self, device: torch.device | str) -> WindowPairs:
        """The same pairs on another device."""
        return WindowPairs(self.first.to(device), self.start.to(device), self.count.to(device))

    def chunks(self, size: int) -> Iterator[tuple[Int[Tensor, " p"], Int[Tensor, " p"]]]:
        """The pairs in order, (earlier rows, later rows), at most `size` of them at once."""
        for begin in range(0, self.total, size):
            pair = torch.arange(begin, min(begin + size, self.total), device=self.start.device)
            # Rows without pairs share their start with the next row; `right` steps over them.
            later = torch.searchsorted(self.start, pair, right=True) - 1
            yield self.first[later] + pair - self.start[later], later

    def index(self, earlier: Int[Tensor, "*b"], later: Int[Tensor, "*b"]) -> Int[Tensor, "*b"]:
        """Number of each pair; -1 for rows that are not within the window of each other."""
        rank = earlier - self.first[later]
        inside = (rank >= 0) & (rank < self.count[later])
        return torch.where(inside, self.start[later] + rank, -1)


def window_pairs(time: Int[Tensor, " d"], window: int) -> WindowPairs:
    """Pairs of rows at times `t` and `t + 1 .. t + window`; `time` must not decrease."""
    first = torch.searchsorted(time, time - window)
    count = torch.searchsorted(time, time) - first
    return WindowPairs(first=first, start=count.cumsum(0) - count, count=count)
