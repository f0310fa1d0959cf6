"""V-B, unlike the paper: over which way the biases of a crowd's drives wander, as their signs tell.

What is expected of positioning (`PositioningNoise`) is a constant for each drive, unless it is as long as the way on which a
bias forgets where it was. Where a receiver's error wanders by metres within a kilometre, signs would be set beside those of
other drives, and stretches be taken for outages. So shorter ways are tried: the likelihood of all signs tells the right one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_median
from crowdmap_torch.crowd_signs.align import (
    AlignConfig,
    align_journeys,
    in_shared_clusters,
    scale_of_misses,
)
from crowdmap_torch.crowd_signs.distance import mahalanobis
from crowdmap_torch.crowd_signs.gather import CrowdSigns, with_covariance
from crowdmap_torch.crowd_signs.journey_bias import BiasEquations, JourneyBias, bias_at
from crowdmap_torch.noise.bias_wander import LEAST_SHARE, WANDER_SHARE
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.optim.robust import Tukey
from crowdmap_torch.tables import Signs

_SHARES = (1 / 2, 1 / 4, 1 / 8)
"""Of the way that is expected: what is tried."""
_MOST_OF_ONE = 5.0
"""Most that one drive says for or against a way [log-likelihood]: a single one with an outage does not speak for all."""
_LEAST_OF_ALL = 3.0
"""A shorter way has to be more likely by this."""


def likely_wander(
    crowd: CrowdSigns,
    covariance: Float[Tensor, "n 3 3"],
    label: Int[Tensor, " n"],
    positioning: PositioningNoise,
    config: AlignConfig,
    *,
    start: JourneyBias,
) -> PositioningNoise:
    """What positioning gets wrong, with the way on which biases wander by which the signs in their clusters are most likely.

    `covariance` [m^2] is what signs have wrong beside their own; `start` the biases known so far. Where it is a shorter way
    than expected, biases wander as much as is taken for granted here, not by `wander_sigma_m`.
    """
    signs, sigma = with_covariance(crowd.signs, covariance), positioning.wander_sigma_m
    used = in_shared_clusters(signs.journey, label)
    ways = [share * positioning.wander_length_m for share in _SHARES]
    # Over a way that no drive is long beside, none would wander: nothing would change.
    ways = [way for way in ways if bool((start.length >= LEAST_SHARE * way).any())]
    if not sigma or not ways or not bool(used.any()):
        return positioning
    far = max(sigma, WANDER_SHARE**0.5 * max(positioning.bias_sigma_m))
    tried = [replace(positioning, wander_length_m=way, wander_sigma_m=far) for way in ways]
    tried.insert(0, positioning)
    evidence = _evidence(crowd, signs, label, used, tried, config, start)
    best = 0
    for other in range(1, len(tried)):
        gain = (evidence[other] - evidence[best]).clamp(-_MOST_OF_ONE, _MOST_OF_ONE)
        best = other if float(gain.sum()) > _LEAST_OF_ALL else best
    return tried[best]


def _evidence(
    crowd: CrowdSigns,
    signs: Signs,
    label: Int[Tensor, " n"],
    used: Bool[Tensor, " n"],
    tried: Sequence[PositioningNoise],
    config: AlignConfig,
    start: JourneyBias,
) -> Float[Tensor, "t j"]:
    """By hypothesis and journey: its log-likelihood, of signs that one of the hypotheses explains."""
    station, sigma = crowd.station, crowd.bias_sigma
    members, own, at = signs[used], label[used], station[used]
    covariance = members.covariance + config.noise_sigma_m**2 * torch.eye(3).to(at)
    places: list[Tensor] = []
    misses: list[Tensor] = []
    for positioning in tried:
        bias = align_journeys(
            signs, label, station, positioning, config, start=start, bias_sigma=sigma
        )
        corrected = members.center_world - bias_at(bias, members.journey, at, members.center_world)
        place = group_median(corrected, own, int(own.max()) + 1)[own]
        places.append(place)
        misses.append(mahalanobis(corrected - place, covariance))
    miss = torch.stack(misses).amin(0)
    scale = scale_of_misses(miss)
    trust = Tukey().weight(miss / scale).clamp_min(1e-4) / scale
    information = torch.linalg.inv(covariance) * trust[:, None, None]
    return torch.stack(
        [
            BiasEquations.of(
                start, members, at, place, information, sigma, positioning
            ).log_evidence()
            for place, positioning in zip(places, tried, strict=True)
        ]
    )
