"""What a run says of itself: the biases beside the true ones, and a report about the signs that the figures count."""

from __future__ import annotations

from dataclasses import replace

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


def test_the_mean_error_of_a_car_that_stands_is_that_of_its_frames(tiny_truth: Truth):
    truth = tiny_truth.journeys[0]
    given = truth.journey.T_world_camera
    for frames in (1, 5):
        first = torch.zeros(frames, dtype=torch.int64)
        journey = replace(truth.journey, T_world_camera=given[:frames])
        stands = replace(truth, journey=journey, T_world_camera=truth.T_world_camera[first])
        expected = (given[:frames, :3, 3] - truth.T_world_camera[0, :3, 3]).mean(0)
        assert torch.allclose(stands.mean_error_m, expected, atol=0.02)
    apart = given[:, :3, 3] - truth.T_world_camera[:, :3, 3]
    assert torch.allclose(truth.mean_error_m, apart.mean(0), atol=0.1)
