from __future__ import annotations

import csv
import math
from pathlib import Path

from crowdmap_torch.studies.chapter import Chapter, Table, shown, write_chapters


def test_tables_keep_every_digit_and_leave_out_what_is_unknown(tmp_path: Path):
    table = Table("errors", ("name", "error [m]", "n"), (("a, b", 0.123456, 3), ("c", math.nan, 0)))
    page = write_chapters(tmp_path, "all", "Studies", [("one", "One", Chapter(tables=(table,)))])
    with (tmp_path / "tables" / "errors.csv").open(encoding="utf-8") as file:
        assert list(csv.reader(file)) == [
            ["name", "error [m]", "n"],
            ["a, b", "0.123456", "3"],
            ["c", "", "0"],
        ]
    text = page.read_text(encoding="utf-8")
    assert ">0.123<" in text and ">-<" in text and ">nan<" not in text


def test_numbers_are_short_for_people():
    assert [shown(cell) for cell in ("a", 12345, 0.12345, 1234.5, math.nan)] == [
        *("a", "12,345", "0.123", "1,234", "-")
    ]
