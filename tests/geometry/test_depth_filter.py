"""The depth filter against a simulated approach, plain geometry and numerical derivatives."""

from __future__ import annotations

import numpy as np
import pytest

from crowdmap_torch.geometry import depth_filter
from crowdmap_torch.geometry.depth_filter import DepthState

VARIANCE = np.array([[1e-3, 1e-3, 0.05]]) ** 2
EXACT = {"variance_position": np.zeros(1), "variance_rotation": np.zeros(1)}


def sighting(p: np.ndarray, height: float) -> np.ndarray:
    """What an upright thing of this height at camera-frame point p looks like."""
    return np.array([[p[0] / p[2], p[1] / p[2], np.log(height / p[2])]])


def start(p: np.ndarray, height: float) -> DepthState:
    return depth_filter.initial(
        sighting(p, height), VARIANCE, log_height=np.log(0.75), sigma_log_height=0.7
    )


def test_a_new_thing_is_as_high_as_things_are_usually():
    state = start(np.array([2.0, -1.0, 30.0]), 0.75)
    assert np.exp(-state.mean[0, 2]) == pytest.approx(30.0)
    # Depth and height are unsure together: what was seen is not.
    spread = state.covariance[0, 2:, 2:].sum()
    assert spread == pytest.approx(VARIANCE[0, 2])


def test_prediction_is_the_rigid_motion():
    p = np.array([2.0, -1.0, 30.0])
    angle = 0.1
    R = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    t = np.array([0.3, 0.0, -2.0])
    later = R @ p + t
    predicted = depth_filter.predict(start(p, 0.75), R[None], t[None], **EXACT)
    np.testing.assert_allclose(predicted.expected, sighting(later, 0.75), atol=1e-12)
    np.testing.assert_allclose(predicted.depth, later[2:], atol=1e-9)


def test_covariance_follows_the_numerical_derivative():
    p, R = np.array([2.0, -1.0, 30.0]), np.eye(3)[None]
    t = np.array([[0.2, 0.1, -3.0]])
    state = start(p, 0.9)
    J = np.empty((4, 4))
    for k in range(4):
        step = 1e-6 * np.eye(4)[k]
        ends = [
            depth_filter.predict(DepthState(state.mean + s * step, state.covariance), R, t, **EXACT)
            for s in (1, -1)
        ]
        J[:, k] = (ends[0].state.mean[0] - ends[1].state.mean[0]) / 2e-6
    predicted = depth_filter.predict(state, R, t, **EXACT)
    np.testing.assert_allclose(
        predicted.state.covariance[0], J @ state.covariance[0] @ J.T, rtol=1e-6, atol=1e-12
    )


def test_without_motion_the_place_is_sure_and_with_motion_the_depth_is_open():
    state = start(np.array([3.0, -1.0, 30.0]), 0.75)
    still = depth_filter.predict(state, np.eye(3)[None], np.zeros((1, 3)), **EXACT)
    moved = depth_filter.predict(state, np.eye(3)[None], np.array([[0.0, 0, -10.0]]), **EXACT)
    np.testing.assert_allclose(still.spread[0, :2, :2], np.diag(VARIANCE[0, :2]), atol=1e-12)
    along = np.array([3.0, -1.0]) / np.hypot(3.0, 1.0)
    across = np.array([1.0, 3.0]) / np.hypot(3.0, 1.0)
    # Bearings change along the epipolar line only.
    assert along @ moved.spread[0, :2, :2] @ along > 100 * VARIANCE[0, 0]
    assert across @ moved.spread[0, :2, :2] @ across < 3 * VARIANCE[0, 0]


def test_an_approach_finds_depth_and_height():
    p, height = np.array([4.0, -1.5, 60.0]), 1.5
    state = start(p, height)
    for _ in range(40):
        p = p + np.array([0.0, 0.0, -1.0])
        prediction = depth_filter.predict(
            state, np.eye(3)[None], np.array([[0.0, 0.0, -1.0]]), **EXACT
        )
        state = depth_filter.update(prediction, sighting(p, height), VARIANCE, trusted=3.0)
    assert np.exp(-state.mean[0, 2]) == pytest.approx(p[2], rel=0.01)
    assert np.exp(state.mean[0, 3]) == pytest.approx(height, rel=0.01)
    assert np.linalg.eigvalsh(state.covariance[0]).min() > 0


def test_things_behind_the_camera_are_infinitely_far():
    state = start(np.array([1.0, 0.0, 5.0]), 0.75)
    behind = depth_filter.predict(state, np.eye(3)[None], np.array([[0.0, 0.0, -8.0]]), **EXACT)
    assert behind.depth[0] == 0
    innovation = depth_filter.innovation(behind, sighting(np.array([1.0, 0, 5.0]), 0.75), VARIANCE)
    assert np.isinf(innovation.distance_sq).all()


def test_an_outlier_moves_the_estimate_no_more_than_a_trusted_sighting():
    state = start(np.array([3.0, -1.0, 30.0]), 0.75)
    prediction = depth_filter.predict(state, np.eye(3)[None], np.zeros((1, 3)), **EXACT)
    sigma = np.sqrt(prediction.spread[0, 0, 0] + VARIANCE[0, 0])
    moves = []
    for sigmas in (3.0, 300.0):
        z = prediction.expected + np.array([[sigmas * sigma, 0.0, 0.0]])
        updated = depth_filter.update(prediction, z, VARIANCE, trusted=3.0)
        moves.append(abs(updated.mean[0, 0] - state.mean[0, 0]))
    assert moves[1] < moves[0]


def test_a_vague_prediction_is_told_from_a_sharp_one():
    z = sighting(np.array([3.0, -1.0, 30.0]), 0.75)
    sharp = start(np.array([3.0, -1.0, 30.0]), 0.75)
    vague = DepthState(sharp.mean, 50 * sharp.covariance)
    found = [
        depth_filter.innovation(
            depth_filter.predict(s, np.eye(3)[None], np.zeros((1, 3)), **EXACT), z, VARIANCE
        ).vagueness
        for s in (sharp, vague)
    ]
    assert found[1] > found[0] > 0
