from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from crowdmap_torch.simulate.worlds import WORLD_PRESETS, WorldConfig, build_world


def world(name: str, seed: int = 0, **changes):
    return build_world(replace(WORLD_PRESETS[name], **changes), np.random.default_rng(seed))


@pytest.mark.parametrize("name", WORLD_PRESETS)
def test_lanes_lie_between_the_outermost_markers(name: str):
    built = world(name)
    lanes = [offset for offsets in built.lane_centres.values() for offset in offsets]
    assert len(lanes) == built.config.lanes_ahead + built.config.lanes_back
    gaps = np.diff(sorted(lanes))
    low, high = built.config.lane_width_m
    assert np.ptp(gaps) == pytest.approx(0, abs=1e-9) or len(gaps) < 2
    assert all(low <= gap <= high for gap in gaps)


@pytest.mark.parametrize("name", WORLD_PRESETS)
def test_the_same_seed_is_the_same_world(name: str):
    one, again, other = world(name), world(name), world(name, seed=1)
    assert np.array_equal(one.markers.point, again.markers.point)
    assert np.array_equal(one.signs.center, again.signs.center)
    assert not np.array_equal(one.markers.point, other.markers.point)


def test_there_are_as_many_lights_as_asked_for_away_from_the_ends():
    built = world("suburb", lights_per_km=4.0)
    assert len(built.lights) == round(4.0 * built.road.length / 1000)
    assert (np.diff(built.lights) > 0).all()
    share = built.lights / built.road.length
    assert 0.1 < share.min() and share.max() < 0.9


def test_roads_that_cross_interrupt_every_marker_along():
    plain, crossed = world("suburb"), world("suburb", crossings_per_km=2.0)
    along = ~np.isnan(crossed.markers.station)
    assert along.sum() == (1 + round(2.0 * crossed.road.length / 1000)) * len(plain.markers)
    assert (~along).any()


def test_an_exit_is_one_more_marker():
    straight, with_exit = world("highway", exits_per_km=0.0), world("highway", exits_per_km=1.0)
    assert len(with_exit.markers) == len(straight.markers) + round(with_exit.road.length / 1000)


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"length_m": 10.0}, "length_m: expected 50 to "),
        ({"lanes_ahead": 0}, "no lane to drive in"),
        ({"both_directions": True, "lanes_back": 0}, "at least one in each driven direction"),
    ],
)
def test_a_world_nobody_can_drive_in_is_refused(changes, rule: str):
    with pytest.raises(ValueError, match=rule):
        WorldConfig(name="x", **changes)
