"""Sigmas of positioning modules that are not what they say."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.adjusted_street import Street

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.adjustment.covariance import MapUncertainty, map_uncertainty
from crowdmap_torch.noise.pose_prior import PosePriorConfig
from crowdmap_torch.tables import Signs


def signs_alone(
    street: Street, factor: tuple[float, ...], *, prior: PosePriorConfig | None = None
) -> tuple[Signs, MapUncertainty]:
    """The signs of a map without lanes, the positioning module's sigmas multiplied by `factor` of each journey."""
    journeys = []
    for journey, times in zip(street.journeys, factor, strict=True):
        assert journey.sigma_position is not None and journey.sigma_rotation is not None
        position, rotation = times * journey.sigma_position, times * journey.sigma_rotation
        journeys.append(replace(journey, sigma_position=position, sigma_rotation=rotation))
    lanes = street.lanes.select(torch.zeros(0, dtype=torch.int64))
    config = replace(AdjustConfig(), prior=prior or PosePriorConfig())
    bundle = replace(street, journeys=tuple(journeys), lanes=lanes).bundle(config=config)
    adjust.adjust(bundle)
    found = map_uncertainty(bundle, street.signs, lanes)
    return adjust.read_map(bundle, street.signs, lanes, found)[0], found


@pytest.fixture(scope="module")
def as_stated(street: Street) -> tuple[Signs, MapUncertainty]:
    return signs_alone(street, (1.0, 1.0, 1.0))


def test_sigmas_that_are_wrong_by_three_give_nearly_the_same_map(street: Street, as_stated):
    right, of_right = as_stated
    sigma = of_right.shared.trace().sqrt()
    for factor in ((3.0, 3.0, 3.0), (1 / 3, 1 / 3, 1 / 3)):
        wrong, of_wrong = signs_alone(street, factor)
        moved = (wrong.corners_world - right.corners_world)[right.corner_mask]
        # All journeys' sigmas are wrong alike: nobody weighs more on the whole. The drift's share does change, and with
        # it what each weighs where not all have been: small beside what the map does not know of itself.
        assert moved.norm(dim=1).mean() < 0.2 * sigma
        # Three journeys have six degrees of freedom for their biases, and the sigmas as given count for three.
        assert 0.5 < of_wrong.shared.trace().sqrt() / sigma < 2.0


def test_a_journey_that_claims_too_much_leaves_the_map_less_sure(street: Street, as_stated):
    right, of_right = as_stated
    claim = (1.0, 1 / 10, 1.0)
    # Its sigmas are as they were given if the fleet's count for millions of observations, and one is the fleet's.
    trusting = PosePriorConfig(scale_strength=1e9, scale_trust=1e9)
    believed, of_believed = signs_alone(street, claim, prior=trusting)
    doubted, of_doubted = signs_alone(street, claim)
    pulled, less = (
        (found.center_world - right.center_world).mean(0).norm() for found in (believed, doubted)
    )
    sure, doubtful = (found.shared.trace().sqrt() for found in (of_believed, of_doubted))
    assert sure < 0.3 * of_right.shared.trace().sqrt()
    # Two others against one cannot keep it from pulling, but it is seen that it does not fit.
    assert doubtful > 1.5 * sure and less / doubtful < 0.7 * pulled / sure
