"""Tasks in this process, one after the other, as they are asked for."""

from __future__ import annotations

from types import TracebackType

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
