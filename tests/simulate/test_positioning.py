from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from crowdmap_torch.simulate.positioning import (
    POSITIONING_PRESETS,
    PositioningConfig,
    drive_errors,
    measured_poses,
    pose_errors,
    reported_sigmas,
)

PAPER = POSITIONING_PRESETS["paper"]


def _errors(config: PositioningConfig, draws: int, distance: np.ndarray):
    return [pose_errors(distance, config, np.random.default_rng(k)) for k in range(draws)]


def test_paper_and_consumer_presets_have_the_numbers_of_the_specification():
    assert (PAPER.bias_e_m, PAPER.bias_n_m, PAPER.bias_u_m) == (0.30, 0.30, 0.42)
    assert (PAPER.drift_m, PAPER.drift_length_m) == (0.25, 150.0)
    assert (PAPER.drift_rot_deg, PAPER.drift_rot_length_m) == (0.15, 100.0)
    assert 0.01 <= PAPER.white_e_m <= 0.02 and 0.01 <= PAPER.white_u_m <= 0.02
    assert PAPER.white_rot_deg == 0.02
    assert POSITIONING_PRESETS["consumer"] == replace(
        PAPER, bias_e_m=0.85, bias_n_m=0.85, bias_u_m=1.2
    )


def test_errors_have_the_stated_sigmas_wherever_one_looks():
    """With 1500 draws a standard deviation is known to 2 %; 4 sigma of that is 8 %."""
    errors = _errors(PAPER, 1500, np.array([0.0, 40.0, 300.0]))
    translation = np.array([e.translation for e in errors])
    rotation = np.array([e.rotation for e in errors])
    position, turn = reported_sigmas(PAPER)  # type: ignore[misc]
    for frame in range(3):  # stationary: the same at the start as later
        np.testing.assert_allclose(translation[:, frame].std(0), position, rtol=0.08)
        np.testing.assert_allclose(rotation[:, frame].std(0), turn, rtol=0.08)


def test_drift_forgets_over_its_length():
    only_drift = replace(PAPER, bias_e_m=0, bias_n_m=0, bias_u_m=0)
    only_drift = replace(only_drift, white_e_m=0, white_n_m=0, white_u_m=0)
    errors = _errors(only_drift, 1500, np.array([0.0, 75.0, 150.0]))
    drift = np.array([e.translation for e in errors]).transpose(1, 0, 2).reshape(3, -1)
    correlation = np.corrcoef(drift)
    # 4500 pairs: a correlation is known to 0.015.
    assert correlation[0, 1] == pytest.approx(np.exp(-0.5), abs=0.05)
    assert correlation[0, 2] == pytest.approx(np.exp(-1.0), abs=0.06)


def test_drift_stands_still_with_the_car_while_white_noise_goes_on():
    distance = np.concatenate((np.linspace(0, 30, 40), np.full(400, 30.0)))
    error = pose_errors(distance, PAPER, np.random.default_rng(0))
    standing = error.translation[40:]
    np.testing.assert_allclose(
        standing.std(0), [PAPER.white_e_m, PAPER.white_n_m, PAPER.white_u_m], rtol=0.15
    )
    quiet = replace(PAPER, white_e_m=0, white_n_m=0, white_u_m=0, white_rot_deg=0)
    error = pose_errors(distance, quiet, np.random.default_rng(0))
    assert np.ptp(error.translation[40:], axis=0).max() == 0
    assert np.ptp(error.rotation[40:], axis=0).max() == 0


def test_shared_bias_is_the_same_in_all_journeys():
    shared = replace(PAPER, shared_bias_e_m=2.0, shared_bias_u_m=-1.0)
    distance = np.arange(10.0)
    for seed in range(3):
        own = pose_errors(distance, PAPER, np.random.default_rng(seed))
        with_shared = pose_errors(distance, shared, np.random.default_rng(seed))
        np.testing.assert_allclose(
            with_shared.translation - own.translation, np.tile([2.0, 0, -1.0], (10, 1)), atol=1e-12
        )


