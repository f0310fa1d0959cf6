from __future__ import annotations

import numpy as np
import pytest
from worlds.marked_roads import bend, line, two_way_road

from crowdmap_torch.io.formats.exporters.carriageways import carriageways
from crowdmap_torch.io.formats.exporters.features import lane_points
from crowdmap_torch.io.formats.exporters.roads import roads


def test_borders_stand_from_left_to_right():
    for pieces in (lane_points(two_way_road().lanes), [bend(40, 100, a) for a in (0, 3.2, -3.2)]):
        for road in roads(carriageways(pieces)):
            for section in road.section:
                assert (np.diff(section.aside, axis=0) < -2).all()
                guide = section.border.index(road.guide)
                np.testing.assert_allclose(section.aside[guide], 0, atol=2e-3)


def test_sections_follow_one_another_along_the_whole_road():
    ragged = [bend(60, 100, aside)[cut:-9] for aside, cut in ((0, 1), (-3.4, 3), (-6.8, 7))]
    (road,) = roads(carriageways(ragged))
    assert len(road.section) > 1
    places = [section.s[0] for section in road.section]
    assert places == [0.0, *(section.s[-1] for section in road.section[:-1])]
    assert road.section[-1].s[-1] == road.line.length
    # A lane is there where both its borders are.
    starts = [span[0] for span in road.span if span]
    assert max(starts) - min(starts) == pytest.approx(4, abs=1.1)


def test_traffic_that_keeps_left_is_known():
    ways = carriageways(
        [line((0, 3.5), (80, 3.5)), line((0, 0), (80, 0)), line((80, -3.5), (0, -3.5))]
    )
    (road,) = roads(ways)
    assert road.is_left_hand and road.section[0].middle == 1
    assert not roads(carriageways(lane_points(two_way_road().lanes)))[0].is_left_hand


def test_roads_tilt_as_their_markers_do():
    (road,) = roads(carriageways([bend(60, 90, a) for a in (0, 3.5, -3.5)]))
    # The bend falls by 3 % to the left.
    np.testing.assert_allclose(np.tan(road.tilt), -0.03, atol=2e-3)
