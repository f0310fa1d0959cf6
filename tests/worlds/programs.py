"""Small programs in processes of their own: what they say, how they end, and whom they leave behind."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
PATIENCE_S = 120
"""For what takes a second at most: the machine may be busy."""


def begin(*arguments: str, **options) -> subprocess.Popen[str]:
    """A Python process with these arguments, what it says in pipes; it finds the package and the tests' worlds."""
    path = os.pathsep.join((str(ROOT), str(ROOT / "tests")))
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(
        [sys.executable, *arguments],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": path, "PYTHONUNBUFFERED": "1"},
        **{**streams, **options},
    )


def is_there(process: int) -> bool:
    """Whether a process runs; one that has ended and was not asked for its code does not."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    stat = Path(f"/proc/{process}/stat")
    return not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] != "Z"


def ends(process: int, within_s: float = PATIENCE_S) -> bool:
    """Whether a process that need not be a child ends in time."""
    until = time.monotonic() + within_s
    while is_there(process):
        if time.monotonic() > until:
            return False
        time.sleep(0.02)
    return True


def children(process: int) -> list[int]:
    """The processes that a process has begun; Linux alone tells."""
    listed = Path(f"/proc/{process}/task").glob("*/children")
    return [int(child) for task in listed for child in task.read_text().split()]
