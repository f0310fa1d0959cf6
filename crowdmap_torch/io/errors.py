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
def input_read() -> Iterator[None]:
    """Inside, a value or a file that is wrong is wrong input: a ValueError or OSError leaves as an InputError."""
    try:
        yield
    except InputError:
        raise
    except (ValueError, OSError) as error:
        raise InputError(one_line(error)) from error
