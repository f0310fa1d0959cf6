"""Runs of `crowdmap optimize` in the tests' own process, and what they read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Said:
    """How a run of the script ended."""

    code: int
    out: str
    err: str


def journeys_of(dataset: Path) -> list[Path]:
    return sorted((dataset / "journeys").iterdir())
