"""Sums by index in sorted order are those of atomic additions, and sorted once."""

from __future__ import annotations

import gc

import pytest
import torch
from torch import Tensor

from crowdmap_torch.processes import sums
from crowdmap_torch.processes.sums import add_at, lasting, running_sum


@pytest.fixture(autouse=True)
def as_on_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sums, "_sorts", lambda device: True)
    monkeypatch.setattr(sums, "_MANY", 1)


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def indices(count: int, most: int, seed: int = 1) -> Tensor:
    return torch.randint(0, most, (count,), generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("dim", [0, 1, 2, -1])
@pytest.mark.parametrize(("rows", "places"), [(0, 5), (1, 5), (40, 50), (1000, 3), (5000, 900)])
@pytest.mark.parametrize("alpha", [1.0, -1.0])
def test_rows_are_added_where_their_index_says(dim: int, rows: int, places: int, alpha: float):
    shape, of_value = [2, 3, 4], [2, 3, 4]
    shape[dim], of_value[dim] = places, rows
    total, value, index = drawn(*shape), drawn(*of_value, seed=2), indices(rows, places)
    expected = total.index_add(dim, index, value, alpha=alpha)
    found = add_at(total, dim, index, value, alpha=alpha)
    assert found is total
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


def test_one_index_may_have_most_rows():
    index = torch.cat((torch.zeros(10_000, dtype=torch.long), torch.arange(5)))
    value = torch.ones(len(index), dtype=torch.float64)
    found = add_at(torch.zeros(5, dtype=torch.float64), 0, index, value)
    assert found.tolist() == [10_001, 1, 1, 1, 1]
    # Nobody adds up more than a lot.
    assert all(int(begins.diff().max()) <= sums._LOT for begins in sums._sort(index).lots)


def test_whole_numbers_are_added_too():
    found = add_at(torch.zeros(3, dtype=torch.long), 0, torch.tensor([2, 0, 2]), torch.arange(3))
    assert found.tolist() == [1, 0, 2]


def test_views_that_are_written_into_are_written_into():
    total = torch.zeros(4, 6, dtype=torch.float64)
    add_at(total[:, 2:4], 0, torch.tensor([1, 1]), torch.ones(2, 2, dtype=torch.float64))
    assert total.sum() == 4 and total[1, 2:4].tolist() == [2, 2]


def test_an_index_that_lasts_is_sorted_once(monkeypatch: pytest.MonkeyPatch):
    sorted_now: list[int] = []
    sort = sums._sort
    monkeypatch.setattr(sums, "_sort", lambda index: sorted_now.append(len(index)) or sort(index))
    index, value = indices(30, 4), drawn(30)

    def total() -> Tensor:
        return add_at(value.new_zeros(4), 0, index.view(5, 6).flatten(), value)

    assert torch.equal(total(), total())
    assert len(sorted_now) == 1
    add_at(value.new_zeros(4), 0, index[10:], value[10:])
    assert len(sorted_now) == 2
    # Not where it has changed since.
    index[0] = (index[0] + 1) % 4
    expected = value.new_zeros(4).index_add(0, index, value)
    torch.testing.assert_close(total(), expected, rtol=1e-12, atol=1e-12)
    assert len(sorted_now) == 3


def test_what_was_sorted_goes_with_its_index():
    gc.collect()  # What other tests left in circles.
    before = len(sums._kept)
    index = indices(30, 4)
    add_at(torch.zeros(4, dtype=torch.float64), 0, index, drawn(30))
    assert len(sums._kept) == before + 1
    del index
    gc.collect()
    assert len(sums._kept) == before


@pytest.mark.parametrize("rows", [0, 1, 2, 3, 64, 1001])
@pytest.mark.parametrize("columns", [(), (3,)])
def test_running_sums_are_those_of_one_row_after_the_other(rows: int, columns: tuple[int, ...]):
    value = drawn(rows, *columns)
    torch.testing.assert_close(running_sum(value), value.cumsum(0), rtol=1e-12, atol=1e-12)


def test_what_is_derived_of_indices_that_last_is_made_once():
    made: list[int] = []

    def twice(index: Tensor, beside: Tensor) -> Tensor:
        def make() -> Tensor:
            made.append(len(made))
            return 2 * index + beside[0]

        return lasting("twice", make, index, beside)

    index, beside = indices(30, 4), indices(5, 9)
    assert twice(index[3:], beside) is twice(index[3:], beside)
    assert torch.equal(twice(index[3:], beside), 2 * index[3:] + beside[0])
    assert len(made) == 1
    # Of other indices, or where one was written to, it is another.
    assert twice(index, beside) is not twice(index[3:], beside)
    other = beside + 1
    assert torch.equal(twice(index, other), 2 * index + other[0])
    beside += 3
    assert torch.equal(twice(index, beside), 2 * index + beside[0])
    assert lasting("thrice", lambda: 3 * index, index, beside) is not twice(index, beside)


def test_what_is_derived_goes_with_the_first_and_is_not_taken_for_that_of_another():
    before = len(sums._kept)
    index = indices(30, 4)
    for seed in range(20):
        # Python likes to give the next tensor the number of the last one.
        beside = indices(5, 9, seed)
        found = lasting("sum", lambda beside=beside: index + beside[0], index, beside)
        assert torch.equal(found, index + beside[0])
        del beside
    del index
    gc.collect()
    assert len(sums._kept) == before


def test_nothing_is_kept_on_a_cpu(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sums, "_sorts", lambda device: False)
    before, index = len(sums._kept), indices(30, 4)
    made = [lasting("same", index.clone, index) for _ in range(2)]
    assert made[0] is not made[1] and len(sums._kept) == before
