"""Pieces computed side by side: the same results in the same order, and nothing left changed behind."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator

import pytest
import torch
from threadpoolctl import threadpool_info

from crowdmap_torch.processes.threads import in_order, one_core_each, repeatable

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


def test_every_operation_runs_on_one_core_and_then_as_before(threads: int):
    with one_core_each():
        assert torch.get_num_threads() == 1
        with one_core_each():
            assert torch.get_num_threads() == 1
        assert {pool["num_threads"] for pool in threadpool_info()} == {1}
        together = list(in_order(lambda i: threading.get_ident(), list(range(50)), CPU))
        assert len({threading.get_ident(), *together}) <= threads
    assert torch.get_num_threads() == threads


def test_threads_are_as_before_after_an_error(threads: int):
    with pytest.raises(ValueError, match="on the way"), one_core_each():
        raise ValueError("on the way")
    assert torch.get_num_threads() == threads


def test_a_gpu_is_told_to_take_sums_in_one_order(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("CUBLAS_WORKSPACE_CONFIG", raising=False)
    before = torch.are_deterministic_algorithms_enabled()
    try:
        repeatable(CPU)
        assert torch.are_deterministic_algorithms_enabled() == before
        repeatable(torch.device("cuda:0"))
        assert torch.are_deterministic_algorithms_enabled()
        assert os.environ["CUBLAS_WORKSPACE_CONFIG"] == ":4096:8"
    finally:
        torch.use_deterministic_algorithms(before)


def test_pieces_within_pieces_are_not_waited_for_in_vain(threads: int):
    def inner(i: int) -> int:
        return sum(in_order(lambda k: k, list(range(i, i + 20)), CPU))

    items = list(range(40))
    assert list(in_order(inner, items, CPU)) == [sum(range(i, i + 20)) for i in items]


def test_two_that_are_worth_it_run_beside_each_other(threads: int):
    meet = threading.Barrier(2, timeout=20)

    def one() -> int:
        # Whoever waits alone is never let through.
        return meet.wait() if threads > 1 else 0

    both = (one, lambda: f"{one()}")
    first, second = in_order(lambda function: function(), both, CPU, worth=1)
    assert isinstance(first, int) and isinstance(second, str)


def test_an_error_of_the_second_of_two_reaches_who_asked(threads: int):
    with pytest.raises(ZeroDivisionError):
        list(in_order(lambda i: 1 // i, (1, 0), CPU, worth=1))


def test_the_first_of_several_errors_reaches_who_asked(threads: int):
    def fails(i: int) -> int:
        # Later ones fail sooner.
        time.sleep(0.02 if i == 9 else 0)
        return 1 // (i < 9) if i != 9 else int("nine")

    with pytest.raises(ValueError, match="nine"):
        list(in_order(fails, list(range(40)), CPU))


def test_who_asks_sees_to_items_while_another_is_busy():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        others_done = threading.Event()

        def item(i: int) -> int:
            # The first one is done when somebody has seen to the last one.
            if i == 0:
                assert others_done.wait(20)
            elif i == 5:
                others_done.set()
            return threading.get_ident()

        idents = list(in_order(item, list(range(6)), CPU, worth=1))
        assert threading.get_ident() in idents
    finally:
        torch.set_num_threads(before)
