from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from crowdmap_torch.io.columns import Sheet
from crowdmap_torch.io.errors import InputError


@pytest.fixture
def sheet(tmp_path: Path):
    """A function from columns to the sheet that is read of them."""

    def make(optional: tuple[str, ...] = (), **columns) -> Sheet:
        path = tmp_path / "table.parquet"
        pq.write_table(pa.table(columns), path)
        return Sheet(path, tuple(columns), optional)

    return make


def test_integers_of_both_widths_are_read_and_null_stands_for_what_is_said(sheet):
    columns = sheet(a=pa.array([1, None, 3], pa.int32()))
    assert columns.integers("a", null=-1).tolist() == [1, -1, 3]
    assert columns.integers("missing", null=-7).tolist() == [-7] * 3
    with pytest.raises(InputError, match=r"table\.parquet: row 1: column 'a' is null"):
        columns.integers("a")


def test_what_is_read_can_be_written_to(sheet):
    columns = sheet(a=pa.array([1, 2]), b=pa.array([0.5, 1.5]))
    for values in (columns.integers("a"), columns.numbers("b")):
        values[0] = 9
        assert values[0] == 9


def test_numbers_are_float64_and_finite(sheet):
    columns = sheet(
        wide=pa.array([1.0, None]),
        narrow=pa.array([0.5, 1.0], pa.float32()),
        text=pa.array(["1", "2"]),
        infinite=pa.array([0.0, np.inf]),
    )
    assert np.isnan(columns.numbers("wide", optional=True)).tolist() == [False, True]
    assert columns.numbers("narrow", single=True).dtype == np.float64
    with pytest.raises(InputError, match="column 'narrow' has type float; expected float64"):
        columns.numbers("narrow")
    with pytest.raises(InputError, match="column 'text' has type string; expected float64"):
        columns.numbers("text")
    with pytest.raises(InputError, match="row 1: column 'infinite': expected a finite number"):
        columns.numbers("infinite", optional=True)


def test_codes_are_places_in_the_list_of_names(sheet):
    columns = sheet(kind=pa.array(["b", "a", None, "b"]), other=pa.array(["a", "x", "a", "a"]))
    assert columns.codes("kind", ("a", "b"), optional=True).tolist() == [1, 0, -1, 1]
    with pytest.raises(
        InputError, match="row 1: column 'other': 'x' is unknown; expected one of a, b"
    ):
        columns.codes("other", ("a", "b"))


def test_ids_are_neither_empty_nor_there_twice(sheet):
    columns = sheet(a=pa.array(["x", "y"]), b=pa.array(["x", ""]), c=pa.array(["x", "x"]))
    assert columns.ids("a") == ("x", "y")
    with pytest.raises(InputError, match="row 1: column 'b'"):
        columns.ids("b")
    with pytest.raises(InputError, match="row 1: column 'c': 'x' stands in row 0 too"):
        columns.ids("c")


def test_lists_are_flat_values_with_their_counts(sheet):
    points = pa.array([[[1.0, 2.0, 3.0]], [], [[4.0, 5.0, 6.0], [7.0, 8.0, 9.0]]])
    columns = sheet(number=pa.array([[1.0], [], [2.0, 3.0]]), point=points)
    lists = columns.number_lists("number")
    assert lists.values.tolist() == [1.0, 2.0, 3.0]
    assert (lists.count.tolist(), lists.start.tolist()) == ([1, 0, 2], [0, 1, 1])
    assert lists.row.tolist() == [0, 2, 2]
    lists = columns.point_lists("point")
    assert lists.values.shape == (3, 3)
    assert lists.row.tolist() == [0, 2, 2]


@pytest.mark.parametrize(
    ("bad", "rule"),
    [
        ([[[1.0, 2.0, 3.0]], [[1.0, 2.0]]], "a point has 2 numbers; expected 3"),
        ([[[1.0, 2.0, 3.0]], [None]], "a point is null"),
        ([[[1.0, 2.0, 3.0]], [[1.0, None, 3.0]]], "expected finite numbers, found null"),
        ([[[1.0, 2.0, 3.0]], None], "column 'p' is null"),
    ],
)
def test_a_bad_point_is_named_by_its_row(sheet, bad, rule):
    columns = sheet(p=pa.array(bad, pa.list_(pa.list_(pa.float64()))))
    with pytest.raises(InputError, match=f"row 1: .*{rule}"):
        columns.point_lists("p")


def test_a_file_that_cannot_be_read_is_one_line(tmp_path: Path):
    with pytest.raises(InputError, match="the file is missing; expected a Parquet file"):
        Sheet(tmp_path / "a.parquet", ())
    with pytest.raises(InputError, match="a folder is there instead"):
        Sheet(tmp_path, ())
    (tmp_path / "a.parquet").write_bytes(b"PAR1 and more")
    with pytest.raises(InputError, match="cannot be read as Parquet") as error:
        Sheet(tmp_path / "a.parquet", ())
    assert "\n" not in str(error.value)


def test_a_missing_column_is_named_with_those_that_are_there(tmp_path: Path):
    pq.write_table(pa.table({"x": [1.0]}), tmp_path / "a.parquet")
    with pytest.raises(InputError, match="column 'y' is missing; expected x, y, found x"):
        Sheet(tmp_path / "a.parquet", ("x", "y"))
