from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from crowdmap_torch.io.landmark_ids import lane_ids, sign_ids
from crowdmap_torch.io.maps import as_map
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.tables import Association, Dataset, Signs, concatenate


@pytest.fixture(scope="module")
def every_sign(tiny_result: MapResult) -> Signs:
    return concatenate([tiny_result.first.signs, tiny_result.first.tentative])


def test_ids_are_unique_and_say_what_they_name(tiny_result: MapResult):
    hd_map = tiny_result.hd_map
    names = hd_map.sign_id + hd_map.lane_id
    assert len(set(names)) == len(names) == len(hd_map.signs) + len(hd_map.lanes)
    assert all(name.startswith("sign-") for name in hd_map.sign_id)
    assert all(name.startswith("lane-") for name in hd_map.lane_id)


def test_ids_are_kept_when_a_journey_is_added(
    tiny: Dataset, tiny_result: MapResult, every_sign: Signs
):
    journeys, associations = tiny.journeys, tiny_result.associations
    before = sign_ids(journeys[:2], associations[:2], every_sign)
    after = sign_ids(journeys, associations, every_sign)
    lanes = tiny_result.hd_map.lanes
    lanes_before = lane_ids(journeys[:2], associations[:2], lanes)
    lanes_after = lane_ids(journeys, associations, lanes)
    seen = torch.cat([a.sign for a in associations[:2]]).unique()
    seen_lanes = torch.cat([a.lane for a in associations[:2]]).unique()
    assert len(seen[seen >= 0]) and len(seen_lanes[seen_lanes >= 0])
    assert all(before[k] == after[k] for k in seen[seen >= 0].tolist())
    assert all(lanes_before[k] == lanes_after[k] for k in seen_lanes[seen_lanes >= 0].tolist())


def test_ids_go_with_the_landmarks_wherever_they_stand_in_the_table(
    tiny: Dataset, tiny_result: MapResult, every_sign: Signs
):
    order = torch.arange(len(every_sign)).flip(0)
    row_of = torch.cat((order.argsort(), torch.tensor([-1])))
    moved = tuple(replace(a, sign=row_of[a.sign]) for a in tiny_result.associations)
    names = sign_ids(tiny.journeys, tiny_result.associations, every_sign)
    assert sign_ids(tiny.journeys, moved, every_sign[order]) == names[::-1]


def test_ids_do_not_depend_on_the_order_of_journeys(
    tiny: Dataset, tiny_result: MapResult, every_sign: Signs
):
    flipped = replace(every_sign, journey=len(tiny.journeys) - 1 - every_sign.journey)
    names = sign_ids(tiny.journeys, tiny_result.associations, every_sign)
    assert sign_ids(tiny.journeys[::-1], tiny_result.associations[::-1], flipped) == names


def test_landmarks_that_no_detection_shows_have_names_too(
    tiny: Dataset, tiny_result: MapResult, every_sign: Signs
):
    blind = tuple(
        Association(torch.full_like(a.sign, -1), a.sign_shift, torch.full_like(a.lane, -1))
        for a in tiny_result.associations
    )
    journey_map = tiny_result.journey_maps[0]
    names = sign_ids(tiny.journeys, blind, journey_map.signs)
    assert len(set(names)) == len(names) == len(journey_map.signs)
    lanes = tiny_result.hd_map.lanes
    assert len(set(lane_ids(tiny.journeys, blind, lanes))) == len(lanes)


def test_a_map_of_nothing_has_no_names(tiny: Dataset, tiny_result: MapResult, every_sign: Signs):
    none = torch.zeros(0, dtype=torch.int64)
    hd_map = as_map(
        tiny,
        every_sign[none],
        tiny_result.hd_map.lanes.select(none),
        every_sign[none],
        tuple(
            Association(torch.full_like(a.sign, -1), a.sign_shift, torch.full_like(a.lane, -1))
            for a in tiny_result.associations
        ),
        torch.zeros(3, 3, dtype=torch.float64),
        {},
    )
    assert hd_map.sign_id == () and hd_map.lane_id == ()
