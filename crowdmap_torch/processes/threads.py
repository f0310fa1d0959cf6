"""Pieces of one computation on several cores: a thread for each, every operation within it on one core.

Operations on small blocks hardly gain from several cores each, and adding into shared sums not at all. A sum that torch
or a BLAS takes on several cores is another one in its last bits than on one. So pieces are computed side by side, every
operation on one core, and whoever asked for the pieces adds them up, in order: results do not depend on the number of cores.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from typing import Generic, TypeVar

import torch
from threadpoolctl import ThreadpoolController

_WORTH = 2
"""Items for each thread from which handing them over pays, where each is little work."""
_AHEAD = 3
"""Results for each thread that may be held: whoever takes them has other things to do too."""
T = TypeVar("T")
R = TypeVar("R")


class _Kept(threading.local):
    cores: int | None = None
    """How many cores this thread's operations had before `one_core_each`; None outside."""


_kept = _Kept()


@contextmanager
def one_core_each() -> Iterator[None]:
    """Within it, or a function that it decorates, every operation of torch, NumPy and SciPy runs on one core.

    Sums then have the same bits on any machine of one kind, whatever number of threads it may use; `in_order` still takes
    as many as torch may use outside.
    """
    if _kept.cores is not None:
        yield
        return
    _kept.cores = cores = torch.get_num_threads()
    try:
        with _libraries().limit(limits=1):
            torch.set_num_threads(1)
            yield
    finally:
        _kept.cores = None
        # After the libraries' own limits: torch's OpenMP is one of them.
        torch.set_num_threads(cores)


def repeatable(device: torch.device) -> None:
    """From now on sums on a GPU have the same bits every time: they are taken over sorted rows, not by atomic additions.

    To be called before anything runs there. On a CPU they have anyway.
    """
    if device.type == "cuda":
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        torch.use_deterministic_algorithms(True, warn_only=True)
        # Memory that is not written yet is not read either.
        setattr(torch.utils.deterministic, "fill_uninitialized_memory", False)  # noqa: B010


def in_order(
    function: Callable[[T], R], items: Sequence[T], device: torch.device, *, worth: int = _WORTH
) -> Iterator[R]:
    """`function` of every item, in order; on as many cores as torch may use where the device is a CPU.

    Only a few results are held at a time, so that memory does not grow with their number. `worth` are the items for each
    thread from which handing them over pays: few where each is much work.
    """
    threads = _kept.cores or torch.get_num_threads()
    if device.type != "cpu" or threads == 1 or len(items) < worth * threads:
        with one_core_each():
            yield from map(function, items)
        return
    with one_core_each():
        # This thread is one of them.
        pool = _pool(threads - 1)
        gradients = torch.is_grad_enabled()

        def run(item: T) -> R:
            # Whether gradients are recorded is known to each thread by itself.
            with torch.set_grad_enabled(gradients):
                return function(item)

        waiting: deque[_Task[T, R]] = deque()
        try:
            for item in items:
                waiting.append(_Task(item, pool.submit(run, item)))
                if len(waiting) > _AHEAD * threads:
                    yield _first(waiting, run)
            while waiting:
                yield _first(waiting, run)
        finally:
            for task in waiting:
                task.future.cancel()


@dataclass
class _Task(Generic[T, R]):
    """An item, and what is to come of it."""

    item: T
    future: Future[R]


def _first(waiting: deque[_Task[T, R]], run: Callable[[T], R]) -> R:
    """What comes of the first task, which goes; this thread sees to others that nobody has begun, until it is there."""
    for number, task in enumerate(waiting):
        if waiting[0].future.done():
            break
        # What another thread has begun, or this one has done, is not taken back.
        if task.future.cancel():
            task.future = Future()
            with ExitStack() as if_it_fails:
                # Of several errors the first is told.
                if_it_fails.callback(_all_done, list(islice(waiting, number)))
                task.future.set_result(run(task.item))
                if_it_fails.pop_all()
    return waiting.popleft().future.result()


def _all_done(tasks: Sequence[_Task[T, R]]) -> None:
    """Raises the first error of some tasks."""
    for task in tasks:
        task.future.result()


@lru_cache(maxsize=1)
def _libraries() -> ThreadpoolController:
    """The thread pools of the libraries that are loaded: found once, which takes milliseconds."""
    return ThreadpoolController()


@lru_cache(maxsize=1)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "in_order", initializer=torch.set_num_threads, initargs=(1,))
