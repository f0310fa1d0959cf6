from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from crowdmap_torch.simulate.dataset import make_journey
from crowdmap_torch.simulate.faults import KINDS, POSE_FAULTS, SENSOR_FAULTS, spread_faults


def _journeys(suburb_config, suburb, fleet, fault):
    config = replace(suburb_config, journeys=1)
    good = make_journey(config, suburb, fleet, 0)
    return good, make_journey(config, suburb, fleet, 0, fault)


@pytest.mark.parametrize("fault", KINDS)
def test_a_bad_drive_differs_in_its_fault_and_nothing_else(suburb_config, suburb, fleet, fault):
    good, bad = _journeys(suburb_config, suburb, fleet, fault)
    np.testing.assert_array_equal(good.T_world_link, bad.T_world_link)
    same_poses = np.array_equal(good.T_reported, bad.T_reported)
    same_signs = np.array_equal(good.signs.corners_px, bad.signs.corners_px)
    same_lanes = np.array_equal(good.lanes.px, bad.lanes.px)
    assert same_poses == (fault not in POSE_FAULTS)
    assert same_signs == (fault in POSE_FAULTS)
    assert same_lanes == (fault not in SENSOR_FAULTS)
    R = bad.T_reported[:, :3, :3]
    np.testing.assert_allclose(
        R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-9
    )


def test_jump_is_ten_metres_in_one_place(suburb_config, suburb, fleet):
    good, bad = _journeys(suburb_config, suburb, fleet, "jump")
    error = np.linalg.norm(bad.T_reported[:, :3, 3] - good.T_reported[:, :3, 3], axis=-1)
    assert error[0] == 0 and 8 <= error[-1] <= 12
    assert (np.diff(error) > 1).sum() == 1


def test_frozen_position_stands_and_comes_back(suburb_config, suburb, fleet):
    _, bad = _journeys(suburb_config, suburb, fleet, "frozen-gps")
    still = np.linalg.norm(np.diff(bad.T_reported[:, :3, 3], axis=0), axis=-1) == 0
    assert 0.15 < still.mean() < 0.6 and not still[-50:].any()


def test_faults_are_spread_over_journeys_and_unknown_ones_refused():
    rng = np.random.default_rng(0)
    faults = spread_faults(("jump", "jump", "frozen-gps"), 10, rng)
    assert sorted(f for f in faults if f) == ["frozen-gps", "jump", "jump"]
    with pytest.raises(ValueError, match="expected one of"):
        spread_faults(("flat-tyre",), 10, rng)
    with pytest.raises(ValueError, match="ask for fewer"):
        spread_faults(("jump",) * 3, 2, rng)
