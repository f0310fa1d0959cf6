"""Flat arrays to Parquet files: lists, lists of points, names; each file written at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float, Int

from crowdmap_torch.io.atomic import atomic_file

Column = pa.Array | pa.ChunkedArray | np.ndarray


def write_parquet(path: Path, columns: Mapping[str, Column]) -> None:
    """Writes one Parquet file; it is complete or not there."""
    with atomic_file(path) as beside:
        pq.write_table(pa.table(dict(columns)), beside)


def name_column(code: Int[np.ndarray, " n"], names: Sequence[str]) -> pa.Array:
    """The name of each code; null for -1."""
    index = pa.array(code, pa.int64(), mask=code < 0)
    return pa.array(list(names), pa.string()).take(index)


def list_column(
    values: Float[np.ndarray, " p"], count: Int[np.ndarray, " n"], kind: pa.DataType | None = None
) -> pa.ListArray:
    """Flat values as lists of `count` each, of float64 unless `kind` says otherwise."""
    return pa.ListArray.from_arrays(_offsets(count), pa.array(values, kind or pa.float64()))


def row_column(values: Float[np.ndarray, "n k"]) -> pa.ListArray:
    """One list for each row of a matrix, say a point or a covariance."""
    return list_column(values.ravel(), np.full(len(values), values.shape[1]))


def points_column(points: Float[np.ndarray, "p k"], count: Int[np.ndarray, " n"]) -> pa.ListArray:
    """Flat points as lists of `count` points each."""
    return pa.ListArray.from_arrays(_offsets(count), row_column(points))


def _offsets(count: Int[np.ndarray, " n"]) -> pa.Array:
    return pa.array(np.concatenate(([0], np.cumsum(count))), pa.int32())
