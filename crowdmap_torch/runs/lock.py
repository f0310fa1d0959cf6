"""One writer at a time: a lock that ends with the process that holds it, and a file that says who that is."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.processes.interrupts import held

_NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}
"""A file system that knows no locks."""


@dataclass(frozen=True)
class Writer:
    """Who holds a lock."""

    host: str
    boot: str
    """Differs between machines and from one start of a machine to the next; empty where that is not known."""
    pid: int
    started: str
    """When the process was started, in the kernel's count: tells it from a later one with its number."""
    since: str
    """When it took the lock."""

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host} (since {self.since})"


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Holds the lock file `path` of the folder that it is in; the file goes when the block ends.

    InputError, at once, if another process holds it, or if a file that was left tells of another machine, of which nobody
    here can know. A file that a process of this machine left when it was killed is taken over.
    """
    file = _take(path)
    try:
        yield
    finally:
        with held():
            if _is_at(file, path):
                path.unlink()
            os.close(file)


def _take(path: Path) -> int:
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
        try:
            _take_file(file, path)
            # Whoever held it until now may have removed it in between: then it is another one's file that counts.
            if _is_at(file, path):
                os.ftruncate(file, 0)
                os.pwrite(file, json.dumps(asdict(_this_process()), indent=2).encode(), 0)
                return file
        except (OSError, ValueError):
            os.close(file)
            raise
        os.close(file)


def _take_file(file: int, path: Path) -> None:
    writer, folder = _writer_in(file), path.parent
    may_live = False
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise InputError(
            f"{folder}: {writer or 'another process'} writes there; wait until it has ended, or name another folder"
        ) from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        may_live = True
    if writer is None:
        return
    here = _this_process()
    is_here = writer.boot == here.boot if writer.boot and here.boot else writer.host == here.host
    if is_here and (not may_live or _started(writer.pid) != writer.started):
        return
    if writer.host == here.host and writer.boot != here.boot:
        # The machine was started anew since.
        return
    raise InputError(
        f"{folder}: {writer} writes there, says {path.name}; if it does so no longer, delete {path}"
    )


def _writer_in(file: int) -> Writer | None:
    """Who a lock file names; None if it is empty or names nobody."""
    try:
        return Writer(**json.loads(os.pread(file, 10_000, 0)))
    except (ValueError, TypeError):
        return None


def _is_at(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), os.lstat(path))
    except FileNotFoundError:
        return False


def _this_process() -> Writer:
    return Writer(
        host=socket.gethostname(),
        boot=_read("/proc/sys/kernel/random/boot_id").strip(),
        pid=os.getpid(),
        started=_started(os.getpid()),
        since=datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
    )


def _started(pid: int) -> str:
    """The kernel's count of when a process was started; empty if there is none, or no way to know."""
    # The program's name stands in brackets and may hold anything.
    fields = _read(f"/proc/{pid}/stat").rpartition(")")[2].split()
    return fields[19] if len(fields) > 19 else ""


def _read(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8")
    except OSError:
        return ""
