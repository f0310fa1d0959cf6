from __future__ import annotations

import numpy as np
import pytest

from crowdmap_torch.simulate.markers import STEP_M, Strip, lay_markers
from crowdmap_torch.simulate.roads import RoadShape, open_road


@pytest.fixture(scope="module")
def road():
    """A winding one, with hills."""
    return open_road(RoadShape(), 300.0, np.random.default_rng(2))


STRIPS = (
    Strip("solid", (10.0, 60.0), -3.5),
    Strip("dashed", (20.0, 80.0), 0.0, is_oncoming=True),
    Strip("solid", (100.0, 160.0), -3.5, -9.0),
    Strip("solid", (50.0, 50.0), 0.0, -3.5, crosses=True),
)


@pytest.fixture(scope="module")
def markers(road):
    """One along, one dashed, one that leaves the road, one across it."""
    return lay_markers(road, STRIPS, dash_m=4.0, gap_m=5.0)


def test_points_lie_on_the_road_at_their_offset(road, markers):
    station = markers.station[0] + STEP_M * np.arange(markers.count[0])
    expected = road.surface(station, np.full_like(station, -3.5))
    assert np.abs(markers.points_of(0) - expected).max() < 1e-9


def test_a_marker_that_splits_off_ends_at_its_other_offset(road, markers):
    first, last = markers.points_of(2)[[0, -1]]
    ends = road.surface(np.array([100.0, 160.0]), np.array([-3.5, -9.0]))
    assert np.stack((first, last)) == pytest.approx(ends, abs=1e-9)


def test_a_marker_across_the_road_stays_at_its_station(road, markers):
    assert np.isnan(markers.station[3])
    ends = road.surface(np.array([50.0, 50.0]), np.array([0.0, -3.5]))
    assert markers.points_of(3)[[0, -1]] == pytest.approx(ends, abs=1e-9)


def test_the_dashed_marker_is_painted_four_of_nine_metres(markers):
    parameter = np.arange(0, 54.0, 0.01)
    painted = markers.is_painted(np.full(len(parameter), 1), parameter)
    assert painted.mean() == pytest.approx(4 / 9, abs=1e-3)
    assert painted[:399].all() and not painted[401:899].any()
    assert markers.is_painted(np.zeros(3, int), np.array([-0.1, 25.0, 50.1])).tolist() == [
        *(False, True, False)
    ]


def test_places_between_points_are_on_the_chord(markers):
    point = markers.points_of(0)
    at = markers.at(np.zeros(2, int), np.array([0.0, 1.5 * STEP_M]))
    assert at[0] == pytest.approx(point[0])
    assert at[1] == pytest.approx((point[1] + point[2]) / 2)


def test_no_strips_are_no_markers(road):
    assert len(lay_markers(road, (), dash_m=4.0, gap_m=5.0)) == 0
