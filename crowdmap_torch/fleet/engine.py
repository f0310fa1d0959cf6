"""What every engine does: it takes tasks, hands back what they made, and does again what was lost with a worker.

A task is a function of a module and arguments that can be pickled. What it makes depends on these alone, so that the
engine, the number of workers, the order in which they finish and a second attempt change nothing.
"""

from __future__ import annotations

import logging
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Protocol, runtime_checkable

from crowdmap_torch.processes.memory import peak_bytes
from crowdmap_torch.processes.workers import Call, WorkerLost

ATTEMPTS = 3
"""A task whose worker was killed that often is given up: it is the task that kills them."""
_LOG = logging.getLogger(__name__)


@dataclass
class Spent:
    """What tasks have taken so far."""

    tasks: int = 0
    """That were finished."""
    again: int = 0
    """Attempts beyond the first."""
    seconds: float = 0.0
    """Of all workers together."""
    peak_bytes: int | None = None
    """The most that one worker held; None where nobody tells."""


@dataclass(frozen=True)
class Finished:
    """What a worker hands back of a task."""

    value: Any
    seconds: float
    peak_bytes: int | None
    """The most that the process has held by now."""


@runtime_checkable
class Host(Protocol):
    """A worker of its own: calls find what those before them left behind in its modules."""

    def start(self, call: Call) -> None:
        """Begins a call; the one before is finished."""
        ...

    def wait(self) -> Any:
        """Its result; WorkerLost if the worker was killed. What it raises is raised."""
        ...

    def end(self) -> None:
        """Ends the worker."""
        ...


class Engine(ABC):
    """Where tasks run; a context manager that ends its workers, whatever ends the block."""

    name = ""
    """As `--engine` has it."""
    shares_memory = False
    """Whether tasks see this process's memory: their arguments are then not copied."""

    def __init__(self) -> None:
        self.spent = Spent()

    @property
    @abstractmethod
    def free(self) -> int:
        """How many tasks can be submitted now."""

    @abstractmethod
    def submit(self, number: int, call: Call) -> None:
        """Begins a task; there must be a free worker."""

    @property
    @abstractmethod
    def most_hosts(self) -> int:
        """How many hosts are worth to be begun."""

    @abstractmethod
    def host(self) -> Host:
        """A place where calls are made one after the other, and what they leave behind stays; begun by the first one."""

    @abstractmethod
    def gather(self) -> list[tuple[int, Finished]]:
        """Numbers and results of tasks that are finished, at least one; one must have been submitted.

        WorkerLost, with the task's number as its key, if a worker was killed within a task; what a task raises is raised.
        """

    def each(self, calls: Sequence[Call]) -> Iterator[tuple[int, Any]]:
        """Number and result of every call, as they are finished; a task whose worker was killed is done again.

        ChildProcessError, with the task's name, for one that has lost `ATTEMPTS` workers. What a task raises is raised at
        once: the same input would give the same once more.
        """
        waiting, lost = deque(range(len(calls))), Counter[int]()
        running = 0
        while waiting or running:
            while waiting and self.free:
                number = waiting.popleft()
                self.submit(number, calls[number])
                running += 1
            try:
                finished = self.gather()
            except WorkerLost as error:
                running -= 1
                lost[error.key] += 1
                if lost[error.key] == ATTEMPTS:
                    raise ChildProcessError(f"{error}, {ATTEMPTS} times; given up") from None
                _LOG.warning("%s; it is done again", error)
                self.spent.again += 1
                waiting.appendleft(error.key)
                continue
            for number, made in finished:
                running -= 1
                self._count(made)
                yield number, made.value

    def spent_on(self) -> dict[str, object]:
        """Where tasks ran, and what they took (`workers` of metrics.json)."""
        spent = self.spent
        return {
            "engine": self.name,
            "tasks": spent.tasks,
            "again": spent.again,
            "seconds": spent.seconds,
            "memory_gb": None if spent.peak_bytes is None else spent.peak_bytes / 1e9,
        }

    def __enter__(self) -> Engine:
        return self

    @abstractmethod
    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Ends the workers."""

    def _count(self, made: Finished) -> None:
        spent = self.spent
        spent.tasks += 1
        spent.seconds += made.seconds
        if made.peak_bytes is not None:
            spent.peak_bytes = max(spent.peak_bytes or 0, made.peak_bytes)


def finished(function: Callable[..., Any], arguments: tuple) -> Finished:
    """Does a task, in its worker."""
    begun = time.perf_counter()
    value = function(*arguments)
    return Finished(value, time.perf_counter() - begun, peak_bytes())
