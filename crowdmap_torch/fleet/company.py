"""Members of one problem on the hosts of an engine, and the meetings at which their leader, in this process, asks for them.

What a member comes to follows from what it was begun with and from what it was told since. So a member whose host was
killed is begun anew and told the same once more, and comes to the same bits, wherever it is.
"""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import count
from typing import Any

from crowdmap_torch.fleet.engine import ATTEMPTS, Engine, Finished, Host, finished
from crowdmap_torch.processes.threads import one_core_each
from crowdmap_torch.processes.together import Leader, Member
from crowdmap_torch.processes.workers import Call, WorkerLost

Program = tuple[Callable[[Member], object], Any]
"""What a member does: a function of a module, which is called with the member, and what it is given."""
_LOG = logging.getLogger(__name__)
_NUMBERS = count()


class Company(ExitStack):
    """The members, a context manager that ends them; `leader` meets them."""

    def __init__(
        self, engine: Engine, members: int, begin: Callable[[int], Program], name: str
    ) -> None:
        """`begin` is what a member does from its beginning, or from the last `renew` on; `name` is that of their work."""
        super().__init__()
        self.leader = Leader(self)
        self._engine, self._begin, self._name = engine, begin, name
        hosts = min(members, max(engine.most_hosts, 1))
        self._hosts: list[Host] = [engine.host() for _ in range(hosts)]
        for host in self._hosts:
            self.callback(host.end)
        self._members = members
        self._key = next(_NUMBERS)
        if engine.shares_memory:
            self.callback(_end, self._key)
        self._told: list[Any] = []
        """What all members were told since their beginning."""
        self._is_there = [False] * members
        """Whether each one's host has it."""
        self._waiting = [deque[int]() for _ in range(hosts)]
        """By host the members that are still to be told the last, in order."""
        self._running: list[int | None] = [None] * hosts
        self._brought: dict[int, tuple[str, Any]] = {}
        self._lost = Counter[int]()
        self._tell_all()

    def gathered(self, what: str) -> Iterator[Any]:
        """What each member brings to a meeting of that kind, in their order."""
        for number in range(self._members):
            kind, own = self._next(number)
            assert kind == what, f"member {number} came to {kind!r}, its leader to {what!r}"
            yield own

    def tell(self, reply: Any) -> None:
        """Tells all members what came of the meeting that they are at."""
        self._told.append(reply)
        self._tell_all()

    def renew(self, change: Callable[[], object]) -> None:
        """From `change` on members that are lost begin as `begin` has it then; all must wait to be told something next."""
        # Until all of them are there, one that is lost begins where it began.
        for number in range(self._members):
            self._brought[number] = self._next(number)
        change()
        self._told.clear()
        self._lost.clear()

    def _tell_all(self) -> None:
        for host in range(len(self._hosts)):
            # In turns, so that members come in their order, whoever is host.
            self._waiting[host].extend(range(host, self._members, len(self._hosts)))
            self._go_on(host)

    def _go_on(self, host: int) -> None:
        """Lets a host that does nothing do what is next."""
        if self._running[host] is not None or not self._waiting[host]:
            return
        number = self._waiting[host].popleft()
        self._running[host] = number
        name = f"{self._name}, part {number + 1} of {self._members}"
        if self._is_there[number]:
            task: Call = (name, _tell, (self._key, number, self._told[-1]))
        else:
            task = (name, _begin, (self._key, number, *self._begin(number), list(self._told)))
        self._hosts[host].start((name, finished, task[1:]))

    def _next(self, number: int) -> tuple[str, Any]:
        """The kind of the meeting that a member comes to next, and what it brings."""
        if number in self._brought:
            return self._brought.pop(number)
        host = number % len(self._hosts)
        while True:
            self._go_on(host)
            assert self._running[host] == number, "members are asked in their order"
            try:
                made: Finished = self._hosts[host].wait()
            except WorkerLost as error:
                self._begin_again(host, number, error)
                continue
            self._running[host], self._is_there[number] = None, True
            self._go_on(host)
            spent = self._engine.spent
            spent.seconds += made.seconds
            if made.peak_bytes is not None:
                spent.peak_bytes = max(spent.peak_bytes or 0, made.peak_bytes)
            return made.value

    def _begin_again(self, host: int, number: int, error: WorkerLost) -> None:
        """Has the members of a host that was lost begun anew, the one that it was lost with at once."""
        self._lost[host] += 1
        if self._lost[host] == ATTEMPTS:
            raise ChildProcessError(f"{error}, {ATTEMPTS} times; given up") from None
        _LOG.warning("%s; it is done again", error)
        self._engine.spent.again += 1
        for mine in range(host, self._members, len(self._hosts)):
            self._is_there[mine] = False
        self._running[host] = None
        self._waiting[host].appendleft(number)


# ---- where the members are ----

_MEMBERS: dict[tuple[int, int], Member] = {}
"""By company and number."""


@one_core_each()
def _begin(
    key: int, number: int, program: Callable[[Member], object], given: Any, told: list[Any]
) -> tuple[str, Any]:
    """Begins a member and tells it what it was told before; the meeting that it comes to."""
    member = _MEMBERS[key, number] = Member(program, given)
    brought = member.begin()
    for reply in told:
        brought = member.reply(reply)
    return brought


@one_core_each()
def _tell(key: int, number: int, reply: Any) -> tuple[str, Any]:
    """Tells a member what came of the meeting that it is at; the next one."""
    return _MEMBERS[key, number].reply(reply)


def _end(key: int) -> None:
    """Ends the members of a company in this process."""
    for of in [of for of in _MEMBERS if of[0] == key]:
        _MEMBERS.pop(of).end()
