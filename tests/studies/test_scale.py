from __future__ import annotations

from dataclasses import replace

import pytest

from crowdmap_torch.studies.scale import FULL, QUICK, without_lanes


@pytest.mark.parametrize("scale", [FULL, QUICK], ids=["full", "quick"])
def test_drives_of_a_seed_are_as_many_as_its_curves_need(scale):
    for seed in range(scale.seeds):
        most = max(scale.counts) if seed < scale.most_seeds else scale.journeys
        assert scale.drives(seed).journeys == most
        assert scale.drives(seed).seed == scale.short_drives(seed).seed == seed


def test_without_lanes_everything_else_is_the_same():
    drives = FULL.drives(0)
    switched_off = without_lanes(drives)
    assert switched_off.lanes.max_lanes == 0
    assert replace(switched_off, lanes=drives.lanes) == drives
    assert FULL.drives(0, lanes=False) == switched_off


def test_the_quick_scale_is_smaller_in_everything():
    for name in (
        "journeys",
        "short_journeys",
        "seeds",
        "short_seeds",
        "honest_sets",
        "noise_steps",
        "fleet_seeds",
        "fleet_sets",
        "whole_fleet_seeds",
        "fleet_factors",
    ):
        assert getattr(QUICK, name) < getattr(FULL, name)
    assert QUICK.road.length_m < FULL.road.length_m


def test_of_kinds_the_quick_scale_takes_the_first_beside_what_it_is_held_against():
    assert QUICK.kinds is not None
    assert FULL.first("abcde") == FULL.first("abcde", beside=1) == list("abcde")
    assert QUICK.first("abcde") == list("abcde"[: QUICK.kinds])
    assert QUICK.first("abcde", beside=1) == list("abcde"[: 1 + QUICK.kinds])
