"""One run of the command line in a process of its own that shares what is loaded already, with limits of time and memory."""

from __future__ import annotations

import os
import resource
import signal
import sys
import time
import traceback
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
    resident_bytes: int
    """The most that it held."""
    out: str
    err: str


def run_apart(main: Callable[[], int], folder: Path, *, seconds: float = SECONDS) -> Outcome:
    """Runs `main` in a forked process, its working folder and its output in `folder`; killed when its time is up."""
    cwd, out, err = folder / "cwd", folder / "out.txt", folder / "err.txt"
    cwd.mkdir(exist_ok=True)
    begun = time.monotonic()
    child = os.fork()
    if child == 0:
        _become(main, cwd, out, err)
    ended, status, usage = 0, 0, None
    pause = 0.002
    while not ended:
        ended, status, usage = os.wait4(child, os.WNOHANG)
        if not ended and time.monotonic() - begun > seconds:
            os.kill(child, signal.SIGKILL)
            ended, status, usage = os.wait4(child, 0)
        if not ended:
            time.sleep(pause)
            pause = min(2 * pause, 0.05)
    assert usage is not None
    return Outcome(
        code=os.waitstatus_to_exitcode(status),
        seconds=time.monotonic() - begun,
        resident_bytes=usage.ru_maxrss * 1024,
        out=out.read_text("utf-8", "replace"),
        err=err.read_text("utf-8", "replace"),
    )


def _become(main: Callable[[], int], cwd: Path, out: Path, err: Path) -> None:
    """What the child does; it never returns."""
    code = 1
    try:
        os.chdir(cwd)
        for path, number in ((out, 1), (err, 2)):
            file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(file, number)
        # Whoever began this process may have put something else in their place.
        sys.stdout, sys.stderr = (os.fdopen(n, "w", closefd=False) for n in (1, 2))
        os.environ["TMPDIR"] = str(cwd)
        most = _mapped_bytes() + _HEADROOM_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
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
