"""Memory that was freed goes back to the system, and what is used stays."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from crowdmap_torch.processes.memory import ARROW_POOL, give_back


def resident_mb() -> float:
    """What the process holds."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can be told to")
def test_what_was_freed_between_what_is_used_goes_back():
    # Every second of many pieces, each too small for pages of its own.
    pieces = [torch.ones(8_000, dtype=torch.float64) for _ in range(4_000)]
    before = resident_mb()
    kept = pieces[::2]
    del pieces
    give_back()
    assert before - resident_mb() > 0.25 * 4_000 * 0.064
    assert all(bool((piece == 1).all()) for piece in kept)
    give_back()


_POOL = """
import sys
from crowdmap_torch.processes.memory import arrow_in_one_place
arrow_in_one_place()
import pyarrow
print(pyarrow.default_memory_pool().backend_name)
"""


def test_arrow_takes_memory_where_all_else_does_unless_told_otherwise():
    def pool(**said: str) -> str:
        environment = {k: v for k, v in os.environ.items() if k != ARROW_POOL} | said
        command = [sys.executable, "-c", _POOL]
        return subprocess.run(
            command, env=environment, check=True, capture_output=True, text=True
        ).stdout.strip()

    assert pool() == "system"
    assert pool(**{ARROW_POOL: "mimalloc"}) == "mimalloc"


_HEAPS = """
import ctypes, sys, threading
from crowdmap_torch.processes.memory import keep_in_one_place
if "together" in sys.argv:
    keep_in_one_place()
c = ctypes.CDLL(None)
c.malloc.restype = c.fopen.restype = ctypes.c_void_p
together = threading.Barrier(4)
def take():
    together.wait()
    c.malloc(100)
    together.wait()
threads = [threading.Thread(target=take) for _ in range(4)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
told = c.fopen(sys.argv[1].encode(), b"w")
c.malloc_info(0, ctypes.c_void_p(told))
c.fclose(ctypes.c_void_p(told))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can be told to")
def test_threads_share_a_heap_where_they_are_told_to(tmp_path):
    def heaps(*told: str) -> int:
        told_of = tmp_path / "heaps.xml"
        subprocess.run([sys.executable, "-c", _HEAPS, str(told_of), *told], check=True)
        return told_of.read_text().count("<heap nr=")

    assert heaps() > 1
    assert heaps("together") == 1


_BLOCKS = """
import ctypes, resource, sys
from crowdmap_torch.processes.memory import keep_in_one_place, large_tensors_again
c = ctypes.CDLL(None)
c.malloc.restype = ctypes.c_void_p
c.malloc.argtypes = [ctypes.c_size_t]
c.free.argtypes = [ctypes.c_void_p]
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
"""
"""How many pages the system had to hand out for blocks of the C library."""

_AGAIN = f"""{_BLOCKS}
if "together" in sys.argv:
    keep_in_one_place()
begun = faults()
for _ in range(10):
    blocks = [c.malloc(18 << 20) for _ in range(3)]
    for block in blocks:
        ctypes.memset(block, 1, 18 << 20)
    for block in blocks:
        c.free(block)
print(faults() - begun)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can be told to")
def test_what_was_freed_is_taken_again_where_it_is_told_to():
    def faults(*told: str) -> int:
        command = [sys.executable, "-c", _AGAIN, *told]
        return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)

    # 54 MB are cleared by the system once, or ten times.
    assert faults("together") < faults() / 3


_LARGE = f"""{_BLOCKS}
keep_in_one_place()
def resident():
    return int(open("/proc/self/statm").read().split()[1]) * resource.getpagesize()
def rounds():
    begun = faults()
    for _ in range(10):
        block = c.malloc(100 << 20)
        ctypes.memset(block, 1, 100 << 20)
        c.free(block)
    return faults() - begun
before = resident()
with large_tensors_again():
    inside, held = rounds(), resident() - before
print(inside, held, resident() - before, rounds())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can be told to")
def test_large_tensors_take_what_was_freed_inside_and_hand_it_back_at_the_end():
    command = [sys.executable, "-c", _LARGE]
    made = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    inside, held, left, outside = map(int, made.split())
    # 100 MB are cleared once, or ten times; they stay inside alone.
    assert inside < outside / 3
    assert held > 90e6 and left < 10e6
