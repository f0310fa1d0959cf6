from __future__ import annotations

import io
import json
import math
from dataclasses import replace

import pytest
import torch

from crowdmap_torch.adjustment.influence import Influence
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.documents import plain
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.report.iteration import Iteration
from crowdmap_torch.report.progress import Progress
from crowdmap_torch.runs.metrics import metrics_of
from crowdmap_torch.tables import Dataset


@pytest.fixture(scope="module")
def metrics(tiny: Dataset, tiny_result: MapResult) -> dict:
    """What metrics.json would hold of the tiny dataset's map."""
    iterations = (Iteration(1, {"sign_reprojection": 2.0, "lane": 1.0}, 1e-4, 0.9, 0.1),)
    told = Progress(io.StringIO())
    told.seconds["adjust"] = 1.5
    found = metrics_of(
        tiny, tiny_result, MapperConfig(), iterations, told, {"again": 1}, None, None
    )
    return json.loads(json.dumps(plain(found), allow_nan=False))


def test_signs_of_the_map_are_certain_or_tentative(metrics, tiny_result: MapResult):
    counts = metrics["counts"]
    assert counts["signs of the map"] + counts["tentative signs"] == len(tiny_result.hd_map.signs)
    assert counts["sign detections used"] <= counts["sign detections"]


def test_detections_used_are_those_of_all_journeys(metrics):
    journeys, counts = metrics["journeys"], metrics["counts"]
    assert sum(j["sign_detections_used"] for j in journeys) == counts["sign detections used"]
    assert sum(j["frames"] for j in journeys) == counts["frames"]
    assert all(j["length_m"] > 0 for j in journeys)


def test_the_cost_of_a_step_is_the_sum_of_its_terms(metrics):
    (step,) = metrics["costs"]
    assert step["total"] == step["sign_reprojection"] + step["lane"] == 3.0


def test_covariances_of_corners_are_symmetric_one_for_each_corner(metrics, tiny_result: MapResult):
    signs = tiny_result.hd_map.signs
    corners = polygon.corner_count(signs.shape).tolist()
    assert metrics["sign_corners"]
    for row, entry in enumerate(metrics["sign_corners"]):
        assert entry["sign_id"] == tiny_result.hd_map.sign_id[row]
        covariance = torch.tensor(entry["covariance"], dtype=torch.float64).view(-1, 3, 3)
        assert len(covariance) == corners[row]
        assert torch.allclose(covariance, covariance.mT, atol=1e-12)


def test_without_a_survey_there_are_no_figures(metrics):
    assert metrics["survey"] is None
    assert metrics["survey_clusters"] is None


def test_what_the_map_would_be_without_a_journey_is_told_where_it_is_asked(
    metrics, tiny: Dataset, tiny_result: MapResult
):
    assert not any("without_it" in journey for journey in metrics["journeys"])
    figures = (torch.tensor([x, 0.5, torch.nan], dtype=torch.float64) for x in (0.4, 0.1, 0.02))
    sigmas, far, across = figures
    found = Influence(sigmas, far, torch.tensor([2, 0, -1]), across, torch.tensor([1, 0, 0]))
    known = replace(tiny_result.uncertainty, influence=found)
    result = replace(tiny_result, uncertainty=known)
    made = plain(metrics_of(tiny, result, MapperConfig(), (), Progress(), {}, None, None))
    first, _, silent = made["journeys"]
    assert first["without_it"] == {
        "in_sigmas": 0.4,
        "farthest_m": 0.1,
        "farthest_sign": tiny_result.hd_map.sign_id[2],
        "across_m": 0.02,
        "signs_gone": 1,
    }
    assert "without_it" not in silent


def test_scales_that_could_not_go_further_are_named(tiny: Dataset, tiny_result: MapResult):
    white = torch.full_like(tiny_result.white_scale, 1.0)
    prior = torch.full_like(tiny_result.prior_scale, 0.8)
    prior[0, 1], prior[0, 2], white[0, 0] = 0.1, 10.0, 10.0
    result = replace(tiny_result, prior_scale=prior, white_scale=white)
    made = metrics_of(tiny, result, MapperConfig(), (), Progress(), {}, None, None)
    scales = [journey["sigma_scale"] for journey in plain(made)["journeys"]]
    assert scales[0]["at_bound"] == ["drift", "rotation", "noise"]
    assert scales[0]["drift"] == 0.1 and scales[1]["drift"] == 0.8
    assert all(scale["at_bound"] == [] for scale in scales[1:])
    assert scales[0]["noise_by_axis"] == [10.0, 1.0, 1.0]
    assert scales[0]["noise"] == pytest.approx(math.sqrt(102 / 3))
    assert scales[0]["rotation_noise"] == 1 and scales[0]["rotation_noise_by_axis"] == [1, 1, 1]
