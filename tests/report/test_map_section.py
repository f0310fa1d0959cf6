from __future__ import annotations

import base64
import re
from dataclasses import replace
from pathlib import Path

import pytest

from crowdmap_torch.benchmark.browser import browser, browser_path
from crowdmap_torch.report.html import report_html, write_report
from crowdmap_torch.report.map_section import map_section
from crowdmap_torch.report.record import RunRecord
from crowdmap_torch.viewer.columns import unpacked


def test_the_report_holds_the_viewer_of_its_run(record: RunRecord) -> None:
    text = map_section(record)
    found = re.search(r'id="crowdmap-payload">([^<]*)<', text)
    assert found and text in report_html(record)
    head, columns = unpacked(base64.b64decode(found.group(1)))
    assert head["kind"] == "run" and head["sign_id"] == list(record.hd_map.sign_id)
    assert [drive["id"] for drive in head["drives"]] == ["a", "b"]
    assert len(columns["survey.center"]) == len(columns["before.sign.center"]) == 9


def test_rows_of_the_table_name_the_sign_that_is_shown(record: RunRecord) -> None:
    wicked = ('"><script>', *record.hd_map.sign_id[1:])
    text = report_html(replace(record, hd_map=replace(record.hd_map, sign_id=wicked)))
    assert 'data-id="&quot;&gt;&lt;script&gt;"' in text
    assert text.count("data-id=") == len(wicked)


@pytest.mark.skipif(browser_path() is None, reason="no browser is installed")
def test_a_row_of_the_table_leads_to_its_sign(record: RunRecord, tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_report(path, record)
    with browser(tmp_path / "browser") as page:
        page.resize(1000, 700)
        page.open(path)
        page.ask("document.querySelectorAll('tr.pick')[3].click()")
        chosen = page.ask("document.querySelector('.cmv').viewer.state.chosen")
        assert chosen == {"kind": "sign", "row": 3}
        assert page.complaints() == [] and page.requests() == [path.resolve().as_uri()]
