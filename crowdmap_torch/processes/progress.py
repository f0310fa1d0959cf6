"""Whom a long stage tells how far it is."""

from __future__ import annotations

from collections.abc import Callable

ProgressCall = Callable[[str, int, int], object]
"""Is told the stage, what is done of it, and of how much."""


def silent(*told: object) -> None:
    """Nobody listens."""
