"""What a run says of itself: the biases beside the true ones, and a report about the signs that the figures count."""

from __future__ import annotations

import pytest
import torch

from crowdmap_torch.evaluate import evaluate_map
from crowdmap_torch.io.truth import Truth
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.report.plots import sign_errors
from crowdmap_torch.run_metrics import journey_summaries
from crowdmap_torch.tables import Dataset, Survey


def test_biases_stand_beside_the_true_ones(
    tiny: Dataset, tiny_result: MapResult, tiny_truth: Truth
):
    summaries = journey_summaries(tiny, tiny_result, tiny_truth)
    found = torch.tensor([s.bias for s in summaries])
    true = torch.tensor([s.true_bias for s in summaries])
    # What all journeys share nobody can tell; what is left agrees to centimetres.
    left = (found - true) - (found - true).mean(0)
    assert left.abs().max() < 0.1 < true.abs().max()
    assert all(s.true_bias is None for s in journey_summaries(tiny, tiny_result))


def test_the_report_shows_the_signs_that_the_figures_count(
    tiny_result: MapResult, tiny_survey: Survey, tiny_truth: Truth
):
    control = tiny_survey.sign_id[:2]
    figures = evaluate_map(tiny_result.hd_map, tiny_survey, truth=tiny_truth, control_ids=control)
    assert figures.comparison is not None
    assert "comparison" not in figures.as_dict()
    errors = sign_errors(figures.comparison, "absolute")
    assert len(errors) == figures.signs.matched_observable < len(tiny_survey.sign_id)
    assert float(errors.mean()) == pytest.approx(figures.signs.absolute.total.mean, rel=0.1)
