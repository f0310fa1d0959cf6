"""What a piece of work takes: seconds of a core, and the most memory that the process held."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_STATUS, _FORGET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@contextmanager
def spent(into: dict[str, dict[str, float]], stage: str) -> Iterator[None]:
    """Notes `{"seconds": ..., "peak_mb": ...}` of what is done inside under the stage's name.

    The peak is the process's own, counted from here on; where the system does not tell that, from its start on.
    """
    _forget_peak()
    begun = time.process_time()
    yield
    into[stage] = {"seconds": time.process_time() - begun, "peak_mb": _peak_mb()}


def _forget_peak() -> None:
    """Sets the peak to what is held now (proc(5)); where that is not allowed it goes on from before."""
    try:
        _FORGET.write_text("5")
    except OSError:
        return


def _peak_mb() -> float:
    if _STATUS.exists():
        for line in _STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1e3
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
