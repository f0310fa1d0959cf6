"""Feather files (Arrow) of others: columns of numbers and texts, checked as they are taken."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Float, Int
from pyarrow import feather

from crowdmap_torch.io.budget import budget_now, file_size
from crowdmap_torch.io.errors import InputError, one_line


class Feather:
    """A Feather file with the columns that are asked for, and maybe others."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        file_size(path, budget_now().table_bytes)
        try:
            self._table = feather.read_table(path)
        except (pa.ArrowException, OSError, ValueError) as error:
            raise InputError(f"{path}: cannot be read as Feather ({one_line(error)})") from error
        self.path = path
        for name in columns:
            if name not in self._table.column_names:
                raise InputError(
                    f"{path}: column {name!r} is missing; expected {', '.join(columns)}"
                )

    def numbers(self, names: Sequence[str]) -> Float[np.ndarray, "n k"]:
        """Finite numbers of some columns."""
        try:
            rows = [self._table.column(n).cast(pa.float64()).to_numpy() for n in names]
        except (pa.ArrowException, ValueError) as error:
            raise InputError(f"{self.path}: expected numbers ({one_line(error)})") from error
        values = np.stack(rows, axis=-1)
        if (bad := ~np.isfinite(values).all(-1)).any():
            row = int(bad.argmax())
            raise InputError(
                f"{self.path}: row {row}: expected finite numbers in {', '.join(names)}"
            )
        return values

    def integers(self, name: str) -> Int[np.ndarray, " n"]:
        """Whole numbers."""
        column = self._table.column(name)
        if not pa.types.is_integer(column.type) or column.null_count:
            raise InputError(f"{self.path}: column {name!r} has type {column.type}; expected int64")
        # A copy: arrow's own memory is read-only.
        return np.array(column.cast(pa.int64()).to_numpy())

    def row(self, name: str, value: str) -> int:
        """The row whose text is `value`."""
        texts = self._table.column(name).to_pylist()
        if value not in texts:
            there = ", ".join(str(text) for text in texts)
            raise InputError(f"{self.path}: {name} {value!r} is not there; expected one of {there}")
        return texts.index(value)
