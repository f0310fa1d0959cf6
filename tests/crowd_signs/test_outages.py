"""Stretches of a drive on which its positions leave the road that the others drove."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest
import torch
from worlds.crowd_world import World, make_world

from crowdmap_torch.crowd_signs.cluster import moved
from crowdmap_torch.crowd_signs.outages import Outage, displaced_by, outside_outages
from crowdmap_torch.crowd_signs.register import Crowd, CrowdConfig, register_crowd
from crowdmap_torch.noise.positioning import PositioningNoise

_JOURNEYS, _FROM_M, _TO_M = 10, 350.0, 650.0


def with_outage(world: World, journey: int, away_m: float) -> World:
    """The world with the positions of a journey off by up to this, to the north, for 300 m."""
    crowd = world.crowd
    share = ((crowd.station - _FROM_M) / (_TO_M - _FROM_M)).clamp(0, 1)
    off = away_m * torch.sin(torch.pi * share).square() * (crowd.signs.journey == journey)
    shift = torch.zeros(len(off), 3, dtype=off.dtype)
    shift[:, 1] = off
    return replace(world, crowd=replace(crowd, signs=moved(crowd.signs, shift)))


def registered(world: World) -> Crowd:
    return register_crowd(world.crowd, PositioningNoise(), CrowdConfig())


@cache
def without_outage(seed: int) -> tuple[World, Crowd]:
    """A world, and what is found in it as it is."""
    world = make_world(seed, journeys=_JOURNEYS, bias_m=0.3, fragments=0.0, ghosts=0.0)
    return world, registered(world)


@pytest.mark.parametrize("seed", range(2))
def test_an_outage_is_found_and_nothing_else(seed: int):
    world, right = without_outage(seed)
    assert right.report.outages == ()
    crowd = registered(with_outage(world, 3, 4.0))
    assert {outage.journey for outage in crowd.report.outages} == {3}
    begin = min(outage.from_m for outage in crowd.report.outages)
    end = max(outage.to_m for outage in crowd.report.outages)
    assert _FROM_M - 30 < begin < 450 and 550 < end < _TO_M + 10
    assert 2.5 < max(outage.away_m for outage in crowd.report.outages) < 5.5
    # What was displaced is in no cluster, and no cluster is of displaced signs alone.
    assert crowd.displaced.any() and (crowd.label[crowd.displaced] < 0).all()
    assert (world.crowd.signs.journey[crowd.displaced] == 3).all()


def test_a_sign_whose_place_its_drive_hardly_knows_is_no_outage():
    world, crowd = without_outage(0)
    signs = world.crowd.signs
    displaced = with_outage(world, 3, 4.0).crowd.signs
    unknown = displaced.covariance + 4.0 * torch.eye(3, dtype=torch.float64)
    config = CrowdConfig()
    trusted = torch.ones(len(signs), dtype=torch.bool)
    is_out = (signs.journey == 3) & (displaced.center_world != signs.center_world).any(1)
    label = crowd.label.masked_fill(is_out, -1)

    def found(covariance: torch.Tensor) -> int:
        own = replace(displaced, covariance=covariance)
        away = displaced_by(
            own, label, crowd.heads, trusted, config.match.similarity, config.outages
        )
        return int((away[is_out] > 0).sum())

    assert found(displaced.covariance) > 3
    assert found(unknown) == 0


def test_two_drives_that_are_off_alike_do_not_make_signs():
    world, right = without_outage(2)
    count = len(right.heads)
    crowd = registered(with_outage(with_outage(world, 3, 4.0), 7, 4.0))
    assert {outage.journey for outage in crowd.report.outages} == {3, 7}
    assert len(crowd.heads) == count


def test_frames_of_other_journeys_and_before_and_behind_stay():
    way = torch.arange(0.0, 100.0, 10.0)
    outages = (Outage(1, 25.0, 55.0, 3.0), Outage(1, 80.0, 200.0, 2.0), Outage(2, 0.0, 99.0, 1.0))
    assert (
        outside_outages(way, 1, outages).tolist()
        == [True] * 3 + [False] * 3 + [True] * 2 + [False] * 2
    )
    assert outside_outages(way, 0, outages).all()
