"""Memory that was freed goes back to the system, and what is used stays."""

from __future__ import annotations

import platform
from pathlib import Path

import pytest
import torch

from crowdmap_torch.processes.memory import give_back


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
