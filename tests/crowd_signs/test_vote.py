"""First biases of journeys, by the pattern of the signs around."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from worlds.crowd_world import World, make_world, shuffled

from crowdmap_torch.crowd_signs.vote import VoteConfig, vote_biases
from crowdmap_torch.tables import concatenate


def bias_of(world: World, config: VoteConfig | None = None) -> Tensor:
    return vote_biases(
        world.crowd.signs,
        config or VoteConfig(),
        journeys=world.crowd.journeys,
        bias_sigma=world.crowd.bias_sigma,
        generator=torch.Generator().manual_seed(0),
    )


def moved(world: World, offset: Tensor) -> World:
    """The world with every sign moved by its row of `offset`."""
    T = world.crowd.signs.T_world_sign.clone()
    T[:, :3, 3] += offset
    signs = replace(world.crowd.signs, T_world_sign=T)
    return replace(world, crowd=replace(world.crowd, signs=signs))


@pytest.mark.parametrize("journeys", [2, 4, 12])
def test_vote_finds_biases_as_large_as_signs_are_apart(journeys: int):
    world = make_world(7, journeys=journeys, bias_m=0.85)
    bias = vote_biases(
        world.crowd.signs,
        VoteConfig(),
        journeys=journeys,
        bias_sigma=world.crowd.bias_sigma,
        generator=torch.Generator().manual_seed(0),
    )
    truth = torch.stack(
        [world.error[world.crowd.signs.journey == j].mean(0) for j in range(journeys)]
    )
    miss = (bias - bias.mean(0)) - (truth - truth.mean(0))
    # Drift of 0.25 m is no bias; signs on a post are 0.7 m apart.
    assert miss.norm(dim=1).max() < 0.35


def test_journeys_on_different_roads_keep_their_priors_mean():
    near, far = make_world(8, journeys=3), make_world(9, journeys=3)
    T = far.crowd.signs.T_world_sign.clone()
    T[:, 1, 3] += 5000
    moved = replace(far.crowd.signs, T_world_sign=T, journey=far.crowd.signs.journey + 3)
    signs = concatenate([near.crowd.signs, moved])
    sigma = torch.cat((near.crowd.bias_sigma, far.crowd.bias_sigma))
    generator = torch.Generator().manual_seed(0)
    bias = vote_biases(signs, VoteConfig(), journeys=6, bias_sigma=sigma, generator=generator)
    # The prior holds the mean of each road at zero, not exactly where a vote is down-weighted.
    assert bias[:3].mean(0).abs().max() < 0.05
    assert bias[3:].mean(0).abs().max() < 0.05


EVERY_PAIR = VoteConfig(votes=10**6)
"""Nothing is drawn by chance where there are fewer signs and journeys than may be compared."""


def test_votes_do_not_depend_on_the_order_of_signs():
    world = make_world(3, journeys=4, length_m=400.0, posts=12)
    other, _ = shuffled(world, seed=1)
    one, two = bias_of(world, EVERY_PAIR), bias_of(other, EVERY_PAIR)
    # The same sums in another order.
    torch.testing.assert_close(one, two, rtol=0, atol=1e-6)


def test_what_all_journeys_share_is_no_bias():
    world = make_world(3, journeys=4, length_m=400.0, posts=12)
    away = moved(world, torch.tensor([640.0, -320.0, 16.0]).double())
    one, two = bias_of(world, EVERY_PAIR), bias_of(away, EVERY_PAIR)
    # Places a thousand times as large: rounding of their differences.
    torch.testing.assert_close(one, two, rtol=0, atol=1e-6)


def test_a_shift_of_one_journey_is_its_bias():
    world = make_world(3, journeys=4, length_m=400.0, posts=12)
    mine = world.crowd.signs.journey[:, None] == 2
    shift = torch.tensor([1.5, -1.0, 0.5]).double()
    one, two = (bias_of(w, EVERY_PAIR) for w in (world, moved(world, mine * shift)))
    found = (two - two[0]) - (one - one[0])
    # A vote is placed to half the width of its kernel: the drift of each journey blurs what the signs say.
    half = VoteConfig().width_m / 2
    torch.testing.assert_close(found[2], shift, rtol=0, atol=half)
    assert found[[1, 3]].norm(dim=1).max() < half


@pytest.mark.parametrize("journeys", [1, 3])
def test_without_signs_nobody_is_biased(journeys: int):
    world = make_world(3, journeys=journeys, length_m=400.0, posts=4)
    none = torch.zeros(0, dtype=torch.int64)
    bias = bias_of(replace(world, crowd=replace(world.crowd, signs=world.crowd.signs[none])))
    assert bias.shape == (journeys, 3) and not bias.any()


def test_one_journey_alone_is_not_biased():
    bias = bias_of(make_world(3, journeys=1, length_m=400.0, posts=4))
    assert bias.shape == (1, 3) and not bias.any()
