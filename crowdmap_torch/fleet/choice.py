"""Engines by name."""

from __future__ import annotations

import os

from crowdmap_torch.fleet.beside import Processes
from crowdmap_torch.fleet.engine import Engine
from crowdmap_torch.fleet.here import InProcess

ENGINES = ("local", "processes", "ray")


def engine_of(
    name: str | None, *, workers: int | None = None, address: str | None = None
) -> Engine:
    """The engine of a name, not begun yet; None: processes, or this one where one worker is enough.

    `workers` at a time; None: one for each core, of a cluster at an `address` for each core that it has. ValueError for
    what does not fit together, ModuleNotFoundError where an engine's package is missing.
    """
    if address is not None and name != "ray":
        raise ValueError(f"--address {address}: is that of a Ray cluster; add --engine ray")
    if name == "ray":
        from crowdmap_torch.fleet.on_ray import OnRay

        cores = None if address is not None else os.cpu_count() or 1
        return OnRay(cores if workers is None else workers, address)
    count = os.cpu_count() or 1 if workers is None else workers
    if name == "local" or (name is None and count == 1):
        return InProcess()
    if name in (None, "processes"):
        return Processes(count)
    raise ValueError(f"--engine {name}: expected one of {', '.join(ENGINES)}")
