from __future__ import annotations

import re

from crowdmap_torch.report.assets import SCRIPT, STYLE
from crowdmap_torch.report.html import report_html


def test_nothing_is_loaded_from_elsewhere():
    for text in (SCRIPT, STYLE):
        assert not re.search(r"https?:|@import|url\(|fetch\(|XMLHttp|</", text)


def test_braces_and_brackets_close():
    for text in (SCRIPT, STYLE):
        for opened, closed in ("{}", "()", "[]"):
            assert text.count(opened) == text.count(closed)


def test_every_class_and_variable_of_the_style_is_used(record):
    page = report_html(record)
    used = page.replace(STYLE, "")
    for name in set(re.findall(r"\.([a-z]\w*)[ ,.:{>]", re.sub(r"\{[^}]*\}", "{", STYLE))):
        # What a sign is to the survey is the class of its tag, and how good the map is that of the verdict.
        others = ("duplicate", "false", "control", "matched", "good", "fair", "poor")
        assert name in used or name in others, name
    for name in set(re.findall(r"var\((--\w+)\)", STYLE)):
        assert f"{name}:" in page, name
