"""How far two landmarks are from being one sign."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.crowd_world import signs_at, turned_round

from crowdmap_torch.crowd_signs.distance import (
    SimilarityConfig,
    appearance_distance,
    mahalanobis,
    sign_distance,
)
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.tables import Signs

CONFIG = SimilarityConfig()
ONE = signs_at([(10.0, 2.0, 3.0)], [0])
NO_SHIFT = torch.zeros(3).double()


def looks(**changes: torch.Tensor) -> Signs:
    return replace(ONE, **changes)


def test_a_sign_is_no_distance_from_itself():
    assert appearance_distance(ONE, ONE, CONFIG).tolist() == [0.0]
    pair = torch.zeros(1, 2, dtype=torch.int64)
    assert sign_distance(ONE, ONE, pair, CONFIG, NO_SHIFT).tolist() == [0.0]


@pytest.mark.parametrize(
    ("other", "cost"),
    [
        (looks(shape=torch.tensor([polygon.TRIANGLE])), CONFIG.shape_cost),
        (looks(type=torch.tensor([4])), 0.0),
        # Twice the variance, both sizes being measured; a sum over width and height.
        (looks(size=1.12 * ONE.size), float(torch.tensor(1.12).log()) ** 2 / CONFIG.size_sigma**2),
        (looks(size=10 * ONE.size), CONFIG.size_cost_limit),
    ],
    ids=["shape", "type of one unknown", "size", "another size altogether"],
)
def test_each_difference_has_its_cost(other: Signs, cost: float):
    found = appearance_distance(ONE, other, CONFIG)
    # Rounding of a logarithm in single precision.
    assert float(found) == pytest.approx(cost, abs=1e-5)
    # A logarithm of a ratio and of its inverse.
    back = appearance_distance(other, ONE, CONFIG)
    torch.testing.assert_close(found, back, rtol=1e-12, atol=0)


def test_types_differ_only_where_both_are_known():
    known = looks(type=torch.tensor([4]))
    assert float(appearance_distance(known, looks(type=torch.tensor([5])), CONFIG)) == (
        CONFIG.type_cost
    )
    assert float(appearance_distance(known, ONE, CONFIG)) == 0.0


def test_the_costs_of_shape_and_type_add_up():
    other = looks(shape=torch.tensor([polygon.TRIANGLE]), type=torch.tensor([5]))
    cost = appearance_distance(looks(type=torch.tensor([4])), other, CONFIG)
    assert float(cost) == CONFIG.shape_cost + CONFIG.type_cost


@pytest.mark.parametrize(("degrees", "finite"), [(74.0, True), (76.0, False)])
def test_signs_that_face_apart_are_never_one(degrees: float, finite: bool):
    turn = se3.so3_exp(torch.deg2rad(torch.tensor([0.0, degrees, 0.0]).double()))
    T = ONE.T_world_sign.clone()
    T[:, :3, :3] = T[:, :3, :3] @ turn
    assert bool(appearance_distance(ONE, looks(T_world_sign=T), CONFIG).isfinite()) is finite
    assert float(appearance_distance(ONE, turned_round(ONE), CONFIG)) == torch.inf


def test_mahalanobis_counts_standard_deviations(generator: torch.Generator):
    factor = torch.randn(5, 3, 3, generator=generator, dtype=torch.float64)
    covariance = factor @ factor.mT + 0.1 * torch.eye(3).double()
    offset = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    expected = (offset * torch.linalg.solve(covariance, offset)).sum(1)
    torch.testing.assert_close(mahalanobis(offset, covariance), expected, rtol=1e-9, atol=0)


def test_places_are_compared_with_all_that_is_uncertain():
    a, b = signs_at([(0.0, 0.0, 3.0)], [0]), signs_at([(0.5, 0.0, 3.0)], [1])
    found = sign_distance(a, b, torch.tensor([[0, 0]]), CONFIG, NO_SHIFT + 0.3)
    # Two variances of 0.01 m^2 and that of the shift.
    assert float(found) == pytest.approx(0.25 / (0.02 + 0.09), rel=1e-9)


def test_distance_does_not_change_with_the_world_and_the_order_of_the_two():
    signs = signs_at([(0.0, 0.0, 3.0), (0.6, 0.1, 2.8), (4.0, -1.0, 2.0)], [0, 1, 2])
    pair = torch.tensor([[0, 1], [1, 2], [0, 2]])
    cost = sign_distance(signs, signs, pair, CONFIG, NO_SHIFT + 0.2)
    T = signs.T_world_sign.clone()
    T[:, :3, 3] += torch.tensor([512.0, -256.0, 32.0])
    moved = replace(signs, T_world_sign=T)
    # Rounding of coordinates a hundred times as large.
    torch.testing.assert_close(
        sign_distance(moved, moved, pair, CONFIG, NO_SHIFT + 0.2), cost, rtol=1e-9, atol=0
    )
    torch.testing.assert_close(
        sign_distance(signs, signs, pair.flip(1), CONFIG, NO_SHIFT + 0.2), cost, rtol=1e-12, atol=0
    )


def test_no_pairs_have_no_distances():
    none = torch.zeros(0, 2, dtype=torch.int64)
    assert len(sign_distance(ONE, ONE, none, CONFIG, NO_SHIFT)) == 0