def test_sigmas_can_be_wrong_or_missing():
    position, turn = reported_sigmas(PAPER)  # type: ignore[misc]
    wrong, wrong_turn = reported_sigmas(replace(PAPER, sigma_scale=3.0))  # type: ignore[misc]
    np.testing.assert_allclose(wrong, 3 * position)
    assert wrong_turn == pytest.approx(3 * turn)
    assert reported_sigmas(replace(PAPER, sigmas=False)) is None


def test_measured_pose_is_the_true_one_moved_along_world_axes_and_turned_about_its_own():
    T = np.tile(np.eye(4), (2, 1, 1))
    T[:, :3, :3] = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    error = pose_errors(np.array([0.0, 5.0]), PAPER, np.random.default_rng(3))
    measured = measured_poses(T, error)
    np.testing.assert_allclose(measured[:, :3, 3] - T[:, :3, 3], error.translation)
    turn = T[:, :3, :3].transpose(0, 2, 1) @ measured[:, :3, :3]
    # Errors of a few milliradians: the rotation matrix is I + skew(w) up to w^2 / 2, 1e-5.
    np.testing.assert_allclose(turn[:, 2, 1], error.rotation[:, 0], atol=1e-4)
    np.testing.assert_allclose(turn[:, 1, 0], error.rotation[:, 2], atol=1e-4)


def _drift(config: PositioningConfig, draws: int, distance: np.ndarray) -> np.ndarray:
    """The drift alone of many journeys: draw, frame, axis."""
    quiet = {f"{kind}_{axis}_m": 0.0 for kind in ("bias", "white") for axis in "enu"}
    errors = _errors(replace(config, **quiet), draws, distance)
    return np.array([e.translation for e in errors])


@pytest.mark.parametrize("freedom", [0.0, 4.0])
def test_a_smooth_drift_has_the_same_sigma_and_no_rough_steps(freedom: float):
    smooth = replace(PAPER, drift_smooth_m=20.0, drift_freedom=freedom)
    distance = np.array([0.0, 1.0, 40.0, 300.0])
    drift, rough = _drift(smooth, 700, distance), _drift(PAPER, 700, distance)
    # 2100 draws of a normal variable: 1.5 % of a standard deviation; heavier tails are known less well.
    np.testing.assert_allclose(drift.std((0, 2)), PAPER.drift_m, rtol=0.12)
    step, rough_step = (np.diff(d[:, :2], axis=1).std() for d in (drift, rough))
    # Rough: sqrt(2 / 150) of the sigma for a metre; smooth: 1 / sqrt(20 * 150).
    assert rough_step == pytest.approx(PAPER.drift_m * np.sqrt(2 / 150), rel=0.1)
    assert step == pytest.approx(PAPER.drift_m / np.sqrt(20 * 150), rel=0.15)


def test_a_drift_of_few_degrees_of_freedom_takes_large_steps_now_and_then():
    def excess(freedom: float) -> float:
        config = replace(PAPER, drift_smooth_m=10.0, drift_freedom=freedom)
        step = np.diff(_drift(config, 12, np.arange(0.0, 2000.0, 10.0)), axis=1)
        return float((step**4).mean() / (step**2).mean() ** 2 - 3)

    assert abs(excess(0.0)) < 0.3
    assert excess(3.0) > 1.0


def test_tails_without_a_variance_are_refused():
    with pytest.raises(ValueError, match="drift_freedom: expected more than 2"):
        replace(PAPER, drift_freedom=1.5)


