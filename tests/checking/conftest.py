"""Data sets with mistakes, and what is said of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.soak.spoiled import spoiled
from crowdmap_torch.tables import Dataset

Spoil = Callable[[str], Path]


@pytest.fixture
def spoil(winding_pair: Path, tmp_path: Path) -> Spoil:
    """A copy of a good data set of two drives with a mistake."""
    return lambda mistake: spoiled(winding_pair, tmp_path / mistake, mistake)


@pytest.fixture(scope="session")
def drives(winding_pair: Path) -> Dataset:
    """Those without a mistake."""
    return load_dataset(winding_pair)


@pytest.fixture
def set_values() -> Callable[[Path, str, dict[int, float]], None]:
    """Writes values into rows of a column of a file."""

    def change(path: Path, name: str, values: dict[int, float]) -> None:
        table = pq.read_table(path)
        column = table.column(name).to_numpy().copy()
        column[np.array([*values])] = [*values.values()]
        k = table.column_names.index(name)
        pq.write_table(table.set_column(k, name, pa.array(column)), path)

    return change
