from __future__ import annotations

import numpy as np
from worlds.marked_roads import bend, line, two_way_road

from crowdmap_torch.io.formats.exporters.carriageways import carriageways
from crowdmap_torch.io.formats.exporters.features import lane_points
from crowdmap_torch.io.formats.exporters.roads import roads


def test_borders_stand_from_left_to_right():
    for pieces in (lane_points(two_way_road().lanes), [bend(40, 100, a) for a in (0, 3.2, -3.2)]):
        for road in roads(carriageways(pieces)):
            assert (np.diff(road.aside, axis=0) < -2).all()
            guide = road.border.index(road.guide)
            np.testing.assert_allclose(road.aside[guide], 0, atol=2e-3)


def test_traffic_that_keeps_left_is_known():
    ways = carriageways(
        [line((0, 3.5), (80, 3.5)), line((0, 0), (80, 0)), line((80, -3.5), (0, -3.5))]
    )
    (road,) = roads(ways)
    assert road.is_left_hand and road.middle == 1
    assert not roads(carriageways(lane_points(two_way_road().lanes)))[0].is_left_hand


def test_roads_tilt_as_their_markers_do():
    (road,) = roads(carriageways([bend(60, 90, a) for a in (0, 3.5, -3.5)]))
    # The bend falls by 3 % to the left.
    np.testing.assert_allclose(np.tan(road.tilt), -0.03, atol=2e-3)
