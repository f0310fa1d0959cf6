"""Journeys that signs tie together, and groups of them moved."""

from __future__ import annotations

from dataclasses import replace

import torch
from worlds.crowd_world import make_world

from crowdmap_torch.crowd_signs.cluster import moved
from crowdmap_torch.crowd_signs.groups import groups_of
from crowdmap_torch.crowd_signs.journey_bias import bias_at
from crowdmap_torch.crowd_signs.register import Crowd, CrowdConfig, register_crowd
from crowdmap_torch.noise.positioning import PositioningNoise

NOISE = PositioningNoise()


def two_roads(journeys: int = 6) -> Crowd:
    """Of every other journey all is on another road."""
    world = make_world(14, journeys=journeys)
    crowd, signs = world.crowd, world.crowd.signs
    far = torch.tensor([5000.0, 0.0, 0.0], dtype=torch.float64)

    def there(journey: torch.Tensor) -> torch.Tensor:
        return (journey % 2)[:, None] * far

    apart = replace(
        crowd,
        signs=moved(signs, there(signs.journey)),
        view_position=crowd.view_position + there(signs.journey),
        path_position=crowd.path_position + there(crowd.path_journey),
    )
    return register_crowd(apart, NOISE, CrowdConfig())


def test_groups_are_those_that_see_the_same_signs():
    crowd = two_roads()
    group = groups_of(crowd)
    assert group.unique().tolist() == [0, 1]
    assert torch.equal(group == group[0], torch.arange(6) % 2 == 0)


def test_who_has_no_say_is_a_group_of_its_own():
    crowd = two_roads()
    weight = crowd.journey_weight.clone()
    weight[2] = 0
    group = groups_of(replace(crowd, journey_weight=weight))
    assert int((group == group[2]).sum()) == 1
    assert int((group == group[0]).sum()) == 2


def test_a_group_moves_with_all_that_it_saw():
    crowd = two_roads()
    group = groups_of(crowd)
    shift = torch.tensor([[0.0, 0.0, 0.0], [0.5, -1.0, 0.25]], dtype=torch.float64)
    move = shift[group]
    after = crowd.moved(move)
    members = crowd.members.journey
    step = after.members.center_world - crowd.members.center_world
    torch.testing.assert_close(step, move[members], rtol=0, atol=1e-9)
    step = after.tentative.center_world - crowd.tentative.center_world
    torch.testing.assert_close(step, move[crowd.tentative.journey], rtol=0, atol=1e-9)
    used = crowd.label >= 0
    step = after.heads.center_world - crowd.heads.center_world
    torch.testing.assert_close(step[crowd.label[used]], move[members[used]], rtol=0, atol=1e-9)
    # Measured places less what is wrong with them are where the members are.
    place, station = crowd.members.center_world, torch.zeros(len(members)).double()
    changed = bias_at(after.bias, members, station, place) - bias_at(
        crowd.bias, members, station, place
    )
    torch.testing.assert_close(changed, -move[members], rtol=0, atol=1e-9)
