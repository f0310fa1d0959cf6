"""Signs that no cluster had, but adjusted poses show."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.crowd_signs.complete_tracks import without_signs
from crowdmap_torch.crowd_signs.duplicates import DuplicateSignConfig
from crowdmap_torch.mapper import FirstMap, MapResult, build_bundle, made_anew
from crowdmap_torch.tables import Dataset


def without(first: FirstMap, sign: int) -> FirstMap:
    """The map as it were if clusters had missed a sign."""
    dropped = torch.arange(len(first.signs)) == sign
    shown = without_signs(first.associations, dropped)
    return replace(first, signs=first.signs[~dropped], associations=shown)


@pytest.fixture(scope="module")
def missed(tiny: Dataset, tiny_result: MapResult) -> tuple[FirstMap, Bundle]:
    """A map that lacks its first sign, and its adjustment at its end."""
    first = without(tiny_result.first, 0)
    bundle = build_bundle(tiny.journeys, tiny_result.journey_maps, first, MapperConfig())
    adjust.adjust(bundle)
    return first, bundle


def test_a_sign_that_clusters_missed_comes_back(tiny, tiny_result: MapResult, missed):
    first, bundle = missed
    again, _ = made_anew(tiny.journeys, tiny_result.journey_maps, first, bundle, MapperConfig())
    assert again is not None and again.found_later == 1 and again.joined == 0
    assert len(again.signs) == len(first.signs) + 1
    before, found = tiny_result.first.signs, again.signs
    there = (found.center_world[-1] - before.center_world[0]).norm()
    assert float(there) < 0.3 and int(found.shape[-1]) == int(before.shape[0])
    assert int(found.n_journeys[-1]) >= int(before.n_journeys[0]) - 1
    assert float(found.confidence[-1]) > 0.9
    # Those who showed it show it again, and what showed others shows them.
    last = len(found) - 1
    for whole, less, now in zip(
        tiny_result.first.associations, first.associations, again.associations, strict=True
    ):
        known = less.sign >= 0
        assert torch.equal(now.sign[known], less.sign[known])
        shown = whole.sign == 0
        assert float((now.sign[shown] == last).double().mean()) > 0.9 or not bool(shown.any())


def test_none_comes_back_that_no_round_could_take_out_again(tiny, tiny_result: MapResult, missed):
    first, bundle = missed
    given = tiny.journeys, tiny_result.journey_maps
    last = MapperConfig(duplicate_signs=DuplicateSignConfig(rounds=1))
    assert made_anew(*given, first, bundle, last)[0] is None


def test_bad_drives_bring_none_back(tiny, tiny_result: MapResult, missed):
    first, bundle = missed
    weight = torch.zeros(len(tiny.journeys), dtype=torch.float64)
    weight[0] = 1.0
    one = replace(first, crowd=replace(first.crowd, journey_weight=weight))
    again, _ = made_anew(tiny.journeys, tiny_result.journey_maps, one, bundle, MapperConfig())
    assert again is None or again.found_later == 0


def test_what_the_adjustment_has_taken_out_does_not_come_back(tiny, tiny_result: MapResult):
    first = tiny_result.first
    bundle = build_bundle(tiny.journeys, tiny_result.journey_maps, first, MapperConfig())
    adjust.adjust(bundle)
    rows = bundle.corners
    bundle.given_up[rows.detection[(rows.sign == 0) & (rows.journey > 0)]] = True
    again, _ = made_anew(tiny.journeys, tiny_result.journey_maps, first, bundle, MapperConfig())
    assert again is not None and again.joined == 1 and again.found_later == 0
