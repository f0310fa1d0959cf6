"""The page about a data set: findings beside pictures, complete in itself."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from crowdmap_torch.checking.check import check_dataset
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.report import check as check_page
from crowdmap_torch.report.check import check_html, write_check_page


def drawings(text: str) -> int:
    return text.count("<svg")


def test_journeys_are_drawn_as_many_as_there_may_be_and_nothing_is_fetched(
    winding_pair: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(check_page, "MOST_JOURNEYS", 1)
    page = tmp_path / "page.html"
    write_check_page(page, winding_pair, check_dataset(winding_pair), MapperConfig())
    text = page.read_text()
    assert drawings(text) == 5 and "1 more journeys are not drawn" in text
    fetched = re.findall(r'(?:src|href)="(?!#)[^"]*"', text)
    assert [f for f in fetched if not f.startswith(('href="#', 'xlink:href="#'))] == []


def test_of_journeys_that_are_refused_the_columns_are_drawn(
    winding_pair: Path, tmp_path: Path
) -> None:
    bad = Path(shutil.copytree(winding_pair, tmp_path / "bad"))
    (bad / "journeys" / "journey-001" / "signs.parquet").unlink()
    text = check_html(bad, check_dataset(bad), MapperConfig())
    assert drawings(text) == 1 + 5
    # Those with findings come first.
    assert text.index("<h2>journey-001</h2>") < text.index("<h2>journey-000</h2>")
