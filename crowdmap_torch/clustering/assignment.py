"""Gated bipartite matching, and the pairs of rows that lie within a window of each other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import connected_components
from torch import Tensor


def gated_matching(
    cost: Float[np.ndarray, "n m"], gate: float
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Rows and columns of the partial matching that minimises the sum of costs, an unmatched pair counted as `gate`.

    Pairs that cost `gate` or more, infinity included, are never matched. One excellent pair is thus not given up for
    two poor ones. Rows come in ascending order.
    """
    # What a match gains over none: where that is zero, an assignment of all rows may still pass through, and is
    # dropped.
    gain = np.maximum(gate - cost, 0)
    row, column = linear_sum_assignment(gain, maximize=True)
    matched = gain[row, column] > 0
    return row[matched], column[matched]


def matching_of_near(
    cost: Float[np.ndarray, "n m"], gate: float
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Rows and columns of the matching of least total cost of those columns whose cheapest row costs `gate` at most.

    The paper's spawning and matching (IV-A): the gate decides which columns take part, not whom they are matched with.
    Only pairs of infinite cost are never matched. Rows come in ascending order.
    """
    near = np.flatnonzero(cost.min(0, initial=np.inf) <= gate)
    cost = cost[:, near]
    possible = np.isfinite(cost)
    # Dearer than all that is possible together: taken only where nothing else is left, and dropped.
    row, column = linear_sum_assignment(np.where(possible, cost, cost[possible].sum() + 1))
    matched = possible[row, column]
    return row[matched], near[column[matched]]


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

    def chunks(self, size: int) -> Iterator[tuple[Int[Tensor, " p"], Int[Tensor, " p"]]]:
        """The pairs in order, (earlier rows, later rows), at most `size` of them at once."""
        for begin in range(0, self.total, size):
            pair = torch.arange(begin, min(begin + size, self.total), device=self.start.device)
            # Rows without pairs share their start with the next row; `right` steps over them.
            later = torch.searchsorted(self.start, pair, right=True) - 1
            yield self.first[later] + pair - self.start[later], later


def window_pairs(time: Int[Tensor, " d"], window: int) -> WindowPairs:
    """Pairs of rows at times `t` and `t + 1 .. t + window`; `time` must not decrease."""
    first = torch.searchsorted(time, time - window)
    count = torch.searchsorted(time, time) - first
    return WindowPairs(first=first, start=count.cumsum(0) - count, count=count)


def match_slots(
    row: Int[Tensor, " p"],
    slot: Int[Tensor, " p"],
    cost: Float[Tensor, " p"],
    *,
    rows: int,
    unmatched_cost: float,
) -> Int[Tensor, " n"]:
    """The slot of each of the `rows` rows, -1 for none, at the least total cost.

    Each slot takes at most one row; a row left without a slot costs `unmatched_cost`, so dearer pairs are never used.
    Rows whose cheapest slots differ from all others' take those at once; only where rows compete is an assignment
    problem solved, one for each set of rows that are connected by their candidates.
    """
    device = row.device
    keep = (cost < unmatched_cost).cpu().numpy()
    i, raw, c = (t.detach().cpu().numpy()[keep] for t in (row, slot, cost))
    result = np.full(rows, -1, dtype=np.int64)
    if not len(i):
        return torch.from_numpy(result).to(device)
    slots, s = np.unique(raw, return_inverse=True)
    order = np.lexsort((s, c, i))
    first = np.concatenate(([True], i[order][1:] != i[order][:-1]))
    best = order[first]  # the cheapest pair of every row that has one
    taken = np.bincount(s[best], minlength=len(slots))
    graph = sparse.coo_matrix((np.ones(len(i)), (i, rows + s)), shape=(rows + len(slots),) * 2)
    _, part = connected_components(graph, directed=False)
    contended = np.zeros(int(part.max()) + 1, dtype=bool)
    contended[part[rows:][taken > 1]] = True
    free = best[~contended[part[i[best]]]]
    result[i[free]] = slots[s[free]]

    pairs = np.nonzero(contended[part[i]])[0]
    pairs = pairs[np.argsort(part[i[pairs]], kind="stable")]
    if len(pairs):
        cuts = np.nonzero(np.diff(part[i[pairs]]))[0] + 1
        for block in np.split(pairs, cuts):
            block_rows, r = np.unique(i[block], return_inverse=True)
            block_slots, k = np.unique(s[block], return_inverse=True)
            matrix = np.full((len(block_rows), len(block_slots) + len(block_rows)), 1e12)
            matrix[r, k] = c[block]
            own = np.arange(len(block_rows))
            matrix[own, len(block_slots) + own] = unmatched_cost
            chosen_rows, chosen = linear_sum_assignment(matrix)
            real = chosen < len(block_slots)
            result[block_rows[chosen_rows[real]]] = slots[block_slots[chosen[real]]]
    return torch.from_numpy(result).to(device)
