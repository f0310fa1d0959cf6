"""Where signs alone place drives, before their lane pieces are joined."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from crowdmap_torch.adjustment import signs_alone
from crowdmap_torch.adjustment.signs_alone import joined_by_signs, moved_by_signs
from crowdmap_torch.config import MapperConfig
from crowdmap_torch.crowd_lanes.join import JoinedLanes
from crowdmap_torch.crowd_lanes.joined_anew import share_twice
from crowdmap_torch.crowd_signs.completion import AssociatedSigns
from crowdmap_torch.geometry import se3
from crowdmap_torch.mapper import FirstMap, MapResult
from crowdmap_torch.tables import Dataset

Drifts = tuple[Tensor, ...]


def moved(
    tiny: Dataset,
    result: MapResult,
    drifts: Drifts,
    group: list[int],
    first: FirstMap | None = None,
) -> Drifts:
    """What signs make of drifts; those of the first map, if no others are given."""
    first = first or result.first
    completed = first.completed
    found = AssociatedSigns(first.signs, first.tentative, first.associations, completed)
    maps = result.journey_maps
    config, made = MapperConfig(), [m.lanes for m in maps]
    return moved_by_signs(
        *(tiny.journeys, [m.road for m in maps], made, first.crowd, found, drifts),
        *(torch.tensor(group), config.adjust, config.calibration),
    )


def second_beside(tiny: Dataset, result: MapResult, aside: Tensor) -> Drifts:
    """The drives without their biases, the second so far `aside` to the east, from its first frame to its last."""
    drifts = []
    for number, journey in enumerate(tiny.journeys):
        drift = torch.zeros(journey.frame_count, 6, dtype=torch.float64)
        drift[:, :3] -= result.first.crowd.bias.translation[number]
        drifts.append(drift)
    at = torch.linspace(0, len(aside) - 1, len(drifts[1])).long()
    drifts[1][:, 0] += aside[at]
    return tuple(drifts)


@pytest.fixture(scope="module")
def begun(tiny: Dataset, tiny_result: MapResult) -> Drifts:
    """The second drive wanders from side to side, by a metre at most."""
    way = torch.linspace(0, 2 * torch.pi, 100, dtype=torch.float64)
    return second_beside(tiny, tiny_result, way.sin())


def beside(tiny: Dataset, result: MapResult, drifts: Drifts) -> Tensor:
    """How far each drive is from where the finished map has it, in the mean and but for what all are off [m]."""
    given = [journey.T_world_camera for journey in tiny.journeys]
    right = map(se3.local, given, result.poses)
    off = [(d - r)[:, :2] for d, r in zip(drifts, right, strict=True)]
    common = torch.stack([each.mean(0) for each in off]).mean(0)
    return torch.stack([(each - common).norm(dim=1).mean() for each in off])


def test_signs_take_a_drive_back_that_wanders(tiny, tiny_result: MapResult, begun: Drifts):
    found = moved(tiny, tiny_result, begun, [0, 0, 0])
    before, after = (beside(tiny, tiny_result, drifts) for drifts in (begun, found))
    assert float(before[1]) > 0.5
    assert float(after[1]) < 0.2 and float(after.max()) < 0.25


@pytest.mark.parametrize("group", [[0, 0, 0], [0, 1, 0], [2, 0, 1]])
def test_no_group_moves_as_a_whole(tiny, tiny_result: MapResult, begun: Drifts, group: list[int]):
    """How groups lie beside each other lanes have said: signs that are not theirs do not say otherwise."""
    found = moved(tiny, tiny_result, begun, group)
    way = torch.stack([(new - old)[:, :3].mean(0) for new, old in zip(found, begun, strict=True)])
    for one in set(group):
        of_group = way[torch.tensor(group) == one].mean(0)
        torch.testing.assert_close(of_group, torch.zeros(3, dtype=torch.float64))
    assert float((found[1] - begun[1])[:, 0].abs().max()) > 0.5


def test_a_drive_that_shows_no_sign_stays(tiny, tiny_result: MapResult, begun: Drifts):
    first = tiny_result.first
    shown = list(first.associations)
    shown[1] = replace(shown[1], sign=torch.full_like(shown[1].sign, -1))
    found = moved(
        tiny, tiny_result, begun, [0, 0, 0], first=replace(first, associations=tuple(shown))
    )
    assert torch.equal(found[1], begun[1])
    assert not torch.equal(found[0], begun[0])
    none = tuple(replace(each, sign=torch.full_like(each.sign, -1)) for each in shown)
    first = replace(first, associations=none)
    found = moved(tiny, tiny_result, begun, [0, 1, 2], first=first)
    assert all(map(torch.equal, found, begun))


class Joins:
    """Pieces of the tiny world joined, and where signs alone put the drives."""

    def __init__(self, tiny: Dataset, result: MapResult, alone: Drifts | None) -> None:
        self.tiny, self.result, self.alone = tiny, result, alone
        self.asked = 0

    def moved_by_signs(self, *_: object) -> Drifts:
        self.asked += 1
        assert self.alone is not None, "nothing is in doubt"
        return self.alone

    def of(self, drifts: Drifts, doubt_m: float) -> tuple[Drifts, JoinedLanes]:
        first, maps, config = self.result.first, self.result.journey_maps, MapperConfig()
        found = AssociatedSigns(first.signs, first.tentative, first.associations, first.completed)
        given = self.tiny.journeys, [m.road for m in maps], [m.lanes for m in maps]
        rules = replace(config.lane_join, doubt_m=doubt_m), config.adjust, config.calibration
        one = torch.zeros(len(maps), dtype=torch.long)
        return joined_by_signs(*given, first.crowd, found, drifts, one, *rules)


@pytest.fixture(scope="module")
def apart(tiny: Dataset, tiny_result: MapResult) -> Drifts:
    """The second drive goes from the markers on the one side of its own to those on the other."""
    return second_beside(tiny, tiny_result, torch.linspace(-3, 3, 100, dtype=torch.float64))


def test_pieces_are_joined_where_signs_place_drives_that_are_apart(
    tiny, tiny_result: MapResult, apart: Drifts
):
    joins = Joins(tiny, tiny_result, None)
    drifts, joined = joins.of(apart, 0.05)
    before, after = (beside(tiny, tiny_result, each)[1] for each in (apart, drifts))
    assert float(before) > 1.0 and float(after) < 0.2
    lanes = tiny_result.hd_map.lanes
    assert len(joined.lanes) == len(lanes)
    assert share_twice(joined.lanes, 0.45) == 0


def test_pieces_stay_where_they_are_where_that_is_not_in_doubt(
    tiny, tiny_result: MapResult, begun: Drifts, monkeypatch
):
    joins = Joins(tiny, tiny_result, None)
    monkeypatch.setattr(signs_alone, "moved_by_signs", joins.moved_by_signs)
    drifts, joined = joins.of(begun, 1.0)
    assert all(map(torch.equal, drifts, begun)) and joined.report.rms_before_m < 1.0
    assert joins.asked == 0


def test_pieces_stay_where_signs_alone_part_them(
    tiny, tiny_result: MapResult, begun: Drifts, apart: Drifts, monkeypatch
):
    """Where outlines err together for a second, signs take drives from where they are."""
    joins = Joins(tiny, tiny_result, apart)
    monkeypatch.setattr(signs_alone, "moved_by_signs", joins.moved_by_signs)
    right = tuple(map(se3.local, [j.T_world_camera for j in tiny.journeys], tiny_result.poses))
    drifts, joined = joins.of(right, 0.001)
    assert joins.asked == 1 and all(map(torch.equal, drifts, right))
    parted = joins.of(apart, 100.0)[1]
    assert joined.report.samples_per_m > 1.05 * parted.report.samples_per_m
