"""Whom an adjusted map has its signs from."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
import torch

from crowdmap_torch.adjustment import adjust
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.witnesses import witnesses
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.mapper import MapResult, build_bundle, made_anew
from crowdmap_torch.tables import Dataset


@pytest.fixture(scope="module")
def adjusted(tiny: Dataset, tiny_result: MapResult) -> Bundle:
    bundle = build_bundle(
        tiny.journeys, tiny_result.journey_maps, tiny_result.first, MapperConfig()
    )
    adjust.adjust(bundle)
    return bundle


@pytest.fixture
def bundle(adjusted: Bundle) -> Bundle:
    return copy.deepcopy(adjusted)


@pytest.fixture
def all_of_them(tiny: Dataset) -> torch.Tensor:
    return torch.ones(len(tiny.journeys), dtype=torch.bool)


def give_up(bundle: Bundle, sign: int, journeys: range) -> None:
    """All detections of a sign by some journeys."""
    rows = bundle.corners
    theirs = (rows.sign == sign) & (rows.journey >= journeys.start) & (rows.journey < journeys.stop)
    bundle.given_up[rows.detection[theirs]] = True


def test_every_drive_that_saw_a_good_sign_tells_of_it(
    tiny_result: MapResult, bundle: Bundle, all_of_them
):
    found = witnesses(bundle, all_of_them)
    assert torch.equal(found, tiny_result.first.signs.n_journeys)
    without = all_of_them.clone()
    without[0] = False
    rows = bundle.corners
    saw = torch.zeros_like(found).index_fill(0, rows.sign[rows.journey == 0], 1)
    assert torch.equal(witnesses(bundle, without), found - saw)


def test_what_has_no_say_or_does_not_fit_tells_of_nothing(bundle: Bundle, all_of_them):
    before, journeys = witnesses(bundle, all_of_them), len(all_of_them)
    give_up(bundle, 0, range(1, journeys))
    found = witnesses(bundle, all_of_them)
    assert int(found[0]) == 1 and torch.equal(found[1:], before[1:])
    # Three metres beside its place no detection of a sign fits it.
    values = bundle.values()
    moved = values["sign"].detach().clone()
    moved[1, :3, 3] += 3.0
    bundle.fold({**values, "sign": moved})
    found = witnesses(bundle, all_of_them)
    assert int(found[1]) == 0 and torch.equal(found[2:], before[2:])


def test_a_sign_of_one_witness_is_none_of_the_map(
    tiny: Dataset, tiny_result: MapResult, bundle: Bundle
):
    given, first = (tiny.journeys, tiny_result.journey_maps), tiny_result.first
    assert made_anew(*given, first, bundle, MapperConfig())[0] is None
    give_up(bundle, 0, range(1, len(tiny.journeys)))
    again, _ = made_anew(*given, first, bundle, MapperConfig())
    assert again is not None and len(again.signs) == len(first.signs) - 1
    for before, after in zip(first.associations, again.associations, strict=True):
        assert torch.equal(after.sign, (before.sign - 1).clamp_min(-1))
    # One drive by itself has all its signs of one.
    alone = replace(MapperConfig(), crowd=replace(MapperConfig().crowd, min_journeys=1))
    assert made_anew(*given, first, bundle, alone)[0] is None
