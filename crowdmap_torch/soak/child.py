"""One run of the command line in a process of its own that shares what is loaded already, with limits of time and memory."""

from __future__ import annotations

import os
import resource
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

SECONDS = 60.0
"""No run on a small data set takes longer."""
RESIDENT_BYTES = 2 * 2**30
"""Nor more memory."""
_HEADROOM_BYTES = 6 * 2**30
"""Address space beyond what is mapped at the start: a guard of the machine; what counts is what is resident."""


@dataclass(frozen=True)
class Outcome:
    """How a run ended."""

    code: int
    """Its exit code; below zero the signal that ended it."""
    seconds: float
    """How long it took, its waiting for a processor that others used left out."""
    resident_bytes: int
    """The most that it held."""
    out: str
    err: str


class Child:
    """A forked process that runs `main`, its working folder and its output in `folder`, in a group of its own."""

    def __init__(self, main: Callable[[], int], folder: Path) -> None:
        self._folder = folder
        (folder / "cwd").mkdir(exist_ok=True)
        self._begun, self._waited = time.monotonic(), 0.0
        self.pid = os.fork()
        if self.pid == 0:
            _become(main, folder)
        self._outcome: Outcome | None = None

    def has_ended(self) -> bool:
        """Whether it has; asking costs next to nothing."""
        if self._outcome is None:
            self._waited = _waited_for_processor(self.pid)
            ended, status, usage = os.wait4(self.pid, os.WNOHANG)
            if ended:
                self._outcome = Outcome(
                    code=os.waitstatus_to_exitcode(status),
                    seconds=self._taken(),
                    resident_bytes=usage.ru_maxrss * 1024,
                    out=(self._folder / "out.txt").read_text("utf-8", "replace"),
                    err=(self._folder / "err.txt").read_text("utf-8", "replace"),
                )
        return self._outcome is not None

    def outcome(self, *, seconds: float = SECONDS) -> Outcome:
        """Waits for its end; it is killed when it has taken so many seconds."""
        pause = 0.002
        while not self.has_ended():
            if self._taken() > seconds:
                os.kill(self.pid, signal.SIGKILL)
            time.sleep(pause)
            pause = min(2 * pause, 0.05)
        assert self._outcome is not None
        return self._outcome

    def _taken(self) -> float:
        return time.monotonic() - self._begun - self._waited


def run_apart(main: Callable[[], int], folder: Path, *, seconds: float = SECONDS) -> Outcome:
    """What came of `main` in a `Child`."""
    return Child(main, folder).outcome(seconds=seconds)


def _waited_for_processor(process: int) -> float:
    """How long a process could have run while others did [s]; 0 where the kernel does not tell."""
    try:
        return float(Path(f"/proc/{process}/schedstat").read_text().split()[1]) * 1e-9
    except OSError:
        return 0.0


def children(process: int) -> list[int]:
    """The processes that a process has begun; Linux alone tells."""
    listed = Path(f"/proc/{process}/task").glob("*/children")
    return [int(child) for task in listed for child in task.read_text().split()]


def is_there(process: int) -> bool:
    """Whether a process runs; one that has ended and was not asked for its code does not."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return not Path("/proc/self/stat").exists()


def ends(process: int, within_s: float) -> bool:
    """Whether a process that need not be a child ends in time."""
    until = time.monotonic() + within_s
    while is_there(process):
        if time.monotonic() > until:
            return False
        time.sleep(0.02)
    return True


def _become(main: Callable[[], int], folder: Path) -> None:
    """What the child does; it never returns."""
    code = 1
    try:
        os.setpgid(0, 0)
        os.chdir(folder / "cwd")
        for name, number in (("out.txt", 1), ("err.txt", 2)):
            file = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(file, number)
        # Whoever began this process may have put something else in their place.
        sys.stdout, sys.stderr = (os.fdopen(n, "w", closefd=False) for n in (1, 2))
        os.environ |= {"TMPDIR": str(folder / "cwd"), "HOME": str(folder / "cwd")}
        most = _mapped_bytes() + _HEADROOM_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        # What the parent was warned of already is said once more.
        warnings.simplefilter("default", RuntimeWarning)
        code = main()
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 1
    finally:
        _leave(code)


def _leave(code: int) -> None:
    """Ends the process as Python would, a traceback on its way out included, without its parent's cleaning up."""
    if sys.exc_info()[0] is not None and not isinstance(sys.exc_info()[1], SystemExit):
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _mapped_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()
