"""The one kind of error that input from outside may cause."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager

_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO}


class InputError(ValueError):
    """Input that breaks FORMAT.md; one line: where, what was expected, what found, what to do."""


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