def test_an_outage_takes_metres_for_some_hundred_and_comes_back():
    config = replace(PAPER, outages=1.0)
    distance = np.arange(0.0, 1000.0, 0.5)
    for seed in range(20):
        outage = drive_errors(distance, config, np.random.default_rng(seed)).outage
        assert outage is not None
        assert 200 <= outage.to_m - outage.from_m <= 400
        shift = outage.shift(distance)
        inside = (distance > outage.from_m) & (distance < outage.to_m)
        assert np.abs(shift[~inside]).max() < 1e-12
        size = np.linalg.norm(shift, axis=-1)
        assert 0.4 * config.outage_m < size.max() < 2.5 * config.outage_m
        # No jump, and no kink either: half a metre further the slope has changed by a thousandth.
        assert np.linalg.norm(np.diff(shift, axis=0), axis=-1).max() < 0.06
        assert np.linalg.norm(np.diff(shift, 2, axis=0), axis=-1).max() < 1.5e-3


def test_outages_come_as_often_as_asked_for_and_fit_into_short_drives():
    config = replace(PAPER, outages=0.1)
    drawn = [
        drive_errors(np.array([0.0, 100.0]), config, np.random.default_rng(k)) for k in range(2000)
    ]
    outages = [d.outage for d in drawn if d.outage is not None]
    assert len(outages) / 2000 == pytest.approx(0.1, abs=0.03)
    assert all(0 <= o.from_m and o.to_m <= 100 and o.to_m - o.from_m <= 60 + 1e-9 for o in outages)


def test_stated_sigmas_are_off_by_a_factor_either_way():
    config = replace(PAPER, sigma_spread=1.5)
    drawn = [
        drive_errors(np.array([0.0, 100.0]), config, np.random.default_rng(k)) for k in range(500)
    ]
    logs = np.log([d.sigma_factor for d in drawn]) / np.log(1.5)
    assert logs.min() >= -1 and logs.max() <= 1
    # Uniform from -1 to 1: 1-sigma of 0.577.
    assert logs.mean() == pytest.approx(0.0, abs=0.1) and logs.std() == pytest.approx(
        0.577, abs=0.05
    )
    position, turn = reported_sigmas(config)  # type: ignore[misc]
    off, off_turn = reported_sigmas(config, drawn[0])  # type: ignore[misc]
    np.testing.assert_allclose(off, drawn[0].sigma_factor * position)
    assert off_turn == pytest.approx(drawn[0].sigma_factor * turn)


def test_a_bias_that_wanders_has_its_sigma_and_forgets_itself_over_its_length():
    config = replace(PAPER, bias_wander_m=1.0)
    distance = np.array([0.0, 3000.0, 20000.0])
    drawn = [drive_errors(distance, config, np.random.default_rng(k)).wander for k in range(600)]
    away = np.array([wander.shift(distance) for wander in drawn if wander is not None])
    assert len(away) == 600
    # Of 1,800 numbers a standard deviation is known to 2 %, a correlation to 0.03.
    np.testing.assert_allclose(away.std((0, 2)), 1.0, rtol=0.08)
    np.testing.assert_allclose((away[:, 0] * away[:, 1]).mean(), np.exp(-1), atol=0.1)
    np.testing.assert_allclose((away[:, 0] * away[:, 2]).mean(), 0.0, atol=0.1)
    position, _ = reported_sigmas(config)  # type: ignore[misc]
    plain, _ = reported_sigmas(PAPER)  # type: ignore[misc]
    np.testing.assert_allclose(position**2, plain**2 + 1.0)


def test_positions_leap_as_often_and_as_far_as_they_are_told():
    config = replace(PAPER, leaps_per_km=2.0, leap_m=1.5)
    distance = np.linspace(0.0, 2000.0, 4001)
    drawn = [drive_errors(distance, config, np.random.default_rng(k)).leaps for k in range(400)]
    leaps = [leap for leap in drawn if leap is not None]
    assert len(leaps) == 400
    # 1,600 of them: their number is known to 2.5 %, their sigma to 1.
    assert np.mean([len(leap.at_m) for leap in leaps]) == pytest.approx(4.0, rel=0.1)
    assert np.concatenate([leap.by_m for leap in leaps if leap.by_m]).std() == pytest.approx(
        1.5, rel=0.05
    )
    one = next(leap for leap in leaps if len(leap.at_m) == 3)
    step = np.diff(one.shift(distance), axis=0)
    at = np.flatnonzero(np.abs(step).sum(-1))
    np.testing.assert_allclose(distance[at], one.at_m, atol=0.5)
    np.testing.assert_allclose(step[at], one.by_m)
    assert not one.shift(distance[:1]).any()


