from __future__ import annotations

from dataclasses import replace

import torch
from worlds.marked_roads import two_way_road

from crowdmap_torch.io.formats.exporters.carriageways import carriageways
from crowdmap_torch.io.formats.exporters.features import lane_points
from crowdmap_torch.io.formats.exporters.sign_lanes import lanes_of_signs


def test_signs_are_for_the_lanes_that_they_face():
    road = two_way_road()
    ways = carriageways(lane_points(road.lanes))
    stop, back, unknown, far = lanes_of_signs(road.signs, ways)
    assert far == []
    for cells, right, count in ((stop, {3, 4}, 2), (unknown, {3, 4}, 2), (back, {0}, 1)):
        assert len(cells) == count
        assert {ways.borders[ways.cells[c].right].piece for c in cells} == right


def test_without_lanes_signs_are_for_none():
    road = two_way_road()
    lone = replace(road, lanes=road.lanes.select(torch.tensor([4])))
    ways = carriageways(lane_points(lone.lanes))
    assert lanes_of_signs(road.signs, ways) == [[], [], [], []]
