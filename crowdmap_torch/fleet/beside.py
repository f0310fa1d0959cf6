"""Tasks in processes of this machine, each on one core."""

from __future__ import annotations

from types import TracebackType
from typing import Any

import torch

from crowdmap_torch.fleet.engine import Engine, Finished, finished
from crowdmap_torch.processes.memory import keep_in_one_place
from crowdmap_torch.processes.workers import Call, Workers


class Processes(Engine):
    """At most so many processes beside this one; they are begun as there are tasks for them."""

    name = "processes"

    def __init__(self, workers: int) -> None:
        super().__init__()
        self._most = workers
        self._pool = Workers(workers, torch.set_num_threads, 1)

    @property
    def free(self) -> int:
        """Processes that are there or may be begun, and do nothing."""
        return self._pool.free

    @property
    def most_hosts(self) -> int:
        """As many as processes."""
        return self._most

    def host(self) -> _Beside:
        """A process of its own."""
        return _Beside()

    def submit(self, number: int, call: Call) -> None:
        """Hands a task to a process."""
        name, function, arguments = call
        self._pool.start(number, (name, finished, (function, arguments)))

    def gather(self) -> list[tuple[int, Finished]]:
        """Waits for a process."""
        return self._pool.wait()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Ends the processes."""
        self._pool.__exit__(kind, error, traceback)


class _Beside:
    """One process; another one takes its place where it was killed."""

    def __init__(self) -> None:
        self._pool = Workers(1, _in_one_place)

    def start(self, call: Call) -> None:
        """Hands it to the process."""
        self._pool.start(0, call)

    def wait(self) -> Any:
        """Waits for the process."""
        ((_, made),) = self._pool.wait()
        return made

    def end(self) -> None:
        """Ends the process."""
        self._pool.__exit__(None, None, None)


def _in_one_place() -> None:
    """What a host does first: its members' threads share one core and what they free."""
    torch.set_num_threads(1)
    keep_in_one_place()
