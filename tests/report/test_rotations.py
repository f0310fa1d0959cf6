"""Rotations that the images contradict are told of, with the journeys that have them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from crowdmap_torch.mapper import MapResult
from crowdmap_torch.report.rotations import rotation_findings
from crowdmap_torch.tables import Dataset


def test_nothing_is_said_of_rotations_that_fit(tiny: Dataset, tiny_result: MapResult) -> None:
    assert rotation_findings(tiny, tiny_result) == ()


@pytest.mark.parametrize("row", [0, 1])
@pytest.mark.parametrize(
    ("table", "columns"), [("prior_scale", slice(2, 3)), ("white_scale", slice(3, 6))]
)
def test_the_journeys_are_named(
    tiny: Dataset, tiny_result: MapResult, row: int, table: str, columns: slice
) -> None:
    scale = getattr(tiny_result, table).clone()
    scale[row, columns] = 6.0
    (finding,) = rotation_findings(tiny, replace(tiny_result, **{table: scale}))
    assert finding.journeys == (tiny.journeys[row].journey_id,)
    line = finding.line(len(tiny.journeys))
    assert "6.0 times" in line and "sigma_rot" in line and "\n" not in line


@pytest.mark.parametrize("column", [0, 1])
def test_nothing_is_said_of_positions(tiny: Dataset, tiny_result: MapResult, column: int) -> None:
    scale = tiny_result.prior_scale.clone()
    scale[:, column] = 6.0
    assert rotation_findings(tiny, replace(tiny_result, prior_scale=scale)) == ()
