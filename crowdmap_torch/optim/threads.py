"""Pieces of one computation on several cores: a thread for each, every operation within it on one core.

Operations on small blocks hardly gain from several cores each, and adding into shared sums not at all. So pieces are
computed side by side, and whoever asked for them adds them up, in order: results do not depend on the number of cores.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from typing import TypeVar

import torch

_WORTH = 4
"""Items for each thread from which handing them over pays."""
_AHEAD = 3
"""Results for each thread that may be held: whoever takes them has other things to do too."""
T = TypeVar("T")
R = TypeVar("R")


def in_order(function: Callable[[T], R], items: Sequence[T], device: torch.device) -> Iterator[R]:
    """`function` of every item, in order; on as many cores as torch may use where the device is a CPU.

    Only a few results are held at a time, so that memory does not grow with their number.
    """
    threads = torch.get_num_threads()
    if device.type != "cpu" or threads == 1 or len(items) < _WORTH * threads:
        yield from map(function, items)
        return
    with _one_core(threads):
        pool = _pool(threads)
        gradients = torch.is_grad_enabled()

        def run(item: T) -> R:
            # Whether gradients are recorded is known to each thread by itself.
            with torch.set_grad_enabled(gradients):
                return function(item)

        waiting: deque[Future[R]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(run, item))
                if len(waiting) > _AHEAD * threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


@lru_cache(maxsize=1)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "optim", initializer=torch.set_num_threads, initargs=(1,))


@contextmanager
def _one_core(threads: int) -> Iterator[None]:
    """Keeps this thread's operations to one core: the others are taken."""
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
