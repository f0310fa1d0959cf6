"""Sums, medians, majorities and extremes over groups of rows; a label column says the group, -1 none."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor


def group_sum(
    value: Shaped[Tensor, "n ..."], label: Int[Tensor, " n"], groups: int
) -> Shaped[Tensor, "g ..."]:
    """Sum over each group; zero for an empty one."""
    used = label >= 0
    total = value.new_zeros(groups, *value.shape[1:])
    return total.index_add(0, label[used], value[used])


def group_count(label: Int[Tensor, " n"], groups: int) -> Int[Tensor, " g"]:
    """Rows in each group."""
    return torch.bincount(label[label >= 0], minlength=groups)


def group_median(
    value: Float[Tensor, "n ..."], label: Int[Tensor, " n"], groups: int
) -> Float[Tensor, "g ..."]:
    """Median over each group, column by column; of an even number the mean of the middle two; NaN for an empty one."""
    used = label >= 0
    key = label[used]
    flat = value[used].reshape(len(key), math.prod(value.shape[1:]))
    size = torch.bincount(key, minlength=groups)
    start = size.cumsum(0) - size
    low = (start + (size - 1).div(2, rounding_mode="floor")).clamp(0, max(len(key) - 1, 0))
    high = (start + size.div(2, rounding_mode="floor")).clamp(0, max(len(key) - 1, 0))
    result = value.new_full((groups, flat.shape[1]), torch.nan)
    filled = size > 0
    for column in range(flat.shape[1]):
        by_value = flat[:, column].argsort(stable=True)
        order = by_value[key[by_value].argsort(stable=True)]
        ranked = flat[order, column]
        if len(ranked):
            result[filled, column] = 0.5 * (ranked[low] + ranked[high])[filled]
    return result.reshape(groups, *value.shape[1:])


def group_mode(
    code: Int[Tensor, " n"], weight: Float[Tensor, " n"], label: Int[Tensor, " n"], groups: int
) -> Int[Tensor, " g"]:
    """The code >= 0 with the most weight in each group, the smaller of equals; -1 where there is none."""
    used = (label >= 0) & (code >= 0)
    result = torch.full((groups,), -1, dtype=code.dtype, device=code.device)
    if not bool(used.any()):
        return result
    span = int(code[used].max()) + 1
    key, inverse = torch.unique(label[used] * span + code[used], return_inverse=True)
    total = weight.new_zeros(len(key)).index_add(0, inverse, weight[used])
    # Stable sort by descending weight, then the first of every group.
    order = (-total).argsort(stable=True)
    order = order[(key[order] // span).argsort(stable=True)]
    owner = key[order] // span
    first = torch.ones_like(owner, dtype=torch.bool)
    first[1:] = owner[1:] != owner[:-1]
    result[owner[first]] = (key[order] % span)[first].to(code.dtype)
    return result


def cheapest(
    row: Int[Tensor, " p"], other: Int[Tensor, " p"], cost: Float[Tensor, " p"], rows: int
) -> tuple[Float[Tensor, " n"], Int[Tensor, " n"]]:
    """The least cost of each row and the partner it comes with, the smaller of equals; infinity and -1 without one."""
    best = cost.new_full((rows,), torch.inf).scatter_reduce(0, row, cost, "amin")
    is_best = (cost == best[row]) & cost.isfinite()
    far = torch.iinfo(torch.int64).max
    partner = torch.full((rows,), far, dtype=torch.int64, device=row.device)
    partner = partner.scatter_reduce(0, row[is_best], other[is_best], "amin")
    return best, partner.masked_fill(partner == far, -1)


def distinct_pairs(
    first: Int[Tensor, " n"], second: Int[Tensor, " n"]
) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"], Int[Tensor, " m"]]:
    """The distinct pairs of two columns (each at least -1), sorted, and how often each occurs."""
    span = int(second.max()) + 2 if len(second) else 1
    key, number = torch.unique((first + 1) * span + second + 1, return_counts=True)
    return key // span - 1, key % span - 1, number


def pairs_within(label: Int[Tensor, " n"]) -> Int[Tensor, "p 2"]:
    """All unordered pairs of rows of the same group; meant for small groups."""
    rows = torch.nonzero(label >= 0)[:, 0]
    rows = rows[label[rows].argsort(stable=True)]
    key = label[rows]
    _, size = torch.unique_consecutive(key, return_counts=True)
    start = torch.repeat_interleave(size.cumsum(0) - size, size)
    place = torch.arange(len(rows), device=label.device) - start  # rank within the group
    # Every row is paired with those before it in its group.
    second, first = rows_of_ranges(start, place)
    return torch.stack((rows[first], rows[second]), dim=1)


def group_argmin(value: Float[Tensor, " n"], group: Int[Tensor, " n"]) -> Int[Tensor, " g"]:
    """Row of the least value of each group, the first of equals; NaN is never less. Every group must have a row."""
    groups = int(group.max()) + 1 if len(group) else 0
    value = torch.where(value.isnan(), torch.inf, value)
    least = value.new_full((groups,), torch.inf).scatter_reduce(0, group, value, "amin")
    rows = torch.nonzero(value == least[group])[:, 0]
    first = torch.full((groups,), len(value), dtype=torch.int64, device=value.device)
    return first.scatter_reduce(0, group[rows], rows, "amin")


def group_range(
    value: Shaped[Tensor, " n"], group: Int[Tensor, " n"], groups: int
) -> tuple[Shaped[Tensor, " g"], Shaped[Tensor, " g"]]:
    """Least and largest value of each group; zero for an empty one."""
    zero = value.new_zeros(groups)
    least = zero.scatter_reduce(0, group, value, "amin", include_self=False)
    return least, zero.scatter_reduce(0, group, value, "amax", include_self=False)


def rows_of_ranges(
    start: Int[Tensor, " g"], size: Int[Tensor, " g"]
) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
    """The rows `start .. start + size - 1` of every range, each behind the number of its range."""
    number = torch.repeat_interleave(torch.arange(len(size), device=size.device), size)
    first = start - (size.cumsum(0) - size)
    return number, first[number] + torch.arange(len(number), device=size.device)
