from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest
import torch

from crowdmap_torch.plausibility.finding import Finding
from crowdmap_torch.report.html import report_html, write_report
from crowdmap_torch.report.record import RunRecord
from crowdmap_torch.report.summaries import WithoutIt
from crowdmap_torch.report.tables_html import sign_table

VOID = {"meta", "input", "br", "link", "img"}


class Nesting(HTMLParser):
    """Collects ids and links, and fails where an element is closed that is not open."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag, attrs) -> None:
        if tag not in VOID:
            self.open.append(tag)
        self._note(attrs)

    def handle_startendtag(self, tag, attrs) -> None:
        self._note(attrs)

    def handle_endtag(self, tag) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def _note(self, attrs) -> None:
        named = dict(attrs)
        if "id" in named:
            self.ids.append(named["id"])
        if named.get("href", "").startswith("#"):
            self.links.append(named["href"][1:])


def parse(text: str) -> Nesting:
    parser = Nesting()
    parser.feed(text)
    assert parser.open == []
    return parser


@pytest.fixture(scope="module")
def text(record: RunRecord) -> str:
    return report_html(record)


def test_every_section_is_there_and_linked(text: str):
    parsed = parse(text)
    sections = ["headline", "map", "errors", "journeys", "clusters", "residuals", "adjustment"]
    sections += ["signs", "pruned", "timings", "config"]
    assert parsed.links[: len(sections)] == sections
    assert set(sections) <= set(parsed.ids)


def test_what_looked_wrong_stands_first(record: RunRecord):
    found = Finding("axes", "the <camera> looks aside", "poses do not fit", "turn them", ("a", "b"))
    text = report_html(replace(record, warnings=(found,)))
    assert parse(text).links[1] == "warnings"
    told = text[text.index('class="verdict') : text.index('id="warnings"')]
    for words in ("e &lt;camera&gt; looks aside", "a, b", "poses do not fit", "turn them"):
        assert words in told


def test_the_verdict_stands_above_all_and_what_is_poor_above_what_is_well(record: RunRecord):
    text = report_html(record)
    assert text.index('class="verdict') < text.index('class="card"')
    missing = Finding("no-signs", "the map has no signs", "rays do not meet", "check the poses")
    text = report_html(replace(record, warnings=(missing,)))
    assert 'class="verdict poor"' in text and "The map is poor." in text
    first = text[text.index("<li") : text.index("</li>")]
    assert "no signs" in first and "rays do not meet; check the poses" in first


def test_what_would_be_without_a_journey_is_explained_where_it_is_asked(record: RunRecord):
    assert "Without it" not in report_html(record)
    first, *others = record.journeys
    asked = replace(first, without_it=WithoutIt(0.4, 0.1, "sign-7", 0.02, 0))
    html = report_html(replace(record, journeys=(asked, *others)))
    assert "Without it" in html and "0.100 sign-7" in html


def test_the_head_says_what_was_mapped_when_and_with_what(text: str):
    head = text[text.index("<header>") : text.index("</header>")]
    assert "<dt>with</dt><dd>version &amp; date</dd>" in head


def test_nothing_wrong_needs_no_section(text: str):
    assert 'id="warnings"' not in text


def test_the_report_needs_no_network(text: str):
    # Names of XML vocabularies look like addresses; nothing is fetched from them.
    rest = re.sub(r"http://(www\.w3\.org|purl\.org|creativecommons\.org)[^\s\"]*", "", text)
    rest = rest.replace("https://matplotlib.org/", "")
    assert "://" not in rest
    assert "@import" not in rest
    assert re.search(r"<(script|link|img)[^>]+(src|href)=", rest) is None


def test_text_from_outside_is_escaped(record: RunRecord):
    hd_map = replace(record.hd_map, sign_id=("<script>x",) * 9)
    text = report_html(RunRecord("a <b> road", hd_map, config_yaml="<u>"))
    assert "<script>x" not in text
    assert "<u>" not in text
    assert "a &lt;b&gt; road" in text


def test_reasons_and_figures_are_told(record: RunRecord, text: str):
    for words in ("row 3: x is NaN", "does not fit the others", "too little parallax", "ours"):
        assert words in text
    assert record.figures is not None
    assert f"{record.figures.signs.absolute.total.mean:.3f}<small>m</small>" in text


def test_stretches_without_a_say_are_named(text: str):
    assert "its positions are off by 2.8 m from 120 to 310 m of its way" in text


def test_a_bare_map_has_a_report(build):
    hd_map = build.hd_map(build.signs([[0.0, 0, 2]]))
    parsed = parse(report_html(RunRecord("bare", hd_map)))
    assert parsed.links == ["headline", "map", "signs"]


def test_an_empty_map_has_a_report(build, record):
    nothing = build.hd_map(build.signs(torch.zeros(0, 3, dtype=torch.float64)))
    assert parse(report_html(RunRecord("empty", nothing))).links == ["headline", "map"]
    bare = replace(record, hd_map=nothing, figures=None, figures_before=None)
    assert "map" in parse(report_html(bare)).links


def test_signs_beside_the_survey_say_what_they_are(build, record):
    table = sign_table(record)
    assert table.count("tag matched") == 9
    assert sign_table(replace(record, figures=None)).count('class="tag') == 0


def test_the_same_run_gives_the_same_report(record: RunRecord):
    short = RunRecord("short", record.hd_map, survey=record.survey, spectra=record.spectra)
    assert report_html(short) == report_html(short)


def test_a_report_that_fails_leaves_the_old_one(record: RunRecord, tmp_path: Path, monkeypatch):
    path = tmp_path / "deep" / "report.html"
    record = RunRecord("bare", record.hd_map)
    write_report(path, record)
    before = path.read_text(encoding="utf-8")

    def fail(record):
        raise RuntimeError("no space")

    monkeypatch.setattr("crowdmap_torch.report.html.report_html", fail)
    with pytest.raises(RuntimeError, match="no space"):
        write_report(path, record)
    assert path.read_text(encoding="utf-8") == before
    assert [p.name for p in path.parent.iterdir()] == ["report.html"]
