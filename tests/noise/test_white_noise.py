"""The noise of positions from frame to frame, found by what no car does."""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from worlds.drives import make_journey
from worlds.sign_drive import RIG, straight_poses

from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.noise.white_noise import WhiteNoise, white_noise_along, with_white_noise

GIVEN = PositioningNoise()


def drive(frames: int, *, rate_hz: float = 10.0, seed: int = 0, noise_m=(0.0, 0.0, 0.0)):
    """Times and positions of a car that turns, brakes and goes on, whose frames do not come quite regularly."""
    rng = np.random.default_rng(seed)
    t = np.arange(frames) / rate_hz + 0.1 / rate_hz * rng.random(frames)
    speed, turning = 10 + 5 * np.sin(0.4 * t), 0.3 * np.sin(0.3 * t)
    heading = np.cumsum(turning) / rate_hz
    velocity = speed[:, None] * np.stack((np.cos(heading), np.sin(heading), 0 * t), axis=1)
    # The way between frames, as trapezoids have it.
    ways = (velocity[1:] + velocity[:-1]) / 2 * np.diff(t)[:, None]
    position = np.concatenate((np.zeros((1, 3)), np.cumsum(ways, axis=0)))
    noise = np.array(noise_m) * rng.standard_normal((frames, 3))
    return (1e9 * t).astype(np.int64), position + noise


def with_walk(position, sigma_m: float, seed: int = 0):
    """The positions with a random walk of so much over one metre."""
    rng = np.random.default_rng(seed)
    way = np.linalg.norm(np.diff(position, axis=0), axis=1)
    steps = sigma_m * np.sqrt(way)[:, None] * rng.standard_normal((len(way), 3))
    return position + np.concatenate((np.zeros((1, 3)), np.cumsum(steps, axis=0)))


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 30.0])
def test_a_car_that_turns_and_brakes_has_no_noise(rate_hz: float):
    t_ns, position = drive(400, rate_hz=rate_hz)
    assert (WhiteNoise(GIVEN).follow(t_ns, position) == GIVEN.white_sigma_m).all()


@pytest.mark.parametrize("rate_hz", [5.0, 30.0])
@pytest.mark.parametrize("noise_m", [(0.1, 0.1, 0.1), (0.03, 0.15, 0.05)])
@pytest.mark.parametrize("seed", [0, 1])
def test_noise_is_found_within_some_frames(rate_hz: float, noise_m, seed: int):
    t_ns, position = drive(600, rate_hz=rate_hz, seed=seed, noise_m=noise_m)
    sigma = WhiteNoise(GIVEN).follow(t_ns, position)
    true = math.sqrt(sum(s * s for s in noise_m) / 3)
    assert sigma[40] > 0.6 * true
    assert sigma[200:] == pytest.approx(true, rel=0.3)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_what_is_usual_changes_nothing(seed: int):
    t_ns, position = drive(2000, seed=seed, noise_m=(GIVEN.white_sigma_m,) * 3)
    sigma = WhiteNoise(GIVEN).follow(t_ns, with_walk(position, GIVEN.walk_m))
    assert np.median(sigma) == GIVEN.white_sigma_m
    assert sigma.max() < 1.3 * GIVEN.white_sigma_m


def test_a_leap_is_no_noise_and_positions_that_leap_all_the_time_are_some_at_most():
    t_ns, position = drive(400)
    position[200:] += 3.0
    assert WhiteNoise(GIVEN).follow(t_ns, position).max() < 1.5 * GIVEN.white_sigma_m
    standing = position[np.arange(400) // 2 * 2]
    assert WhiteNoise(GIVEN).follow(t_ns, standing)[-1] == 10 * GIVEN.white_sigma_m


def test_a_car_that_stands_tells_nothing_of_how_it_drives():
    t_ns, position = drive(300, noise_m=(0.1, 0.1, 0.1))
    held = np.broadcast_to(position[199], (600, 3))
    t_held = t_ns[199] + 100_000_000 * np.arange(1, 601)
    noise = WhiteNoise(GIVEN)
    before = noise.follow(t_ns[:200], position[:200])[-1]
    standing = noise.follow(t_held, held)
    assert (standing[5:] == standing[-1]).all() and standing[-1] == pytest.approx(before, rel=0.1)


def test_a_journey_is_mapped_by_what_it_shows_in_most_of_its_frames():
    t_ns, position = drive(600, noise_m=(0.1, 0.1, 0.1))
    position[400:] = drive(600)[1][400:] + position[399] - drive(600)[1][399]
    journey = make_journey(RIG, straight_poses(600))
    T = journey.T_world_camera.clone()
    T[:, :3, 3] = torch.from_numpy(position)
    journey = replace(journey, T_world_camera=T, t_ns=torch.from_numpy(t_ns))
    along = white_noise_along(journey, GIVEN)
    mapped_by = with_white_noise(GIVEN, journey).white_sigma_m
    assert mapped_by == pytest.approx(0.1, rel=0.3) and 1.3 * along[-1] < mapped_by


def test_frames_far_apart_tell_nothing():
    t_ns, position = drive(100, noise_m=(0.2, 0.2, 0.2))
    assert (WhiteNoise(GIVEN).follow(10 * t_ns, position) == GIVEN.white_sigma_m).all()


def test_frame_by_frame_it_is_the_same_to_the_last_bit_and_a_copy_goes_on():
    t_ns, position = drive(90, noise_m=(0.1, 0.05, 0.02))
    whole = WhiteNoise(GIVEN).follow(t_ns, position)
    one_by_one = WhiteNoise(GIVEN)
    for at in range(90):
        if at == 50:
            one_by_one = copy.deepcopy(one_by_one)
        (now,) = one_by_one.follow(t_ns[at : at + 1], position[at : at + 1])
        assert now == whole[at] == one_by_one.sigma_m


def test_no_noise_as_configured_stays_none():
    t_ns, position = drive(50, noise_m=(0.1, 0.1, 0.1))
    none = PositioningNoise(white_sigma_m=0.0)
    assert (WhiteNoise(none).follow(t_ns, position) == 0).all()
