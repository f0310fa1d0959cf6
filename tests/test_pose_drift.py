"""Knots of the drift: where they lie, and that it is a random walk held at the closest view."""

from __future__ import annotations

import pytest
import torch

from crowdmap_torch.optim.linear import DenseBackend
from crowdmap_torch.optim.problem import Problem, Variable, euclidean
from crowdmap_torch.pose_drift import (
    DriftConfig,
    closest_view,
    drift_terms,
    place_knots,
    signed_distance,
)

F64 = torch.float64
CONFIG = DriftConfig(sigma_m=0.1, knot_m=4.0, max_knots=6)


def test_the_closest_view_is_the_first_of_the_nearest():
    away = torch.tensor([5.0, 2.0, 2.0, 7.0, 1.0])
    group = torch.tensor([0, 1, 1, 0, 0])
    assert closest_view(away, group).tolist() == [4, 1]


def test_distances_are_signed_by_time():
    p = torch.tensor([[0.0, 0, 0], [0, 3, 0], [0, 6, 0], [0, 7, 0]], dtype=F64)
    away = torch.tensor([9.0, 6.0, 3.0, 3.5], dtype=F64)
    distance = signed_distance(p, away, torch.arange(4), torch.zeros(4, dtype=torch.int64))
    assert distance.tolist() == [-6.0, -3.0, 0.0, 1.0]


def test_views_lie_between_their_knots():
    distance = torch.tensor([-9.0, -4.0, 0.0, 2.0, -100.0, 0.0], dtype=F64)
    landmark = torch.tensor([0, 0, 0, 0, 1, 1])
    knots = place_knots(distance, landmark, CONFIG)
    place = (torch.arange(len(knots.landmark)) - knots.anchor[knots.landmark]).to(F64)
    drift = (place * CONFIG.knot_m)[:, None].expand(-1, 3)
    # A drift equal to the place is interpolated to the distance itself, as far as knots reach.
    expected = distance.clamp(-CONFIG.max_knots * CONFIG.knot_m, None)
    torch.testing.assert_close(knots.at_views(drift)[:, 0], expected)
    assert knots.landmark[knots.before].tolist() == landmark.tolist()
    assert not bool(knots.is_last[knots.before].any())


def test_one_view_alone_has_two_knots():
    knots = place_knots(torch.zeros(1, dtype=F64), torch.zeros(1, dtype=torch.int64), CONFIG)
    assert len(knots.landmark) == 2 and float(knots.share[0]) in (0.0, 1.0)


def test_the_drift_grows_with_the_square_root_of_the_way():
    distance = torch.tensor([-16.0, 0.0], dtype=F64)
    knots = place_knots(distance, torch.zeros(2, dtype=torch.int64), CONFIG)
    zero = torch.zeros(len(knots.landmark), 3, dtype=F64)
    problem = Problem(
        {"drift": Variable(3, euclidean, group=knots.landmark)}, drift_terms(knots, CONFIG)
    )
    covariance = DenseBackend().assemble(problem, {"drift": zero}).covariance()[0]
    sigma = covariance.diagonal().reshape(-1, 3)[:, 0].sqrt()
    anchor = int(knots.anchor[0])
    assert float(sigma[anchor]) < 2e-3
    for steps in (1, 4):
        expected = CONFIG.sigma_m * (steps * CONFIG.knot_m) ** 0.5
        assert float(sigma[anchor - steps]) == pytest.approx(expected, rel=1e-3)
