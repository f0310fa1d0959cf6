"""All faults of a file at once: while they are gathered, readers go on where they would raise for the first."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

from crowdmap_torch.io.errors import Code, InputError


@dataclass(frozen=True)
class Fault:
    """What in a file breaks FORMAT.md."""

    path: Path
    rule: str
    """What was expected and what found, in the first of the rows; or of the whole file."""
    code: Code = "other"
    """Which rule it is."""
    rows: tuple[int, ...] = ()
    """All rows in which it is so; none: it is the file's."""
    drops: bool = False
    """True: these rows are left out and the rest is used. False: the file is refused."""
    column: str = ""
    """The column that it is about, if it is one."""


class FaultsGathered(InputError):
    """A file cannot be used further; why has been gathered."""


_GATHERED: ContextVar[list[Fault] | None] = ContextVar("faults", default=None)


@contextmanager
def gathering() -> Iterator[list[Fault]]:
    """Inside, readers put faults into the list that this gives, and raise only where they cannot go on."""
    faults: list[Fault] = []
    token = _GATHERED.set(faults)
    try:
        yield faults
    finally:
        _GATHERED.reset(token)


def gathered() -> list[Fault] | None:
    """The faults so far; None where the first one is to be raised."""
    return _GATHERED.get()


@contextmanager
def attempted(path: Path) -> Iterator[None]:
    """What the block refuses, of a file, is gathered, and the block left."""
    faults = gathered()
    if faults is None:
        raise RuntimeError("faults are attempted where none are gathered")
    try:
        yield
    except FaultsGathered:
        pass
    except InputError as error:
        faults.append(Fault(path, str(error).removeprefix(f"{path}: "), error.code))
