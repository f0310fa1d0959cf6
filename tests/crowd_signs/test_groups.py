"""Journeys that signs tie together, and groups of them moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from worlds.crowd_world import make_world
from worlds.gantry import gantry
from worlds.small_world import Builder

from crowdmap_torch.crowd_signs.cluster import moved
from crowdmap_torch.crowd_signs.groups import OtherPlaces, groups_of, other_places
from crowdmap_torch.crowd_signs.journey_bias import bias_at
from crowdmap_torch.crowd_signs.register import Crowd, CrowdConfig, register_crowd
from crowdmap_torch.noise.positioning import PositioningNoise

NOISE = PositioningNoise()
NOBODY = torch.zeros(6, dtype=torch.bool)


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
    group = groups_of(crowd, NOBODY)
    assert group.unique().tolist() == [0, 1]
    assert torch.equal(group == group[0], torch.arange(6) % 2 == 0)


def test_who_has_no_say_is_a_group_of_its_own():
    crowd = two_roads()
    weight = crowd.journey_weight.clone()
    weight[2] = 0
    group = groups_of(replace(crowd, journey_weight=weight), NOBODY)
    assert int((group == group[2]).sum()) == 1
    assert int((group == group[0]).sum()) == 2


def test_a_group_moves_with_all_that_it_saw():
    crowd = two_roads()
    group = groups_of(crowd, NOBODY)
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


def of_gantry(build: Builder, seen: list[list[int]], **more: Sequence[int]) -> OtherPlaces:
    """Where else drives fit that have seen these signs of a gantry, with the fit of `other_places`."""
    bias = torch.zeros(len(seen), 3, dtype=torch.float64)
    _, signs, _ = gantry(build, seen, bias, **more)
    crowd = register_crowd(signs, NOISE, CrowdConfig())
    assert len(crowd.heads) == 3 + bool(more)
    return other_places(crowd, CrowdConfig().match, nearest=1.0, farthest=4.0)


ALL = [0, 1, 2]


def test_one_sign_of_three_that_are_alike_ties_loosely(build: Builder):
    found = of_gantry(build, [ALL, ALL, ALL, [2], [0, 1]])
    assert found.loosely().tolist() == [False, False, False, True, True]
    right = found.shift[found.journey == 3, 1].sort().values
    torch.testing.assert_close(right, torch.tensor([-4.0, -2, 0]).double(), rtol=0, atol=0.2)
    own = found.shift[found.is_own]
    torch.testing.assert_close(own, torch.zeros_like(own), rtol=0, atol=0.2)
    assert not bool(found.seen_by[torch.arange(len(found.journey)), found.journey].any())
    assert bool(found.seen_by[:, :3].all())


def test_a_sign_elsewhere_ties_for_certain(build: Builder):
    found = of_gantry(build, [ALL, ALL, [2], [2]], extra=[0, 1, 3])
    assert found.loosely().tolist() == [False, False, True, False]


def test_signs_that_look_otherwise_are_no_other_place(build: Builder):
    _, signs, _ = gantry(build, [ALL, ALL, [2]], torch.zeros(3, 3).double())
    place = ((signs.signs.center_world[:, 1] + 2) / 2).round().long()
    crowd = register_crowd(
        replace(signs, signs=replace(signs.signs, shape=place)), NOISE, CrowdConfig()
    )
    found = other_places(crowd, CrowdConfig().match, nearest=1.0, farthest=4.0)
    assert not len(found.journey) and not bool(found.loosely().any())


def test_who_is_tied_loosely_is_a_group_of_its_own(build: Builder):
    _, signs, _ = gantry(build, [ALL, ALL, [2], [2]], torch.zeros(4, 3).double())
    crowd = register_crowd(signs, NOISE, CrowdConfig())
    assert groups_of(crowd, NOBODY[:4]).unique().tolist() == [0]
    found = other_places(crowd, CrowdConfig().match, nearest=1.0, farthest=4.0)
    group = groups_of(crowd, found.loosely())
    assert group[0] == group[1] and len(group.unique()) == 3
    own, others = torch.arange(4) == 2, torch.arange(4) < 2
    some = found.of(own, others)
    assert some is not None and some.journey.unique().tolist() == [2]
    assert bool((some.host < 2).all())
    assert found.of(own, own) is None and found.of(others, own) is None
