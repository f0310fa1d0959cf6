"""Tasks in this process, one after the other, as they are asked for."""

from __future__ import annotations

from types import TracebackType
from typing import Any

from crowdmap_torch.fleet.engine import Engine, Finished, finished
from crowdmap_torch.processes.workers import Call


class InProcess(Engine):
    """No workers: what kills a task kills its caller too."""

    name = "local"
    shares_memory = True

    def __init__(self) -> None:
        super().__init__()
        self._next: tuple[int, Call] | None = None

    @property
    def free(self) -> int:
        """One, unless a task waits to be gathered."""
        return int(self._next is None)

    @property
    def most_hosts(self) -> int:
        """This process."""
        return 1

    def host(self) -> _Here:
        """This process."""
        return _Here()

    def submit(self, number: int, call: Call) -> None:
        """Notes a task; it runs when it is gathered."""
        assert self._next is None, "a task waits to be gathered"
        self._next = number, call

    def gather(self) -> list[tuple[int, Finished]]:
        """Does the task that was submitted."""
        assert self._next is not None, "nothing was submitted"
        (number, (_, function, arguments)), self._next = self._next, None
        return [(number, finished(function, arguments))]

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """There is nobody to end."""


class _Here:
    """Calls are made when their result is waited for."""

    def __init__(self) -> None:
        self._call: Call | None = None

    def start(self, call: Call) -> None:
        """Notes the call."""
        self._call = call

    def wait(self) -> Any:
        """Makes it."""
        assert self._call is not None, "nothing was started"
        (_, function, arguments), self._call = self._call, None
        return function(*arguments)

    def end(self) -> None:
        """There is nobody to end."""
