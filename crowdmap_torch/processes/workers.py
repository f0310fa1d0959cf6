"""Processes beside this one that do one task each at a time, and end when it does, whatever ends it.

Workers ignore what a terminal sends to all of them: this process alone says when they end. On Linux the kernel ends
them with the thread that started them; elsewhere, and in between, they notice that their connection is closed.
"""

from __future__ import annotations

import ctypes
import json
import os
import pickle
import queue
import signal
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from types import TracebackType
from typing import Any

from crowdmap_torch.processes.interrupts import held

_BEGIN = (
    "import json, sys; number, parent, sys.path[:] = json.loads(sys.argv[1]); "
    "from crowdmap_torch.processes.workers import serve; serve(number, parent)"
)
_PR_SET_PDEATHSIG = 1
_LEFT_TO_PARENT = {
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
}

Call = tuple[str, Callable[..., Any], tuple]
"""A task: its name in messages, a function of a module, and the function's arguments."""


@dataclass
class _Worker:
    process: subprocess.Popen
    connection: Connection
    key: object = None
    name: str = "the start of a process"


class WorkerLost(ChildProcessError):
    """A process that ended within a task; the text names the task and says how."""

    def __init__(self, key: Any, text: str) -> None:
        super().__init__(text)
        self.key = key
        """Of the task, which can be started again."""


class Workers:
    """At most `count` processes, a context manager that ends them all.

    Functions, arguments and results are pickled. An exception of a task is raised here by `wait`; a process that was
    killed is a `WorkerLost` that names its task, and another one takes its place.
    """

    def __init__(self, count: int, begin: Callable[..., object], *arguments: object) -> None:
        """Each process calls `begin(*arguments)` first."""
        self._count = count
        self._begin = pickle.dumps((begin, arguments))
        self._processes: list[subprocess.Popen] = []
        self._idle: list[_Worker] = []
        self._busy: dict[Connection, _Worker] = {}

    @property
    def free(self) -> int:
        """How many tasks can be started now."""
        return self._count - len(self._busy)

    def start(self, key: object, call: Call) -> None:
        """Starts a task; there must be a free process."""
        assert self.free, "no process is free"
        worker = self._idle.pop() if self._idle else self._new()
        worker.key = key
        worker.name, function, arguments = call
        self._busy[worker.connection] = worker
        # By plain pickle: torch would hand every tensor over as an open file, and a fleet has thousands.
        self._send(worker, pickle.dumps((function, arguments)))

    def wait(self) -> list[tuple[Any, Any]]:
        """Keys and results of what has been finished, at least one; one must have been started.

        WorkerLost if a process has ended within its task; the others go on.
        """
        finished = []
        for connection in wait(list(self._busy)):
            assert isinstance(connection, Connection)
            worker = self._busy[connection]
            try:
                reply = connection.recv_bytes()
            except (EOFError, OSError):
                if finished:
                    # The next call tells of it.
                    continue
                del self._busy[connection]
                connection.close()
                raise self._died(worker) from None
            made = taken(reply)
            self._idle.append(self._busy.pop(connection))
            finished.append((worker.key, made))
        return finished

    def each(self, calls: Iterable[Call]) -> Iterator[tuple[int, Any]]:
        """Number and result of every call, as they are finished."""
        for number, call in enumerate(calls):
            while not self.free:
                yield from self.wait()
            self.start(number, call)
        while self._busy:
            yield from self.wait()

    def __enter__(self) -> Workers:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        for process in self._processes:
            process.kill()
        for worker in (*self._idle, *self._busy.values()):
            worker.connection.close()
        for process in self._processes:
            process.wait()

    def _new(self) -> _Worker:
        ours, theirs = socket.socketpair()
        # A signal that came before the process is listed would leave it behind until it looks for its parent.
        with held(), theirs:
            told = json.dumps([theirs.fileno(), os.getpid(), sys.path])
            # They are born deaf: the signals of a terminal reach them before their first line does.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, _LEFT_TO_PARENT)
            try:
                process = subprocess.Popen(
                    [sys.executable, "-c", _BEGIN, told],
                    stdin=subprocess.DEVNULL,
                    pass_fds=(theirs.fileno(),),
                )
                self._processes.append(process)
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
        worker = _Worker(process, Connection(ours.detach()))
        self._send(worker, self._begin)
        return worker

    def _send(self, worker: _Worker, message: bytes) -> None:
        # Where it has ended already, `wait` tells.
        with suppress(OSError):
            worker.connection.send_bytes(message)

    def _died(self, worker: _Worker) -> WorkerLost:
        code = worker.process.wait()
        if code >= 0:
            how = f"its process ended with exit code {code}"
        elif code == -signal.SIGKILL:
            how = "its process was killed (SIGKILL: by hand, or out of memory: fewer at a time need less)"
        else:
            how = f"its process was killed by {signal.Signals(-code).name}"
        return WorkerLost(worker.key, f"{worker.name}: {how}")


def taken(reply: bytes) -> Any:
    """The result that an `answer` holds; an exception of the task is raised."""
    is_well, made = pickle.loads(reply)
    if not is_well:
        raise made
    return made


# ---- in the worker ----


def serve(number: int, parent: int) -> None:
    """What a worker does: one task after the other from the socket with this number, until it is closed."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        # It was gone before the kernel was told.
        os._exit(1)
    connection = Connection(number)
    messages: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(connection, messages), daemon=True).start()
    begin, arguments = pickle.loads(messages.get())
    begin(*arguments)
    while True:
        reply = answer(messages.get())
        try:
            connection.send_bytes(reply)
        except OSError:
            os._exit(1)


def answer(message: bytes) -> bytes:
    """Calls the function that a message holds with its arguments; the result, or the exception it ended with, pickled."""
    outcome = _Outcome()
    with outcome:
        function, arguments = pickle.loads(message)
        outcome.reply = pickle.dumps((True, function(*arguments)))
    return outcome.reply


def _listen(connection: Connection, messages: queue.SimpleQueue[bytes]) -> None:
    try:
        while True:
            messages.put(connection.recv_bytes())
    except (EOFError, OSError):
        os._exit(1)


class _Outcome:
    """What is sent back: the result, or the exception with the traceback that only the worker knows."""

    reply = b""

    def __enter__(self) -> _Outcome:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> bool:
        if not isinstance(error, Exception):
            return False
        error.add_note("in a worker:\n" + "".join(traceback.format_exception(error)))
        try:
            self.reply = pickle.dumps((False, error))
            pickle.loads(self.reply)
        except (TypeError, AttributeError, pickle.PicklingError):
            told = RuntimeError(f"{type(error).__name__}: {error}")
            self.reply = pickle.dumps((False, told))
        return True
