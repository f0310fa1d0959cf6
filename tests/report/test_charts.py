"""The report's charts: the numbers of a record are in them, and explain what they are."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import pytest
import torch

from crowdmap_torch.report import charts
from crowdmap_torch.report.chart import Chart, Dots, Segments, Tiles, svg
from crowdmap_torch.report.drives import CornerResiduals
from crowdmap_torch.report.iteration import Iteration
from crowdmap_torch.report.plots import Eigengap
from crowdmap_torch.report.record import RunRecord
from crowdmap_torch.report.summaries import JourneySummary


def every_chart(record: RunRecord) -> list[Chart]:
    assert record.comparison is not None
    ids = [j.journey_id for j in record.journeys]
    return [
        *charts.error_charts(record.comparison, record.comparison_before, oracle_m=0.1),
        *charts.bias_charts(record.journeys),
        *charts.drift_charts(record.drifts),
        *charts.eigengap_charts(record.spectra),
        *charts.residual_charts(record.residual_px, record.corners, ids),
        *charts.step_charts(record.iterations),
    ]


def test_every_chart_is_drawn_in_milliseconds(record: RunRecord):
    begun = time.process_time()
    found = [svg(chart) for chart in every_chart(record)]
    assert len(found) == 15 and all(text.startswith("<svg") for text in found)
    assert time.process_time() - begun < 2.0


def test_a_step_is_a_stroke_from_its_own_cost_and_changes_are_marked(record: RunRecord):
    cost, scales, _ = charts.step_charts(record.iterations)
    strokes, rest = cost.marks
    assert isinstance(strokes, Segments) and strokes.arrow
    pairs = list(
        zip(
            strokes.x[::2],
            strokes.y[::2],
            strokes.y[1::2],
            strokes.x[1::2],
            strokes and strokes.x[1::2],
            strict=True,
        )
    )
    assert [(n, before, after) for n, before, after, *_ in pairs] == [
        (i.number, i.cost_before, i.total) for i in record.iterations[1:]
    ]
    # Where it began is not known of the first.
    assert list(rest.x) == [0]
    assert [(at, label) for at, _, label in cost.rules_x] == [
        (1.5, "scales changed"),
        (4.5, "detections judged"),
    ]
    assert [mark.label for mark in scales.marks] == ["sign"]


def test_residuals_are_told_apart_by_journey_range_and_place():
    journey = torch.arange(4000) % 2
    far = torch.arange(4000).double() / 100
    length = (1 + journey) * (1 + far)
    corners = CornerResiduals(
        journey=journey,
        residual_px=torch.stack((length, torch.zeros(4000)), dim=1).double(),
        place=torch.stack((journey * 0.9, torch.full((4000,), 0.5)), dim=1).double(),
        range_m=far,
    )
    by_journey, over_range, over_image = charts.residual_charts({}, corners, ["a", "b"])
    median = next(m for m in by_journey.marks if isinstance(m, Dots))
    assert list(median.x) == pytest.approx([21, 42], rel=0.02)
    half = over_range.marks[-1].y
    assert half[0] < half[7] < half[14]
    (tiles,) = over_image.marks
    assert isinstance(tiles, Tiles) and sorted(tiles.value) == pytest.approx([21, 42], rel=0.02)


def test_of_many_journeys_the_worst_are_named(build):
    journey = torch.arange(600) % 60
    corners = CornerResiduals(
        journey, torch.stack((journey, journey), 1).double(), torch.zeros(600, 2).double(),
        torch.full((600,), math.nan).double(),
    )  # fmt: skip
    by_journey, _ = charts.residual_charts({}, corners, [f"j{k}" for k in range(60)])
    assert "worst 40" in by_journey.title and by_journey.y_names[0] == "j20"


def test_nothing_to_draw_is_drawn(record: RunRecord):
    some = [
        *charts.step_charts([Iteration(0, {"a": 0.0}, 1.0, 0.0, 0.0)]),
        *charts.step_charts([]),
        *charts.eigengap_charts([Eigengap("one", (0.0,), 1), Eigengap("none", (), 0)]),
        *charts.bias_charts([JourneySummary("a", 0, 0, 0, 0, (math.nan, math.nan, math.nan))]),
        *charts.residual_charts({"a": torch.zeros(5), "b": torch.zeros(0)}, None, []),
        *charts.drift_charts([]),
    ]
    assert all(svg(chart) for chart in some)
    assert record.comparison is not None
    empty = replace(record.comparison, counted=torch.zeros_like(record.comparison.counted))
    assert not [*charts.error_charts(empty, None, oracle_m=math.nan)]
