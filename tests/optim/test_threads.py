"""Pieces computed side by side: the same results in the same order, and nothing left changed behind."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from crowdmap_torch.optim.threads import in_order

CPU = torch.device("cpu")


@pytest.fixture(params=[1, 2])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_results_come_in_order(threads: int):
    items = list(range(50))
    assert list(in_order(lambda i: i * i, items, CPU)) == [i * i for i in items]


def test_the_number_of_threads_is_as_before(threads: int):
    list(in_order(lambda i: torch.get_num_threads(), list(range(50)), CPU))
    assert torch.get_num_threads() == threads


def test_an_error_reaches_who_asked_and_the_threads_are_as_before(threads: int):
    def fails(i: int) -> int:
        if i == 20:
            raise ValueError("the twentieth")
        return i

    with pytest.raises(ValueError, match="the twentieth"):
        list(in_order(fails, list(range(50)), CPU))
    assert torch.get_num_threads() == threads


def test_whether_gradients_are_recorded_is_known_to_every_thread(threads: int):
    weight = torch.ones(3, requires_grad=True)
    with torch.no_grad():
        without = list(in_order(lambda i: (weight * i).requires_grad, list(range(50)), CPU))
    assert not any(without)
    assert all(in_order(lambda i: (weight * i).requires_grad, list(range(50)), CPU))
