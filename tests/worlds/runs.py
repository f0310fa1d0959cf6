"""Runs of `crowdmap optimize` in the tests' own process, and what they read."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

ROUGH = """\
adjust: {lm: {max_iterations: 6}}
sign_triangulation: {fit: {rounds: 1, lm: {max_iterations: 6}, coarse_lm: {max_iterations: 3}}}
crowd: {rounds: 1}
"""
"""It is not the map that is judged here."""


@dataclass(frozen=True)
class Said:
    """How a run of the script ended."""

    code: int
    out: str
    err: str


def journeys_of(dataset: Path) -> list[Path]:
    return sorted((dataset / "journeys").iterdir())


def spoil_pose(journey: Path) -> None:
    """One of its positions is no number."""
    path = journey / "poses.parquet"
    table = pq.read_table(path)
    x = table["x"].to_numpy().copy()
    x[3] = math.nan
    pq.write_table(table.set_column(table.column_names.index("x"), "x", pa.array(x)), path)
