"""Charts: what is drawn stands where its numbers are, in the page's own colours, and is small."""

from __future__ import annotations

import math
import re
from xml.etree import ElementTree

import pytest

from crowdmap_torch.report.assets import STYLE
from crowdmap_torch.report.chart import (
    SERIES,
    WIDTH,
    Bars,
    Chart,
    Dots,
    Line,
    Segments,
    Tiles,
    charts_html,
    svg,
)


def drawn(chart: Chart) -> ElementTree.Element:
    return ElementTree.fromstring(svg(chart))


def dots(chart: Chart) -> list[tuple[float, float]]:
    circles = drawn(chart).iter("circle")
    return [(float(c.attrib["cx"]), float(c.attrib["cy"])) for c in circles]


def test_points_stand_in_proportion_up_and_to_the_right():
    a, b, c = dots(Chart("", [Dots([0, 1, 4], [10, 20, 50])]))
    assert a[0] < b[0] < c[0] < WIDTH and a[1] > b[1] > c[1] > 0
    assert (c[0] - a[0]) / (b[0] - a[0]) == pytest.approx(4, abs=0.02)
    assert (c[1] - a[1]) / (b[1] - a[1]) == pytest.approx(4, abs=0.05)


def test_a_logarithmic_axis_has_decades_of_one_length():
    a, b, c = dots(Chart("", [Dots([1, 10, 100], [1, 1000, 10])], log_x=True, log_y=True))
    assert b[0] - a[0] == pytest.approx(c[0] - b[0], abs=0.2)
    assert a[1] - b[1] == pytest.approx(3 * (a[1] - c[1]), abs=0.5)


def test_an_axis_that_is_given_may_run_downwards():
    a, b = dots(Chart("", [Dots([0, 1], [0, 100])], y_range=(100, 0)))
    assert a[1] < b[1]


def test_equal_axes_have_one_scale():
    a, b, c = dots(Chart("", [Dots([0, 10, 0], [0, 0, 1])], equal=True))
    assert b[0] - a[0] == pytest.approx(10 * (a[1] - c[1]), abs=0.6)


def test_a_line_has_gaps_and_no_more_points_than_pixels():
    (path,) = drawn(Chart("", [Line([0, 1, 2, 3], [0, 1, math.nan, 3])])).findall(
        "path[@class='line']"
    )
    assert path.attrib["d"].count("M") == 2
    many = [k / 1000 for k in range(100_000)]
    text = svg(Chart("", [Line(many, many)]))
    assert len(text) < 20_000
    # The last point is there.
    end = re.findall(r"L([\d.]+) ([\d.]+)\"", text)[-1]
    assert float(end[0]) == pytest.approx(
        dots(Chart("", [Dots(many[::99_999], many[::99_999])]))[-1][0], abs=0.2
    )


def test_ticks_are_round_and_told_apart():
    chart = Chart("", [Dots([0.013, 0.0872], [-1234.0, 8421.0])])
    words = [t.text or "" for t in drawn(chart).iter("text")]
    numbers = [w for w in words if re.fullmatch(r"-?[\d,.]+", w)]
    assert len(numbers) == len(set(numbers)) >= 6 and all(len(n) <= 6 for n in numbers)


@pytest.mark.parametrize("log", [False, True])
@pytest.mark.parametrize("most", [19_000.0, 4.2e6])
def test_large_numbers_stay_beside_the_label_of_their_axis(most: float, log: bool):
    """In thousands or millions; the label's letters end 14 units from the left."""
    chart = Chart("", [Dots([0, 1], [most / 8, most])], y_label="cost", log_y=log)
    ends = [t for t in drawn(chart).iter("text") if t.attrib["text-anchor"] == "end"]
    assert len(ends) >= 2
    for text in ends:
        word = text.text or ""
        letters, points = len(word), word.count(".") + word.count(",")
        assert float(text.attrib["x"]) - 6.3 * (letters - points) - 3 * points > 14, word
        value = float(word.rstrip("kM").replace(",", "")) * {"k": 1e3, "M": 1e6}.get(word[-1], 1.0)
        assert value == 0 or most / 10 <= value <= 1.2 * most


def test_the_last_number_of_an_axis_is_inside_the_chart():
    text = svg(Chart("", [Dots([0, 100], [0, 1])], x_range=(0, 100)))
    (x,) = re.findall(r'<text x="([\d.]+)"[^>]*>100</text>', text)
    assert float(x) + 3.4 * len("100") <= WIDTH


def test_names_are_cut_to_what_tells_them_apart():
    names = ["2026-05-01-van", "2026-05-02-van", "2026-05-02-very-long"]
    text = svg(Chart("", [Dots([1, 2, 3], [0, 1, 2])], y_names=names))
    assert ">01-van</text>" in text and ">…y-long</text>" in text
    assert ">same</text>" in svg(Chart("", [Dots([1], [0])], y_names=["same"]))


def test_colors_are_those_of_the_page_and_of_its_dark_side():
    light, dark = STYLE.split("@media (prefers-color-scheme:dark)")[:2]
    marks = [Line([0, 1], [0, 1], color, color) for color in (*SERIES, "faint", "ink")]
    text = charts_html([Chart("t", [*marks, Dots([0], [0], hollow=True)])])
    used = set(re.findall(r"var\(--(\w+)\)", text))
    assert used >= {*SERIES, "card"}
    for name in used:
        assert f"--{name}:" in light and f"--{name}:" in dark, name
    assert "#" not in text


def test_text_from_outside_is_escaped():
    marks = [Dots([0], [0], label="<a>", titles=["<b>"]), Bars([0], [1], title="<c>")]
    text = charts_html([Chart("<t>", marks, "<x>", "<y>", y_names=["<n>"])])
    assert not re.search(r"<[tabcxyn]>", text)


@pytest.mark.parametrize("log", [False, True])
def test_nothing_to_draw_is_drawn(log: bool):
    nothing: list[list[float]] = [[], [math.nan], [0.0], [5.0]]
    for v in nothing:
        marks = [Line(v, v), Dots(v, v), Bars(v, v), Segments(v, v), Tiles(v, v, value=v)]
        drawn(Chart("", marks, log_x=log, log_y=log))
    assert charts_html([]) == ""
