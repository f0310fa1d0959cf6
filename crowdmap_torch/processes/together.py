"""Programs that run side by side on parts of one problem, each the same, and meet where they need what all have.

Each is a `Member`, one beside them the `Leader`: it holds what is nobody's own, adds up, in the members' order, what each
of them brings, and tells all of them. They must come to the same meetings in the same order. A program that has everything
is `ALONE`: its sums are its own. Where the members run is another's affair (`fleet.company`).
"""

from __future__ import annotations

import queue
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import chain
from typing import Any, Protocol, TypeVar, runtime_checkable

import torch
from torch import Tensor

Sum = TypeVar("Sum", Tensor, dict[str, Tensor])
R = TypeVar("R")


class Together(ABC):
    """Who a program meets; each call is a meeting to which all members and their leader come."""

    is_alone = False
    """Whether there is nobody else."""
    leads = False
    """Whether this program holds what is no member's own: true of the leader, and of one that is alone."""

    @abstractmethod
    def met(self, function: Callable[[Iterator[Any]], R], own: Any) -> R:
        """What the leader's `function` makes of what all bring, its own first, then in the members' order; told to all.

        Members bring what they have one after the other, as it is taken: nobody need hold all of it.
        """

    @abstractmethod
    def for_leader(self, function: Callable[[Iterator[Any]], R], own: Any) -> R | None:
        """`met`, of which members are told nothing: None."""

    def sum(self, own: Sum) -> Sum:
        """The sum of what all have; of tensors by name, name by name."""
        return self.met(added_up, own)

    def of_all(self, function: Callable[..., R], *own: Tensor) -> R:
        """What the leader's `function` makes of what all have, tensor by tensor one behind the other; told to all."""

        def of(parts: Iterator[tuple[Tensor, ...]]) -> R:
            return function(*(torch.cat(each) for each in zip(*parts, strict=True)))

        return self.met(of, own)


class _Alone(Together):
    """Nobody else is there."""

    is_alone = True
    leads = True

    def met(self, function: Callable[[Iterator[Any]], R], own: Any) -> R:
        return function(iter([own]))

    def for_leader(self, function: Callable[[Iterator[Any]], R], own: Any) -> R:
        return function(iter([own]))

    def sum(self, own: Sum) -> Sum:
        return own

    def of_all(self, function: Callable[..., R], *own: Tensor) -> R:
        return function(*own)


ALONE = _Alone()


@runtime_checkable
class Meetings(Protocol):
    """Where a leader meets its members."""

    def gathered(self, what: str) -> Iterator[Any]:
        """What each member brings to a meeting of that kind, in their order."""
        ...

    def tell(self, reply: Any) -> None:
        """Tells all of them what came of it; each goes on from there."""
        ...


class Leader(Together):
    """The one program that holds what is no member's own."""

    leads = True

    def __init__(self, meetings: Meetings) -> None:
        self._meetings = meetings

    def met(self, function: Callable[[Iterator[Any]], R], own: Any) -> R:
        """What the function makes of its own and of what the members bring."""
        found = self._found(function, own)
        self._meetings.tell(found)
        return found

    def for_leader(self, function: Callable[[Iterator[Any]], R], own: Any) -> R:
        """The same; members are told nothing."""
        found = self._found(function, own)
        self._meetings.tell(None)
        return found

    def tell(self, reply: Any) -> None:
        """Tells each member what it waits for by `Member.told`."""
        for _ in self._meetings.gathered("told"):
            pass
        self._meetings.tell(reply)

    def _found(self, function: Callable[[Iterator[Any]], R], own: Any) -> R:
        brought = self._meetings.gathered("met")
        found = function(chain([own], brought))
        # Whoever has seen enough hears the others out.
        for _ in brought:
            pass
        return found


class Member(Together):
    """One of the programs that run side by side, in a thread of its own, each while the others wait.

    `begin` and `reply` are for the process that runs it: they return when it waits for its next meeting, with the kind of
    that and what it brings.
    """

    def __init__(self, program: Callable[[Member], object], given: Any) -> None:
        """`program` is called with the member, may `take` what it is given, and is to wait for its end by `told`."""
        self._given = [given]
        self._replies: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._brought: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self._thread = threading.Thread(
            target=self._run, args=(program,), daemon=True, name="member"
        )

    # ---- for the process that runs it ----

    def begin(self) -> tuple[str, Any]:
        """Starts it; what it brings to its first meeting. What the program raises is raised."""
        self._thread.start()
        return self._next()

    def reply(self, reply: Any) -> tuple[str, Any]:
        """Tells it what came of the meeting that it waits for; what it brings to the next one."""
        self._replies.put(reply)
        return self._next()

    def end(self) -> None:
        """Ends it, wherever it waits."""
        if self._thread.is_alive():
            self._replies.put(_END)
            self._thread.join()

    # ---- for the program ----

    def met(self, function: Callable[[Iterator[Any]], R], own: Any) -> R:
        """What the leader's function makes of what all bring; this one is not called."""
        return self._meet("met", compact(own))

    def for_leader(self, function: Callable[[Iterator[Any]], R], own: Any) -> None:
        """Brings what one has."""
        self._meet("met", compact(own))

    def take(self) -> Any:
        """What the program is given, handed over once: nobody else keeps it."""
        return self._given.pop()

    def told(self) -> Any:
        """What the leader tells all members next."""
        return self._meet("told", None)

    def _meet(self, what: str, own: Any) -> Any:
        self._brought.put((what, own))
        reply = self._replies.get()
        if reply is _END:
            raise _Ended
        return reply

    def _run(self, program: Callable[[Member], object]) -> None:
        torch.set_num_threads(1)
        with _Outcome(self._brought):
            program(self)

    def _next(self) -> tuple[str, Any]:
        what, own = self._brought.get()
        if what == "raised":
            raise own
        return what, own


_END = object()


class _Ended(BaseException):
    """A member is to end where it waits."""


class _Outcome:
    """Hands on how a program ended."""

    def __init__(self, brought: queue.SimpleQueue[tuple[str, Any]]) -> None:
        self._brought = brought

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        if not isinstance(error, _Ended):
            self._brought.put(("ended", None) if error is None else ("raised", error))
        return True


def added_up(parts: Iterable[Sum]) -> Sum:
    """The sum of all parts, in their order; of tensors by name, name by name."""
    total: Any = None
    for part in parts:
        if total is None:
            total = _copied(part)
        elif isinstance(part, Tensor):
            total += part
        else:
            for name, tensor in part.items():
                if name in total:
                    total[name] += tensor
                else:
                    total[name] = tensor.clone()
    assert total is not None, "a sum has parts"
    return total


def _copied(part: Sum) -> Sum:
    if isinstance(part, Tensor):
        return part.clone()
    return {name: tensor.clone() for name, tensor in part.items()}


def compact(value: Any) -> Any:
    """The same with no tensor that is a small part of larger memory, which pickling would take along."""
    if isinstance(value, Tensor):
        return value.clone() if value.untyped_storage().nbytes() > value.nbytes else value
    if isinstance(value, Mapping):
        return {name: compact(one) for name, one in value.items()}
    if isinstance(value, tuple):
        return tuple(compact(one) for one in value)
    return value
