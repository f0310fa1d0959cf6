"""First biases by stretch, and biases that wander: drives that are off one way here and another way there."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from worlds.crowd_world import World, make_world, pair_scores

from crowdmap_torch.crowd_signs.align import (
    AlignConfig,
    JourneyBias,
    align_journeys,
    bias_at,
    largest_drift,
    no_bias,
)
from crowdmap_torch.crowd_signs.register import CrowdConfig, register_crowd
from crowdmap_torch.crowd_signs.stretches import vote_by_stretch
from crowdmap_torch.crowd_signs.vote import VoteConfig, vote_biases
from crowdmap_torch.noise.positioning import PositioningNoise

# The street is short, and so is the way on which a bias forgets where it was.
WANDERS = PositioningNoise(wander_length_m=1500.0)
STANDS = PositioningNoise(wander_sigma_m=0.0)


def wandering_world(seed: int, *, wander_m: float) -> World:
    """Six drives of 2 km whose bias goes from one side to the other: by twice `wander_m` from end to end."""
    world = make_world(seed, journeys=6, length_m=2000.0, posts=60, bias_m=0.5)
    crowd = world.crowd
    phase = torch.arange(6).double()[crowd.signs.journey]
    angle = torch.pi * (crowd.station / 2000.0 - 0.5) + 2 * phase
    wander = wander_m * torch.stack((angle.sin(), (angle + 1).sin(), 0 * angle), dim=1)
    T = crowd.signs.T_world_sign.clone()
    T[:, :3, 3] += wander
    signs = replace(crowd.signs, T_world_sign=T)
    sigma = torch.full_like(crowd.bias_sigma, 1.5)
    crowd = replace(crowd, signs=signs, bias_sigma=sigma)
    return replace(world, crowd=crowd, error=world.error + wander)


def left(world: World, bias: JourneyBias) -> Tensor:
    """Horizontal error that is left at each sign, up to what all drives share at its place [m]."""
    crowd = world.crowd
    found = bias_at(bias, crowd.signs.journey, crowd.station, crowd.signs.center_world)
    rest = (world.error - found)[world.sign >= 0]
    sign = world.sign[world.sign >= 0]
    total = rest.new_zeros(int(sign.max()) + 1, 3).index_add_(0, sign, rest)
    return (rest - (total / torch.bincount(sign).clamp_min(1)[:, None])[sign])[:, :2].norm(dim=1)


def voted(world: World, positioning: PositioningNoise) -> JourneyBias:
    crowd = world.crowd
    start = no_bias(crowd.signs, crowd.station, positioning, AlignConfig(), journeys=crowd.journeys)
    return vote_by_stretch(
        crowd, start, positioning, VoteConfig(), generator=torch.Generator().manual_seed(0)
    )


def test_of_short_drives_the_vote_is_that_of_whole_drives():
    crowd = make_world(0, journeys=5).crowd
    generator = torch.Generator().manual_seed(0)
    whole = vote_biases(
        crowd.signs, VoteConfig(), journeys=5, bias_sigma=crowd.bias_sigma, generator=generator
    )
    found = voted(make_world(0, journeys=5), PositioningNoise())
    assert torch.equal(found.translation, whole) and not found.node_drift.any()


def test_a_vote_by_stretch_follows_a_bias_that_wanders():
    world = wandering_world(1, wander_m=1.5)
    by_stretch, whole = voted(world, WANDERS), voted(world, STANDS)
    assert left(world, by_stretch).median() < 0.6 < left(world, whole).median()


def test_what_wanders_is_told_from_the_drift():
    world = wandering_world(2, wander_m=1.5)
    crowd, start = world.crowd, voted(world, WANDERS)
    found = align_journeys(
        crowd.signs,
        world.sign,
        crowd.station,
        WANDERS,
        AlignConfig(),
        start=start,
        bias_sigma=crowd.bias_sigma,
    )
    assert left(world, found).median() < 0.15
    # What is no drift is not held against a drive.
    assert found.node_wander.norm(dim=1).max() > 1.0 and largest_drift(found).max() < 1.0


def test_signs_of_drives_whose_bias_wanders_by_metres_are_told_apart():
    world = wandering_world(3, wander_m=1.5)
    found = register_crowd(world.crowd, WANDERS, CrowdConfig())
    precision, recall = pair_scores(world, found.label)
    assert precision > 0.97 and recall > 0.93 and not found.report.outlier_journeys
