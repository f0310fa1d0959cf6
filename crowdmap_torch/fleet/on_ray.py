"""Tasks on a Ray cluster (extra `ray`): one that runs at an address, or one of this machine that ends with the engine.

Ray moves bytes and tells who died. Which task is done again, and how often, is ours: `max_retries` is 0. Tasks and results
are pickled as for processes, so that workers make of them what those make.
"""

from __future__ import annotations

import os
import pickle
import signal
import socket
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from types import TracebackType
from typing import Any

import torch

from crowdmap_torch import __version__
from crowdmap_torch.fleet.engine import Engine, Finished, finished
from crowdmap_torch.processes.interrupts import loading
from crowdmap_torch.processes.memory import keep_in_one_place
from crowdmap_torch.processes.workers import Call, WorkerLost, answer, taken

_LOOK_S = 0.2
"""While Ray is waited for, signals are looked after that often."""
_PATIENCE_S = 10.0
"""A cluster's head answers within that time."""
_SWITCHES = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
"""Reports of usage to Ray's makers are off, GPUs stay visible to tasks that ask for none, as Ray will have it one day."""


class OnRay(Engine):
    """Tasks of one core each; ModuleNotFoundError where Ray is not installed."""

    name = "ray"

    def __init__(self, workers: int | None = None, address: str | None = None) -> None:
        """At most `workers` tasks at a time (None: one for each core that Ray has), at `address` or on this machine."""
        super().__init__()
        os.environ.update(_SWITCHES)
        with loading():
            self._ray: Any = import_module("ray")
        self._workers = workers
        self._address = address
        self._names: dict[int, str] = {}
        self._running: dict[Any, int] = {}

    @property
    def free(self) -> int:
        """Tasks that Ray has cores for, less those that run."""
        assert self._workers is not None, "entered first"
        return self._workers - len(self._running)

    @property
    def most_hosts(self) -> int:
        """One for each core that Ray has, or as many as were asked for."""
        assert self._workers is not None, "entered first"
        return self._workers

    def host(self) -> _Actor:
        """An actor of one core."""
        return _Actor(self._ray)

    def submit(self, number: int, call: Call) -> None:
        """Hands a task to Ray."""
        self._names[number], function, arguments = call
        message = pickle.dumps((finished, (function, arguments)))
        self._running[self._task.remote(message, versions())] = number

    def gather(self) -> list[tuple[int, Finished]]:
        """Waits for Ray."""
        reference = _first_done(self._ray, [*self._running])
        number = self._running.pop(reference)
        try:
            reply = _answer_of(self._ray, reference)
        except self._ray.exceptions.RayError as error:
            raise _lost(number, self._names[number], error) from None
        return [(number, taken(reply))]

    def __enter__(self) -> OnRay:
        """Finds the cluster, or begins one; ConnectionError if none answers at the address."""
        with loading(), _sigterm_kept():
            self._connect()
        self._task = self._ray.remote(num_cpus=1, max_retries=0)(_work)
        if self._workers is None:
            self._workers = max(1, int(self._ray.cluster_resources().get("CPU", 1)))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Lets go of the cluster, and ends it if it was begun here."""
        for reference in self._running:
            self._ray.cancel(reference, force=True)
        self._running.clear()
        self._ray.shutdown()

    def _connect(self) -> None:
        quiet = {"log_to_driver": False, "configure_logging": False}
        if self._address is None:
            with _own_path():
                self._ray.init(
                    address="local",
                    num_cpus=self._workers,
                    include_dashboard=False,
                    _node_ip_address="127.0.0.1",
                    **quiet,
                )
            return
        try:
            _knock(self._address)
            self._ray.init(address=self._address, **quiet)
        except (OSError, ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())
            raise ConnectionError(
                f"--address {self._address}: no Ray cluster can be used there ({reason[:200]})"
            ) from error


class _Actor:
    """A worker of Ray that keeps its modules; another one takes its place where it was lost."""

    def __init__(self, ray: Any) -> None:
        self._ray = ray
        self._actor: Any = None
        self._name = ""
        self._running: Any = None

    def start(self, call: Call) -> None:
        """Hands it to the actor."""
        self._name, function, arguments = call
        if self._actor is None:
            worker = self._ray.remote(num_cpus=1, max_restarts=0, max_task_retries=0)(_Worker)
            self._actor = worker.remote()
        message = pickle.dumps((function, arguments))
        self._running = self._actor.work.remote(message, versions())

    def wait(self) -> Any:
        """Waits for Ray."""
        try:
            reply = _answer_of(self._ray, _first_done(self._ray, [self._running]))
        except self._ray.exceptions.RayError as error:
            self._actor = None
            raise _lost(0, self._name, error) from None
        return taken(reply)

    def end(self) -> None:
        """Ends the actor."""
        if self._actor is not None:
            self._ray.kill(self._actor)


class _Worker:
    """What an actor does."""

    def __init__(self) -> None:
        # Before its members' threads begin.
        keep_in_one_place()

    def work(self, message: bytes, asked: tuple[str, ...]) -> bytes:
        """Does a task."""
        return _work(message, asked)


def _first_done(ray: Any, references: Sequence[Any]) -> Any:
    """The first of some tasks that is finished, or lost."""
    done: list[Any] = []
    while not done:
        done, _ = ray.wait([*references], num_returns=1, timeout=_LOOK_S)
    return done[0]


def _lost(number: int, name: str, error: Exception) -> WorkerLost:
    return WorkerLost(number, f"{name}: its worker on Ray was lost ({type(error).__name__})")


def _answer_of(ray: Any, reference: Any) -> bytes:
    """A worker's reply; RayError if the worker was lost, ChildProcessError if it cannot work."""
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        # Not of the task, whose exceptions are part of the reply: the package is not there, or is another one.
        reason = str(error.cause if error.cause is not None else error).strip().splitlines()[-1]
        raise ChildProcessError(f"--engine ray: a worker cannot work: {reason}") from error


def _knock(address: str) -> None:
    """OSError where nobody listens at HOST:PORT: Ray would try for a quarter of an hour."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), timeout=_PATIENCE_S).close()
    elif address != "auto":
        raise ValueError("expected HOST:PORT, ray://HOST:PORT or auto")


def versions() -> tuple[str, ...]:
    """What must be the same on both sides, for results to be the same to the last bit."""
    return (
        f"crowdmap_torch {__version__}",
        f"torch {torch.__version__}",
        f"Python {sys.version_info.major}.{sys.version_info.minor}",
    )


@contextmanager
def _sigterm_kept() -> Iterator[None]:
    """Inside, Ray takes SIGTERM for itself; afterwards it is what it was."""
    before = signal.getsignal(signal.SIGTERM)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)


@contextmanager
def _own_path() -> Iterator[None]:
    """Processes begun inside find the modules that this one finds."""
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = before


def _work(message: bytes, asked: tuple[str, ...]) -> bytes:
    """Does a task, in its worker."""
    if (own := versions()) != asked:
        raise RuntimeError(
            f"it has {', '.join(own)}; expected {', '.join(asked)}, as where the run was started"
        )
    torch.set_num_threads(1)
    return answer(message)
