from __future__ import annotations

import re
from dataclasses import replace

import torch

from crowdmap_torch.report.assets import STYLE
from crowdmap_torch.report.summaries import JourneySummary, Pruned, WithoutIt
from crowdmap_torch.report.tables_html import (
    bias_table,
    error_table,
    headline_cards,
    reasons_table,
    sign_table,
    simple_table,
    timing_table,
)


def cells(html: str) -> list[list[str]]:
    """The texts of a table's rows, tags left out."""
    rows = re.findall(r"<tr[^>]*>(.*?)</tr>", html)
    return [[re.sub("<[^>]*>", "", c) for c in re.findall(r"<t[dh].*?</t[dh]>", r)] for r in rows]


def test_words_are_escaped_and_numbers_to_the_right():
    html = simple_table(("name", "n"), [("a<b", "3"), ("c", "4")])
    assert "a&lt;b" in html and "a<b" not in html
    assert html.count('class="text"') == 3


def test_the_table_of_errors_has_those_of_the_heads_beside_them(record):
    head, *rows = cells(error_table(record.figures, record.figures_before))
    assert head[-1] == "mean of cluster heads"
    by_name = {row[0]: row for row in rows}
    absolute = by_name["absolute corner"]
    assert absolute[1] == f"{record.figures.signs.absolute.total.mean:.3f}"
    assert absolute[-1] == f"{record.figures_before.signs.absolute.total.mean:.3f}"
    assert "oracle corner" not in by_name
    assert all(row[4] != "0" for row in rows)
    assert "cluster heads" not in error_table(record.figures, None)


def test_every_sign_is_a_row_that_says_what_it_is_to_the_survey(record):
    head, *rows = cells(sign_table(record))
    assert len(rows) == len(record.hd_map.signs)
    status = [row[head.index("survey")] for row in rows]
    assert status == ["matched"] * len(rows)
    errors = [float(row[head.index("error")]) for row in rows]
    mean = record.figures.signs.absolute.total.mean
    assert abs(sum(errors) / len(errors) - mean) < 1e-3


def test_names_of_signs_may_break_and_no_number_does(record):
    """As Mapillary names signs, they are as long as five columns of numbers."""
    assert ".sortable td.code { white-space:normal;" in STYLE
    row = re.findall(r"<tr class=\"pick\".*?</tr>", sign_table(record))[0]
    assert row.count('class="text code"') == 1


def test_without_a_survey_signs_have_no_errors(record):
    head, *rows = cells(sign_table(replace(record, figures=None)))
    assert "survey" not in head and len(rows) == len(record.hd_map.signs)
    nothing = replace(record.hd_map, signs=record.hd_map.signs[torch.zeros(0, dtype=torch.long)])
    assert sign_table(replace(record, hd_map=nothing, figures=None)) == ""


def test_a_bias_that_is_unknown_is_a_dash_and_sorts_last():
    nan = float("nan")
    html = bias_table([JourneySummary("a", 1, 0, 0, 0, (nan, 0.25, 0.0), (nan, 0.1, nan))])
    _, (name, _, _, _, used, east, north, up, _) = cells(html)
    assert (name, used, east, up) == ("a", "-", "-", "+0.000")
    assert north == "+0.250 ± 0.100"
    assert 'data-v=""' in html


def test_what_would_be_without_a_journey_has_columns_where_it_is_asked():
    known, nan = (0.1, 0.1, 0.1), float("nan")
    summary = JourneySummary("a", 1, 0, 0, 0, known, known)
    assert len(cells(bias_table([summary]))[1]) == 9
    pulls = replace(summary, without_it=WithoutIt(0.41, 0.12, "sign-<7>", 0.03, 2))
    sees_lanes = replace(summary, without_it=WithoutIt(nan, nan, None, 0.01, 0))
    _, first, second, silent = cells(bias_table([pulls, sees_lanes, summary]))
    assert first[9:] == ["0.410", "0.120 sign-&lt;7&gt;", "0.030", "2"]
    assert second[9:] == ["-", "-", "0.010", "0"]
    assert silent[9:] == ["-"] * 4


def test_reasons_come_by_stage_the_most_frequent_first():
    pruned = (Pruned("b", "x", 1), Pruned("a", "y", 2), Pruned("b", "z", 3))
    assert [row[1] for row in cells(reasons_table(pruned))[1:]] == ["z", "x", "y"]


def test_the_longest_stage_has_the_longest_bar():
    assert timing_table({}, {}) == ""
    assert "<td>0.50 GB</td>" in timing_table({"a": 1.0, "b": 4.0}, {"b": 0.5})
    assert re.findall(r"width:([\d.]+)%\"></div>", timing_table({"a": 1.0, "b": 4.0}, {})) == [
        *("25.0", "100.0")
    ]


def test_the_cards_count_what_is_left_out(record):
    text = re.sub("<[^>]*>", " ", headline_cards(record))
    assert "1 set aside, 1 outliers" in text
    assert f"{sum(j.frames for j in record.journeys)} frames" in text
