"""The linear estimator that knows everything is better than the map, and errs as its bound says."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from crowdmap_torch.adjustment.calibration import CalibrationConfig
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.evaluation.signs import evaluate_signs
from crowdmap_torch.evaluation.visibility import observable_signs
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.io.truth import Truth
from crowdmap_torch.mapper import build_map
from crowdmap_torch.simulate.dataset import SimulationConfig
from crowdmap_torch.simulate.positioning import PositioningConfig
from crowdmap_torch.simulate.sign_detections import SignDetectionConfig
from crowdmap_torch.studies import linear_map as module
from crowdmap_torch.studies.linear_map import LinearMap, linear_map
from crowdmap_torch.tables import Dataset, Signs, Survey


@pytest.fixture(scope="module")
def true_signs(tiny_folder: Path) -> Signs:
    return read_map(tiny_folder / "survey").signs


@pytest.fixture(scope="module")
def found(tiny_truth: Truth, tiny_survey: Survey, true_signs: Signs) -> LinearMap:
    return linear_map(tiny_truth, tiny_survey, true_signs, SimulationConfig())


def test_errors_are_as_large_as_the_bound_says(found: LinearMap, true_signs: Signs):
    error = found.signs.center_world - true_signs.center_world[found.row]
    shared = error.mean(0)
    nees = shared @ torch.linalg.solve(found.shared, shared)
    # Chi-squared with three degrees of freedom is below 16.3 in 99.9 %.
    assert nees < 16.3
    # Three journeys with biases of 0.3, 0.3, 0.42 m, and drifts of 0.25 m that do not quite average out on 120 m.
    expected = torch.tensor([0.39, 0.39, 0.49], dtype=torch.float64) / math.sqrt(3)
    assert torch.allclose(found.shared.diagonal().sqrt(), expected, rtol=0.15)
    own = error - shared
    sigma = (found.signs.covariance - found.shared).diagonal(dim1=1, dim2=2).mean().sqrt()
    assert 0.3 < own.square().mean().sqrt() / sigma < 2.0


def test_the_map_is_not_better_than_the_bound(
    found: LinearMap, tiny: Dataset, tiny_truth: Truth, tiny_survey: Survey
):
    # The bound knows every car's calibration.
    known = build_map(tiny, replace(MapperConfig(), calibration=CalibrationConfig.off()))
    observable = observable_signs(tiny_truth, tiny_survey.signs)
    best = evaluate_signs(found.signs[observable[found.row]], tiny_survey.signs)
    ours = evaluate_signs(known.hd_map.signs, tiny_survey.signs, observable=observable)
    assert best.absolute.total.mean < 1.05 * ours.absolute.total.mean
    assert best.relative.total.mean < 1.2 * ours.relative.total.mean
    # What our map says of what all share is what the bound says, but for what is not known of the sigmas: the fleet's
    # have six degrees of freedom in three journeys and three as they are given, a journey's own two and 24.
    theirs, mine = (s.trace().sqrt() for s in (found.shared, known.hd_map.shared_covariance))
    fleet, own = ((n - 2 / 3) / (n - 2) for n in (6 + 3, 2 + 24))
    assert float(mine / theirs) == pytest.approx(math.sqrt(fleet * own), abs=0.25)


def test_a_sign_seen_once_or_never_spoils_nothing(
    found: LinearMap, tiny_truth: Truth, tiny_survey: Survey, true_signs: Signs
):
    """Once: what is usual of signs makes up for what one view leaves open."""
    once, never = found.row[:2].tolist()
    is_first = True
    journeys = []
    for journey in tiny_truth.journeys:
        left_out = journey.sign_outlier | (journey.sign == never)
        of_once = torch.nonzero((journey.sign == once) & ~left_out)[:, 0]
        left_out[of_once[1:] if is_first else of_once] = True
        is_first = is_first and not len(of_once)
        journeys.append(replace(journey, sign_outlier=left_out))
    few = linear_map(Truth(tuple(journeys)), tiny_survey, true_signs, SimulationConfig())
    assert few.row.tolist() == [row for row in found.row.tolist() if row != never]
    assert bool(few.signs.T_world_sign.isfinite().all())
    variance = few.signs.covariance.diagonal(dim1=1, dim2=2).sum(1)
    assert variance[0] > 2 * variance[1:].max()


def test_poses_err_by_bias_drift_and_noise():
    way = torch.tensor([0.0, 150.0], dtype=torch.float64)
    config = PositioningConfig()
    covariance = module._joint(module._pose_covariances(way, config))
    total = config.bias_e_m**2 + config.drift_m**2 + config.white_e_m**2
    assert float(covariance[0, 0]) == pytest.approx(total)
    between = config.bias_e_m**2 + config.drift_m**2 / math.e
    assert float(covariance[0, 6]) == pytest.approx(between)
    assert not covariance[0, [1, 2, 3, 4, 5, 7, 8, 9, 10, 11]].any()
    assert float(covariance[3, 3]) == pytest.approx(
        math.radians(config.drift_rot_deg) ** 2 + math.radians(config.white_rot_deg) ** 2
    )


@pytest.fixture(scope="module")
@torch.no_grad()
def first_drive(tiny_truth: Truth, tiny_survey: Survey, true_signs: Signs):
    """The bundle at the truth, and what the first drive's corners are there, with their times."""
    truth = Truth(tiny_truth.journeys[:1])
    shown = torch.cat([module._shown(t) for t in truth.journeys])
    row = torch.unique(shown[shown >= 0])
    bundle = module._bundle_at_truth(truth, tiny_survey, true_signs, row)
    corner, _ = module._true_terms(bundle, SimulationConfig(), torch.arange(len(bundle.frame)))
    t_s = truth.journeys[0].journey.t_ns[bundle.frame].double() * 1e-9
    return bundle, corner, t_s, {"poses": len(bundle.frame), "first_pose": 0}


