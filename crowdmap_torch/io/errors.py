"""The one kind of error that input from outside may cause."""

from __future__ import annotations


class InputError(ValueError):
    """Input that breaks FORMAT.md; one line: where, what was expected, what found, what to do."""


def one_line(error: object) -> str:
    """The text of somebody else's error without line breaks."""
    return " ".join(str(error).split())
