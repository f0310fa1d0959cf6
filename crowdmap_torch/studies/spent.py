"""What a piece of work takes: seconds of a core, and the most memory that the process held."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager

from crowdmap_torch.processes.memory import peak_bytes, restart_peak


@contextmanager
def spent(into: dict[str, dict[str, float]], stage: str) -> Iterator[None]:
    """Notes `{"seconds": ..., "peak_mb": ...}` of what is done inside under the stage's name.

    The peak is the process's own, counted from here on; where the system does not forget what was before, from its start on.
    """
    restart_peak()
    begun = time.process_time()
    yield
    into[stage] = {"seconds": time.process_time() - begun, "peak_mb": _peak_mb()}


def _peak_mb() -> float:
    peak = peak_bytes()
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3 if peak is None else peak / 1e6
