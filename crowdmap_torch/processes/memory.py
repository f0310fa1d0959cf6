"""Memory of this process: the most that it held, and what was freed and is still held."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path

ARROW_POOL = "ARROW_DEFAULT_MEMORY_POOL"
"""Variable of the environment that says where Arrow takes its memory."""
_ARENA_MAX, _MMAP_MAX, _MMAP_THRESHOLD, _TRIM_THRESHOLD = -8, -4, -3, -1
"""`M_ARENA_MAX`, `M_MMAP_MAX`, `M_MMAP_THRESHOLD` and `M_TRIM_THRESHOLD` of malloc.h."""
_USUAL_MMAPS = 65_536
"""Blocks that may have pages of their own where nothing was told."""
_ROOM = 2_000_000_000
"""Bytes that may be free at the heap's end while tensors of any size come and go."""
_OWN_PAGES = 32 << 20
"""Tensors of at least so many bytes have pages of their own, which go with them: the most that an older glibc takes."""
_FREE_AT_TOP = 64 << 20
"""Bytes that are freed at the heap's end before they go back by themselves; with 256 MB 25 drives hold 0.1 GB more."""
_STATUS, _PEAK = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def peak_bytes() -> int | None:
    """The most memory that this process has held at one time, since it began or `restart_peak`; None where nobody tells.

    What `getrusage` tells would be that of the process that began this one, where that was more.
    """
    try:
        lines = _STATUS.read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:")), None)


def restart_peak() -> None:
    """From now on `peak_bytes` tells of what comes, where the system can be told to forget (Linux)."""
    with suppress(OSError):
        _PEAK.write_text("5")


def keep_in_one_place() -> None:
    """From now on threads share what was freed, and tensors take it again (glibc); to be called before there are threads.

    Each would keep a heap of its own: an eighth of what a map of 25 drives takes, and no time is saved by it. Pages that
    go back are asked for again and cleared anew, which was a seventh of the time of a small adjustment. What is not needed
    for long `give_back` hands back.
    """
    library = _library()
    if library is not None:
        library.mallopt(_ARENA_MAX, 1)
        library.mallopt(_MMAP_THRESHOLD, _OWN_PAGES)
        library.mallopt(_TRIM_THRESHOLD, _FREE_AT_TOP)


@contextmanager
def large_tensors_again() -> Iterator[None]:
    """Inside, tensors of any size take memory that was freed (glibc); it goes back to the system at the end.

    Those of `_OWN_PAGES` have pages of their own otherwise, which the system clears each time: of a drive of 100 km it took
    26 of 347 seconds for that, and takes 3 now, for 0.3 GB more at the peak. Drives of 20 km take no more memory so.
    """
    library = _library()
    if library is not None:
        library.mallopt(_MMAP_MAX, 0)
        library.mallopt(_TRIM_THRESHOLD, _ROOM)
    try:
        yield
    finally:
        if library is not None:
            library.mallopt(_MMAP_MAX, _USUAL_MMAPS)
            library.mallopt(_TRIM_THRESHOLD, _FREE_AT_TOP)
        give_back()


def arrow_in_one_place() -> None:
    """From now on Arrow, in this process and in those that it begins, takes memory where all else does.

    To be called before it is loaded. Memory of its own is kept for good where tables were once read: 57 MB of the 25 drives
    of 1 km that were. What `ARROW_POOL` says already stands.
    """
    os.environ.setdefault(ARROW_POOL, "system")


def give_back() -> None:
    """Hands what was freed back to the system, where the C library can be told to (glibc); elsewhere nothing happens.

    It keeps freed tensors of less than some megabytes between those that are still used: a quarter of what an adjustment
    of 25 drives held between two steps. So does Arrow, where it has memory of its own. It takes some milliseconds for each
    gigabyte.
    """
    arrow = sys.modules.get("pyarrow")
    if arrow is not None:
        arrow.default_memory_pool().release_unused()
    library = _library()
    if library is not None:
        library.malloc_trim(0)


@lru_cache(maxsize=1)
def _library() -> ctypes.CDLL | None:
    try:
        library = ctypes.CDLL(None)
    except (OSError, TypeError):
        return None
    return library if hasattr(library, "malloc_trim") else None