@torch.no_grad()
def test_boxes_that_tremble_are_weighed_by_what_they_have_in_common(first_drive):
    bundle, corner, t_s, here = first_drive
    config = SignDetectionConfig(jitter_px=0.7, jitter_s=0.3)
    hessian, gradient = module._of_tracks(bundle, corner, t_s, config, **here)
    # Plainly, of all rows at once: J^T C^-1 J, with C in units of pixels.
    sign, pose = corner.slots[1][1], corner.slots[0][1]
    sigma, t = 1 / corner.weight, t_s[pose]
    apart = (t[:, None] - t[None, :]).abs()
    tremble = 0.7**2 * torch.exp(-apart / 0.3) * (sign[:, None] == sign[None, :])
    inverse = torch.linalg.inv(torch.diag(sigma**2) + tremble)
    column, whitened, residual = module._linear(bundle, corner, **here)
    expected, force = torch.zeros_like(hessian), torch.zeros_like(gradient)
    for axis in range(2):
        J = hessian.new_zeros(len(sign), len(hessian))
        J[torch.arange(len(sign)).expand(column.shape), column] = whitened[axis] * sigma
        expected += J.mT @ inverse @ J
        force += J.mT @ inverse @ (residual[axis] * sigma)
    assert torch.allclose(hessian, expected, rtol=1e-9, atol=1e-9 * float(expected.abs().max()))
    assert torch.allclose(gradient, force, rtol=1e-9, atol=1e-9 * float(force.abs().max()))


@torch.no_grad()
def test_boxes_that_hardly_tremble_are_weighed_like_others(first_drive):
    bundle, corner, t_s, here = first_drive
    config = SignDetectionConfig(jitter_px=1e-6)
    hessian, gradient = module._of_tracks(bundle, corner, t_s, config, **here)
    expected, force = module._normal_equations(bundle, [corner], **here)
    assert torch.allclose(hessian, expected, rtol=1e-6, atol=1e-9 * float(expected.abs().max()))
    assert torch.allclose(gradient, force, rtol=1e-6, atol=1e-9 * float(force.abs().max()))


@torch.no_grad()
def test_markers_are_held_along_themselves_and_the_map_nowhere(first_drive):
    bundle, *_ = first_drive
    signs, coefficients = len(bundle.values()["sign"]), len(bundle.values()["lane"])
    held = module._held_along(bundle)
    every = torch.zeros(len(held), 3, dtype=torch.float64)
    every[: 6 * signs].view(signs, 6, 3)[:, :3] = torch.eye(3).double()
    every[8 * signs :].view(coefficients, 3, 3)[:] = torch.eye(3).double()
    assert (held @ every).abs().max() < 1e-12
    # A marker that slides along itself by two metres is two sigmas away.
    first = int(bundle.lane_count[0])
    slid = torch.zeros(len(held), dtype=torch.float64)
    slid[8 * signs :].view(coefficients, 3)[:first] = 2 * bundle.lane_axes[:first, :, 0]
    assert float(slid @ held @ slid) == pytest.approx(4.0)
