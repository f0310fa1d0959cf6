"""The one kind of error that input from outside may cause."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Literal

Code = Literal[
    "other",
    "missing-file",
    "unreadable",
    "too-large",
    "other-version",
    "missing-key",
    "unknown-key",
    "value",
    "lens",
    "missing-column",
    "column-type",
    "null",
    "not-finite",
    "unknown-name",
    "name-twice",
    "no-rows",
    "order",
    "range",
    "far-away",
    "leap",
    "quaternion-length",
    "unknown-frame",
    "point-count",
    "score",
    "outside-image",
    "not-clockwise",
    "crosses-itself",
    "no-area",
    "off-axis",
    "no-ray",
    "few-points",
    "no-length",
    "copy",
]
"""Which rule of FORMAT.md is broken, for programs; texts are for people."""


class InputError(ValueError):
    """Input that breaks FORMAT.md; one line: where, what was expected, what found, what to do."""

    def __init__(self, text: str = "", code: Code = "other") -> None:
        for folder, name in _CALLED.get():
            text = text.replace(folder, name)
        super().__init__(text)
        self.code: Code = code


_CALLED: ContextVar[tuple[tuple[str, str], ...]] = ContextVar("called", default=())


@contextmanager
def calling(folder: Path, name: str) -> Iterator[None]:
    """Inside, errors call a folder that is a copy by the name of what it was copied from."""
    token = _CALLED.set((*_CALLED.get(), (str(folder), name)))
    try:
        yield
    finally:
        _CALLED.reset(token)


def one_line(error: object) -> str:
    """The text of somebody else's error without line breaks, cut where it goes on and on."""
    text = " ".join(str(error).split())
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


_LONGEST = 1000
"""Characters of an error of others: they may quote what a file holds."""


@contextmanager
def needing(what: str, package: str) -> Iterator[None]:
    """Inside, packages that `what` stands on are imported: InputError where one is missing, and how pip installs it."""
    try:
        yield
    except ModuleNotFoundError as missing:
        raise InputError(
            f"{what} needs the Python package {missing.name!r}, which is not installed: pip install {package}"
        ) from missing


@contextmanager
def input_read() -> Iterator[None]:
    """Inside, a value or a file that is wrong is wrong input: a ValueError or OSError leaves as an InputError."""
    try:
        yield
    except InputError:
        raise
    except (ValueError, OSError) as error:
        raise InputError(one_line(error)) from error
