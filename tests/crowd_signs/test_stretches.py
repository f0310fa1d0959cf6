"""First biases by stretch, and biases that wander: drives that are off one way here and another way there."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from worlds.crowd_world import World, make_world, pair_scores, wandering_world

from crowdmap_torch.crowd_signs.align import AlignConfig, align_journeys, no_bias
from crowdmap_torch.crowd_signs.journey_bias import JourneyBias, bias_at, largest_drift
from crowdmap_torch.crowd_signs.register import CrowdConfig, register_crowd
from crowdmap_torch.crowd_signs.stretches import first_biases, vote_by_stretch
from crowdmap_torch.crowd_signs.vote import VoteConfig, vote_biases
from crowdmap_torch.noise.positioning import PositioningNoise

# The street is short, and so is the way on which a bias forgets where it was.
WANDERS = PositioningNoise(wander_length_m=1500.0)
STANDS = PositioningNoise(wander_sigma_m=0.0)


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


def first(world: World) -> tuple[JourneyBias, Tensor]:
    return first_biases(
        world.crowd,
        PositioningNoise(),
        AlignConfig(),
        VoteConfig(),
        generator=torch.Generator().manual_seed(0),
    )


def expecting(world: World, bias_sigma_m: float) -> World:
    sigma = torch.full_like(world.crowd.bias_sigma, bias_sigma_m)
    return replace(world, crowd=replace(world.crowd, bias_sigma=sigma))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("bias_m", [0.6, 1.8])
def test_how_large_biases_are_is_told_by_all_drives(seed: int, bias_m: float):
    world = expecting(make_world(seed, journeys=10, bias_m=bias_m), 0.6)
    found, larger = first(world)
    # What is expected counts as much as four drives, and of one drive three sigmas at most.
    away = (world.bias - world.bias.median(0).values).clamp(-1.8, 1.8) / 0.6
    expected = ((4 + away.square().sum(0)) / 14).sqrt().clamp_min(1)
    assert torch.allclose(larger, expected, rtol=0.15)
    assert left(world, found).median() < 0.3


def test_one_drive_that_is_far_off_says_little_of_the_others():
    world = expecting(make_world(3, journeys=10, bias_m=0.5), 0.6)
    _, before = first(world)
    T = world.crowd.signs.T_world_sign.clone()
    T[world.crowd.signs.journey == 4, 0, 3] += 5.0
    crowd = replace(world.crowd, signs=replace(world.crowd.signs, T_world_sign=T))
    _, larger = first(replace(world, crowd=crowd))
    # Counted as it stands it would make 2.4.
    assert (larger - before).abs().max() < 0.5


def test_a_vote_follows_what_wanders_though_nobody_said_so():
    world = wandering_world(4, wander_m=1.3, length_m=1000.0, bias_sigma_m=0.7)
    found, _ = first(world)
    assert left(world, found).median() < 0.4 < left(world, voted(world, STANDS)).median()
