"""The one kind of error that input from outside may cause."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
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
        super().__init__(text)
        self.code: Code = code


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
