"""What may be read at all: regular files inside their folder, within a budget, looked at before they are read."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.ranges import Range, Settings

_AMOUNT = Range(1, 2**60, "one at least, and what a computer can count")
Amount = Annotated[int, _AMOUNT]


@dataclass(frozen=True)
class ReadingBudget(Settings):
    """The most that one file may ask for; a fleet's largest files need a tenth of it."""

    text_bytes: Amount = 16 * 2**20
    """Size of a JSON, YAML, URDF or CSV file."""
    nodes: Amount = 500_000
    """Values in a JSON or YAML file, those that an alias or a merge repeats counted again."""
    aliases: Amount = 1_000
    """Aliases and merge keys in a YAML file."""
    depth: Amount = 64
    """Mappings and lists inside each other in a JSON or YAML file."""
    table_bytes: Amount = 4 * 2**30
    """Size of a Parquet file."""
    rows: Amount = 100_000_000
    """Rows that a Parquet file claims."""
    decoded_bytes: Amount = 6 * 2**30
    """What the columns of a Parquet file that are read take in memory."""
    expansion: Amount = 200
    """How much more than its size that may be, beyond the first 64 MiB: who packs better has something to hide."""
    name_bytes: Annotated[int, Range(8, 230, "names of files end at 255 bytes, ours add some")] = (
        200
    )
    """Length of an identifier that becomes the name of a file or folder."""


FREE_BYTES = 64 * 2**20
"""What any file may take in memory, however small it is."""


@dataclass(frozen=True)
class _Reading:
    budget: ReadingBudget = ReadingBudget()
    roots: tuple[tuple[Path, str], ...] = ()
    """Folders that nothing may lead out of: as they are called, and as they really are."""


_READING: ContextVar[_Reading] = ContextVar("reading", default=_Reading())  # noqa: B039 (frozen)


@contextmanager
def reading(budget: ReadingBudget | None = None, *, inside: Path | None = None) -> Iterator[None]:
    """Readers called inside keep to `budget`, and read nothing that links lead out of the folder `inside`."""
    now = _READING.get()
    if budget is not None:
        now = replace(now, budget=budget)
    if inside is not None:
        now = replace(now, roots=(*now.roots, (inside, os.path.realpath(inside))))
    token = _READING.set(now)
    try:
        yield
    finally:
        _READING.reset(token)


def budget_now() -> ReadingBudget:
    """The budget that is in force."""
    return _READING.get().budget


def refuse_way_out(path: Path) -> None:
    """InputError if links lead from `path` out of a folder that is read."""
    real = os.path.realpath(path)
    for named, root in _READING.get().roots:
        if real != root and not real.startswith(root.rstrip(os.sep) + os.sep):
            raise InputError(
                f"{path}: a link leads out of {named}; copy what it points at", "missing-file"
            )


def file_size(path: Path, most: int) -> int:
    """The size of a regular file that may be read; InputError for anything else, and for more than `most` bytes."""
    try:
        found = os.stat(path)
    except FileNotFoundError as error:
        missing = "a link to nothing is there" if os.path.islink(path) else "the file is missing"
        raise InputError(f"{path}: {missing}", "missing-file") from error
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(f"{path}: cannot be read ({reason})", "unreadable") from error
    if not stat.S_ISREG(found.st_mode):
        kind = next((name for test, name in _KINDS if test(found.st_mode)), "something else")
        raise InputError(f"{path}: {kind} is there instead of a file", "missing-file")
    refuse_way_out(path)
    if found.st_size > most:
        raise InputError(f"{path}: has {found.st_size} bytes; expected {most} at most", "too-large")
    return found.st_size


def read_bytes(path: Path) -> bytes:
    """The content of a text file of the budget's size; InputError if it cannot be read."""
    most = budget_now().text_bytes
    file_size(path, most)
    try:
        with path.open("rb") as file:
            content = file.read(most + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})", "unreadable") from error
    if len(content) > most:
        raise InputError(
            f"{path}: has more than {most} bytes; expected {most} at most", "too-large"
        )
    return content


def read_text(path: Path) -> str:
    """The same as text; InputError if it is not UTF-8."""
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: is no UTF-8 text (byte {error.start}); expected a text file", "unreadable"
        ) from error


_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
