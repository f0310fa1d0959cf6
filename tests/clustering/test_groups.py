"""Figures of groups of rows agree with a loop over the groups."""

from __future__ import annotations

import torch

from crowdmap_torch.clustering.groups import (
    cheapest,
    distinct_pairs,
    group_argmin,
    group_count,
    group_median,
    group_mode,
    group_range,
    group_sum,
    pairs_within,
    rows_of_ranges,
)


def rows(n: int = 40, groups: int = 6) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(2)
    label = torch.randint(-1, groups, (n,), generator=g)
    label[label == 4] = 3  # an empty group
    return torch.randn(n, 3, generator=g, dtype=torch.float64), label


def test_sums_and_medians_agree_with_a_loop():
    value, label = rows()
    total, middle = group_sum(value, label, 6), group_median(value, label, 6)
    for c in range(6):
        own = value[label == c]
        assert torch.allclose(total[c], own.sum(0), atol=1e-12)  # order of a sum of 10 numbers
        if len(own):
            assert torch.allclose(middle[c], own.quantile(0.5, dim=0), atol=1e-12)
        else:
            assert middle[c].isnan().all()


def test_mode_has_the_most_weight_and_ignores_unknown():
    code = torch.tensor([2, 2, 5, -1, 1, 0])
    weight = torch.tensor([1.0, 1.0, 3.0, 9.0, 1.0, 1.0])
    label = torch.tensor([0, 0, 0, 1, 2, 2])
    assert group_mode(code, weight, label, 4).tolist() == [5, -1, 0, -1]


def test_pairs_within_groups_are_complete():
    _, label = rows()
    found = {tuple(sorted(p)) for p in pairs_within(label).tolist()}
    wanted = {
        (i, j)
        for i in range(len(label))
        for j in range(i + 1, len(label))
        if label[i] == label[j] >= 0
    }
    assert found == wanted


def test_argmin_is_the_first_of_the_least():
    value = torch.tensor([5.0, 2.0, 2.0, 7.0, 1.0])
    group = torch.tensor([0, 1, 1, 0, 0])
    assert group_argmin(value, group).tolist() == [4, 1]


def test_nan_is_least_only_where_nothing_else_is():
    value = torch.tensor([torch.nan, 3.0, torch.nan, torch.nan])
    assert group_argmin(value, torch.tensor([0, 0, 1, 1])).tolist() == [1, 2]
    assert len(group_argmin(value[:0], torch.zeros(0, dtype=torch.int64))) == 0


def test_range_agrees_with_a_loop():
    value, label = rows()
    value, label = value[label >= 0, 0], label[label >= 0]
    least, largest = group_range(value, label, 6)
    for c in range(6):
        own = value[label == c]
        assert float(least[c]) == min(own.tolist(), default=0.0)
        assert float(largest[c]) == max(own.tolist(), default=0.0)


def test_cheapest_partner_is_the_smaller_of_equals():
    row = torch.tensor([0, 0, 0, 2, 2])
    other = torch.tensor([7, 5, 6, 1, 3])
    cost = torch.tensor([2.0, 1.0, 1.0, torch.inf, torch.inf])
    best, partner = cheapest(row, other, cost, 3)
    assert best.tolist() == [1.0, torch.inf, torch.inf]
    assert partner.tolist() == [5, -1, -1]


def test_distinct_pairs_are_sorted_and_counted():
    first, second = torch.tensor([3, -1, 3, 0, 3]), torch.tensor([1, 2, 1, -1, 0])
    a, b, number = distinct_pairs(first, second)
    assert list(zip(a.tolist(), b.tolist(), number.tolist(), strict=True)) == [
        (-1, 2, 1),
        (0, -1, 1),
        (3, 0, 1),
        (3, 1, 2),
    ]


def test_count_leaves_the_unlabelled_out():
    _, label = rows()
    assert group_count(label, 6).tolist() == [int((label == c).sum()) for c in range(6)]


def test_rows_of_ranges_are_those_of_a_loop():
    start, size = torch.tensor([4, 0, 7, 2]), torch.tensor([2, 0, 1, 3])
    number, row = rows_of_ranges(start, size)
    assert number.tolist() == [0, 0, 2, 3, 3, 3] and row.tolist() == [4, 5, 7, 2, 3, 4]
    number, row = rows_of_ranges(start[:0], size[:0])
    assert len(number) == len(row) == 0
