"""Pairs of points that are near each other, by a k-d tree."""

from __future__ import annotations

from itertools import product

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

_CELL_RADII = 4.0
"""Cells by which points are left out before a tree is built, in radii: those of one line share some."""
_MANY = 20_000
"""Of fewer points a tree is built as soon as some are left out."""
_MOST_ALIKE = 3
"""So is one of points that are not so many times as many as the others."""


def pairs_in_radius(point: Float[Tensor, "n d"], radius: float) -> Int[Tensor, "m 2"]:
    """All unordered pairs of points within `radius`, the smaller row first: memory grows with the pairs."""
    pair = KDTree(point.detach().cpu().numpy()).query_pairs(radius, output_type="ndarray")
    return torch.from_numpy(pair.astype(np.int64)).to(point.device)


def near_pairs(point: Float[Tensor, "n d"], *, radius: float, count: int) -> Int[Tensor, "m 2"]:
    """Unordered pairs of points within `radius`, where one is among the `count` nearest of the other.

    The first index of a pair is the smaller one; pairs are sorted. Memory grows with the number of points.
    """
    n = len(point)
    if n < 2:
        return torch.zeros(0, 2, dtype=torch.int64, device=point.device)
    tree_points = point.detach().cpu().numpy()
    k = min(count + 1, n)  # every point finds itself
    _, found = KDTree(tree_points).query(tree_points, k=k, distance_upper_bound=radius)
    found = found.reshape(n, k)
    i, place = np.nonzero(found < n)  # a miss is reported as n
    j = found[i, place]
    low, high = np.minimum(i, j), np.maximum(i, j)
    key = np.unique((low * n + high)[low != high])
    return torch.from_numpy(np.stack((key // n, key % n), axis=1)).to(point.device)


def cross_pairs(
    query: Float[Tensor, "n d"], point: Float[Tensor, "m d"], *, radius: float, count: int
) -> Int[Tensor, "p 2"]:
    """Rows of `query` with each of the up to `count` nearest rows of `point` within `radius`, sorted."""
    if not len(query) or not len(point):
        return torch.zeros(0, 2, dtype=torch.int64, device=query.device)
    k = min(count, len(point))
    tree = KDTree(point.detach().cpu().numpy())
    _, found = tree.query(query.detach().cpu().numpy(), k=k, distance_upper_bound=radius)
    found = found.reshape(len(query), k)
    i, place = np.nonzero(found < len(point))
    pairs = np.stack((i, found[i, place]), axis=1)
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    return torch.from_numpy(pairs[order]).to(query.device)


def pairs_between(
    a: Float[Tensor, "n d"], b: Float[Tensor, "m d"], *, radius: float
) -> tuple[Int[Tensor, " p"], Int[Tensor, " p"], Float[Tensor, " p"]]:
    """All pairs of points within `radius`: row of a, row of b, distance; sorted by rows."""
    if not len(a) or not len(b):
        empty = torch.zeros(0, dtype=torch.int64, device=a.device)
        return empty, empty, a.new_zeros(0)
    points = [p.detach().cpu().numpy() for p in (a, b)]
    rows_a, rows_b = (
        rows_near(one, other, radius) for one, other in zip(points, reversed(points), strict=True)
    )
    tree_a, tree_b = (KDTree(p[rows]) for p, rows in zip(points, (rows_a, rows_b), strict=True))
    pairs = tree_a.sparse_distance_matrix(tree_b, radius, output_type="ndarray")
    # One key for both rows: half the time of sorting by one and then by the other.
    key = rows_a[pairs["i"]] * len(b) + rows_b[pairs["j"]]
    order = np.argsort(key, kind="stable")
    row_a, row_b = (torch.as_tensor(rows) for rows in np.divmod(key[order], len(b)))
    distance = torch.as_tensor(pairs["v"][order]).to(a)
    return row_a.to(a.device), row_b.to(a.device), distance


def rows_near(
    many: Float[np.ndarray, "n d"], few: Float[np.ndarray, "m d"], radius: float
) -> Int[np.ndarray, " k"]:
    """Rows of `many` points, in order, among them all that are within `radius` of one of a `few`.

    Of a city's points those along one drive are left, by the cells that are around its own: time grows with the number of
    points, where building a tree of them takes ten times as long. Points that are not many more are all left.
    """
    if len(many) < max(_MANY, _MOST_ALIKE * len(few)) or not 0 < radius < np.inf:
        return np.arange(len(many))
    cell = _CELL_RADII * radius
    own = np.unique(np.floor(few / cell).astype(np.int64), axis=0)
    around = [_hashed(own + step) for step in product((-1, 0, 1), repeat=own.shape[1])]
    # Cells that are hashed alike by chance let some more through.
    size = 1 << (32 * len(own) * len(around)).bit_length()
    taken: Bool[np.ndarray, " h"] = np.zeros(size, dtype=bool)
    for keys in around:
        taken[keys & (size - 1)] = True
    return taken[_hashed(np.floor(many / cell).astype(np.int64)) & (size - 1)].nonzero()[0]


def _hashed(cell: Int[np.ndarray, "n d"]) -> Int[np.ndarray, " n"]:
    """A number for each cell, that of no other one in all likelihood (Teschner et al. 2003)."""
    found = np.zeros(len(cell), dtype=np.int64)
    for number in cell.T:
        found = found * 73_856_093 + number
        found ^= found >> 17
    return found


def layered(
    point: Float[Tensor, "n k"], layer: Int[Tensor, " n"], reach: float
) -> Float[Tensor, "n _"]:
    """Points with a coordinate more, in which the layers lie farther apart than a search reaches."""
    return torch.cat((point, 2 * reach * layer[:, None].to(point)), dim=1)
