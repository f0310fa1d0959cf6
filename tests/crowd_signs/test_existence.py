"""How sure it is that a sign exists, from who passed by and who saw it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.crowd_world import World, make_world

from crowdmap_torch.crowd_signs.existence import (
    ExistenceConfig,
    existence,
    has_company,
    passing_journeys,
)

CONFIG = ExistenceConfig()


def street(journeys: int, *, back_to_back: bool = False) -> World:
    return make_world(2, journeys=journeys, length_m=400.0, posts=8, back_to_back=back_to_back)


def test_existence_grows_with_those_who_saw_it_and_falls_with_those_who_did_not():
    seen = torch.tensor([1, 2, 3, 20, 2, 2])
    passed = torch.tensor([25, 25, 25, 25, 2, 4])
    p = existence(seen, passed, ExistenceConfig())
    assert (p[1:4] > p[:3]).all()
    assert p[0] < 0.5
    assert p[3] > 0.999
    assert p[4] > p[5] > p[1]


def test_who_saw_a_sign_without_passing_by_counts_as_passing():
    seen = torch.tensor([3, 3])
    one, two = existence(seen, torch.tensor([1, 3]), CONFIG)
    assert one == two


def test_existence_of_no_signs_is_empty():
    none = torch.zeros(0, dtype=torch.int64)
    assert len(existence(none, none, CONFIG)) == 0


def test_every_journey_of_the_street_passes_by_every_sign():
    world = street(5)
    count = len(world.center)
    assert passing_journeys(world.crowd, world.sign, count, CONFIG).tolist() == [5] * count


def test_journeys_the_other_way_do_not_pass_by():
    world = street(5, back_to_back=True)
    passing = passing_journeys(world.crowd, world.sign, len(world.center), CONFIG)
    # Journeys 0, 2 and 4 drive east, towards the first half of the signs.
    half = len(passing) // 2
    assert passing[:half].tolist() == [3] * half and passing[half:].tolist() == [2] * half


def test_without_clusters_or_paths_nobody_passes_by():
    crowd = street(2).crowd
    none = torch.full_like(crowd.signs.journey, -1)
    assert len(passing_journeys(crowd, none, 0, CONFIG)) == 0
    unknown = replace(
        crowd,
        path_journey=crowd.path_journey[:0],
        path_position=crowd.path_position[:0],
        path_direction=crowd.path_direction[:0],
    )
    assert passing_journeys(unknown, none + 1, 1, CONFIG).tolist() == [0]
    assert not has_company(unknown, CONFIG).any()


def test_two_others_on_the_way_are_company():
    assert not has_company(street(2).crowd, CONFIG).any()
    assert has_company(street(3).crowd, CONFIG).all()


def test_those_who_drive_the_other_way_are_no_company():
    world = street(5, back_to_back=True)
    company = has_company(world.crowd, CONFIG)
    east = world.crowd.view_direction[:, 0] > 0
    # Three drive east, so each has two others; the two who drive west have one.
    assert company[east].all() and not company[~east].any()


@pytest.mark.parametrize("corner", [205.0, 225.0, 255.0])
def test_those_who_turned_off_at_the_last_crossing_are_no_company(corner: float):
    crowd = street(4).crowd
    along = crowd.path_position[:, 0]
    stays = (crowd.path_journey == 0) | (along < corner)
    turned_off = replace(
        crowd,
        path_position=crowd.path_position[stays],
        path_direction=crowd.path_direction[stays],
        path_journey=crowd.path_journey[stays],
    )
    beyond = crowd.view_position[:, 0] - corner
    company = has_company(turned_off, CONFIG)
    assert (beyond < 0).any() and company[beyond < 0].all()
    # Bad drives may be off by 20 m and more, and are to be noticed: so far nobody has left the others.
    assert (beyond > 50).any() and not company[beyond > 50].any()


def test_company_does_not_depend_on_the_order_of_signs():
    crowd = street(5, back_to_back=True).crowd
    order = torch.arange(len(crowd.signs)).flip(0)
    turned = replace(
        crowd,
        signs=crowd.signs[order],
        view_position=crowd.view_position[order],
        view_direction=crowd.view_direction[order],
    )
    assert torch.equal(has_company(turned, CONFIG), has_company(crowd, CONFIG)[order])
