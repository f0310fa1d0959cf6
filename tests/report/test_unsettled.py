"""Stages that ended before they came to their tolerance are told of."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from crowdmap_torch.crowd_lanes.cluster import LaneRound
from crowdmap_torch.mapper import FirstMap, MapResult
from crowdmap_torch.report.unsettled import unsettled_findings
from crowdmap_torch.tables import Dataset


def with_misses(first: FirstMap, signs: float, lanes: float) -> FirstMap:
    """The same where eigenvectors ended with these residuals."""
    report = first.crowd.report
    spectra = tuple(replace(spectrum, miss=signs) for spectrum in report.spectra)
    crowd = replace(first.crowd, report=replace(report, spectra=spectra))
    return replace(first, crowd=crowd, lane_rounds=(LaneRound(2, 1, torch.zeros(2), lanes),))


def test_nothing_is_said_of_exact_eigenvectors(tiny: Dataset, tiny_result: MapResult) -> None:
    assert unsettled_findings(tiny, tiny_result.first) == ()


@pytest.mark.parametrize(("signs", "lanes", "told"), [(3e-5, 0.0, "sign"), (0.0, 3e-5, "lane")])
def test_eigenvectors_that_are_not_exact_are_told_of_with_their_residual(
    tiny: Dataset, tiny_result: MapResult, signs: float, lanes: float, told: str
) -> None:
    (finding,) = unsettled_findings(tiny, with_misses(tiny_result.first, signs, lanes))
    line = finding.line(2)
    assert finding.kind == f"unsettled-{told}-clusters"
    assert f"{told}s are clustered by" in line and "3.0e-05" in line and "\n" not in line


def test_drives_that_may_lie_elsewhere_are_named(tiny: Dataset, tiny_result: MapResult) -> None:
    first = tiny_result.first
    assert first.ties is not None
    assert unsettled_findings(tiny, first) == ()
    assert unsettled_findings(tiny, replace(first, ties=None)) == ()
    journeys = len(tiny.journeys)
    group, rival = torch.arange(journeys), torch.zeros(journeys, 3, dtype=torch.float64)
    rival[1, 1] = -2.5
    shifted = torch.zeros(journeys, dtype=torch.bool)
    ties = replace(first.ties, group=group, rival=rival, is_shifted=shifted)
    (finding,) = unsettled_findings(tiny, replace(first, ties=ties))
    assert finding.kind == "untied-drives"
    assert finding.journeys == (tiny.journeys[1].journey_id,)
    assert "2.5 m beside" in finding.line(journeys)
