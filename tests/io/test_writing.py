from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from crowdmap_torch.io.columns import Sheet
from crowdmap_torch.io.writing import (
    list_column,
    name_column,
    points_column,
    row_column,
    write_parquet,
)


def test_flat_columns_come_back_as_they_were_written(tmp_path: Path):
    rng = np.random.default_rng(0)
    count = np.array([2, 0, 3])
    values, points, rows = rng.random(5), rng.random((5, 3)), rng.random((3, 9))
    path = tmp_path / "some" / "table.parquet"
    columns = {
        "numbers": list_column(values, count),
        "points": points_column(points, count),
        "rows": row_column(rows),
    }
    write_parquet(path, columns)
    sheet = Sheet(path, tuple(columns))
    assert np.array_equal(sheet.number_lists("numbers").values, values)
    assert np.array_equal(sheet.number_lists("numbers").count, count)
    assert np.array_equal(sheet.point_lists("points").values, points)
    assert np.array_equal(sheet.number_lists("rows", 9).values, rows.ravel())


def test_a_code_below_zero_has_no_name():
    assert name_column(np.array([1, -1, 0]), ("a", "b")).to_pylist() == ["b", None, "a"]
    assert name_column(np.array([-1]), ()).to_pylist() == [None]


def test_lists_are_of_the_width_that_is_asked_for():
    column = list_column(np.array([0.1]), np.array([1]), pa.float32())
    assert column.type == pa.list_(pa.float32())


def test_columns_of_different_lengths_leave_the_older_file(tmp_path: Path):
    path = tmp_path / "a.parquet"
    write_parquet(path, {"a": pa.array([1])})
    with pytest.raises(pa.ArrowInvalid):
        write_parquet(path, {"a": pa.array([1]), "b": pa.array([1, 2])})
    assert pq.read_table(path).column_names == ["a"]
    assert [p.name for p in tmp_path.iterdir()] == ["a.parquet"]
