from __future__ import annotations

from pathlib import Path

import pytest

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.lines import read_lines, read_table, time_ns


def test_times_are_exact():
    assert time_ns("1403636579.763555527", "s") == 1403636579763555527
    assert time_ns("1.5e3", "ms") == 1_500_000_000
    assert time_ns("-2", "us") == -2000


@pytest.mark.parametrize("text", ["noon", "inf", "nan", "1e300", ""])
def test_what_is_no_time_is_refused(text: str):
    with pytest.raises(ValueError, match="expected a number of s"):
        time_ns(text, "s")


def test_comments_and_empty_lines_are_passed_over(tmp_path: Path):
    (tmp_path / "a.txt").write_text("# head\n\n 1, 2;3\t4 5 \n%\n")
    (line,) = read_lines(tmp_path / "a.txt")
    assert (line.number, line.cells) == (3, ("1", "2", "3", "4", "5"))


def test_tables_are_checked_row_by_row(tmp_path: Path):
    path = tmp_path / "a.csv"
    path.write_text('Name, X\n"a, b",1\n')
    assert read_table(path)[0] == ("name", "x")
    path.write_text("name,x\na,1,2\n")
    with pytest.raises(InputError, match=r"a\.csv: line 2: expected 2 values, found 3"):
        read_table(path)
    path.write_text("name,x\n")
    with pytest.raises(InputError, match="has no rows"):
        read_table(path)
