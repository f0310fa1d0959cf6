"""Stages that ended before they came to their tolerance are told of."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from crowdmap_torch.crowd_lanes.cluster import LaneRound
from crowdmap_torch.mapper import FirstMap, MapResult
from crowdmap_torch.report.unsettled import unsettled_findings


def with_misses(first: FirstMap, signs: float, lanes: float) -> FirstMap:
    """The same where eigenvectors ended with these residuals."""
    report = first.crowd.report
    spectra = tuple(replace(spectrum, miss=signs) for spectrum in report.spectra)
    crowd = replace(first.crowd, report=replace(report, spectra=spectra))
    return replace(first, crowd=crowd, lane_rounds=(LaneRound(2, 1, torch.zeros(2), lanes),))


def test_nothing_is_said_of_exact_eigenvectors(tiny_result: MapResult) -> None:
    assert unsettled_findings(tiny_result.first) == ()


@pytest.mark.parametrize(("signs", "lanes", "told"), [(3e-5, 0.0, "sign"), (0.0, 3e-5, "lane")])
def test_eigenvectors_that_are_not_exact_are_told_of_with_their_residual(
    tiny_result: MapResult, signs: float, lanes: float, told: str
) -> None:
    (finding,) = unsettled_findings(with_misses(tiny_result.first, signs, lanes))
    line = finding.line(2)
    assert finding.kind == f"unsettled-{told}-clusters"
    assert f"{told}s are clustered by" in line and "3.0e-05" in line and "\n" not in line