def test_poses_freeze_as_often_and_as_long_as_they_are_told():
    config = replace(PAPER, freezes_per_km=2.0, freeze_s=1.5)
    distance = np.linspace(0.0, 2000.0, 2001)
    t = distance / 10.0
    drawn = [drive_errors(distance, config, np.random.default_rng(k)).freezes for k in range(400)]
    freezes = [freeze for freeze in drawn if freeze is not None]
    assert np.mean([len(freeze.at_m) for freeze in freezes]) == pytest.approx(4.0, rel=0.1)
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, 0, 3] = distance
    one = next(f for f in freezes if len(f.at_m) == 2 and f.at_m[1] - f.at_m[0] > 50 < f.at_m[0])
    held = one.held(T, distance, t)
    # Every 0.1 s a frame: 15 behind each that is held.
    rows = np.ceil(one.at_m).astype(int)[:, None] + np.arange(1, 16)
    assert np.flatnonzero(held[:, 0, 3] != distance).tolist() == rows.ravel().tolist()
    assert (held[rows, 0, 3] == np.ceil(one.at_m)[:, None]).all()


def test_positions_are_noisy_as_often_and_as_long_as_they_are_told():
    config = replace(PAPER, bursts_per_km=2.0, burst_m=0.4, burst_s=1.5)
    distance = np.linspace(0.0, 2000.0, 2001)
    t = distance / 10.0
    drawn = [drive_errors(distance, config, np.random.default_rng(k)).bursts for k in range(400)]
    bursts = [burst for burst in drawn if burst is not None]
    assert np.mean([len(burst.at_m) for burst in bursts]) == pytest.approx(4.0, rel=0.1)
    one = next(b for b in bursts if len(b.at_m) == 2 and b.at_m[1] - b.at_m[0] > 50)
    noise = np.array([one.noise(distance, t, np.random.default_rng(k)) for k in range(200)])
    # Every 0.1 s a frame: 15 of them each time.
    rows = np.ceil(one.at_m).astype(int)[:, None] + np.arange(15)
    rows = rows[rows < len(t)]
    assert np.flatnonzero(noise.any((0, 2))).tolist() == rows.tolist()
    assert noise[:, rows].std() == pytest.approx(0.4, rel=0.05)


def test_what_else_is_drawn_of_a_drive_does_not_depend_on_whether_its_position_leaps():
    config = replace(PAPER, outages=1.0, bias_wander_m=1.0)
    distance = np.array([0.0, 2500.0])
    still, leaping = (
        drive_errors(distance, c, np.random.default_rng(4))
        for c in (config, replace(config, leaps_per_km=4.0, freezes_per_km=2.0, bursts_per_km=2.0))
    )
    assert still.leaps is None and leaping.leaps is not None and leaping.freezes is not None
    assert leaping.bursts is not None
    assert replace(leaping, leaps=None, freezes=None, bursts=None) == still


def test_what_else_is_drawn_of_a_drive_does_not_depend_on_whether_its_bias_wanders():
    config = replace(PAPER, outages=1.0, sigma_spread=1.5)
    distance = np.array([0.0, 2500.0])
    still, wandering = (
        drive_errors(distance, c, np.random.default_rng(4))
        for c in (config, replace(config, bias_wander_m=1.0))
    )
    assert still.wander is None and replace(wandering, wander=None) == still
    assert still.outage is not None and wandering.wander is not None
    both = wandering.shift(distance) - still.shift(distance)
    np.testing.assert_allclose(both, wandering.wander.shift(distance))
