"""Pairs of points that are near each other, by a k-d tree."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor


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
    tree_a, tree_b = (KDTree(p.detach().cpu().numpy()) for p in (a, b))
    pairs = tree_a.sparse_distance_matrix(tree_b, radius, output_type="ndarray")
    # One key for both rows: half the time of sorting by one and then by the other.
    key = pairs["i"].astype(np.int64) * len(b) + pairs["j"]
    order = np.argsort(key, kind="stable")
    row_a, row_b = (torch.as_tensor(rows) for rows in np.divmod(key[order], len(b)))
    distance = torch.as_tensor(pairs["v"][order]).to(a)
    return row_a.to(a.device), row_b.to(a.device), distance


def layered(
    point: Float[Tensor, "n k"], layer: Int[Tensor, " n"], reach: float
) -> Float[Tensor, "n _"]:
    """Points with a coordinate more, in which the layers lie farther apart than a search reaches."""
    return torch.cat((point, 2 * reach * layer[:, None].to(point)), dim=1)
