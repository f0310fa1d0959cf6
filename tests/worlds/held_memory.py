"""Memory that is surely taken of the system, and surely handed back: the C library keeps pages of its own between both."""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def held(count: int) -> Iterator[None]:
    """Holds `count` bytes, all of them in pages that are written, while inside."""
    with mmap.mmap(-1, count, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS) as pages:
        pages[:: mmap.PAGESIZE] = bytes(len(range(0, count, mmap.PAGESIZE)))
        yield
