"""Positions of the last fix are told from cars that drive, stand and crawl."""

from __future__ import annotations

import numpy as np
import pytest

from crowdmap_torch.plausibility.held import held_frames


def driven(speed_mps: np.ndarray, rate_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and places of a car with these speeds between its frames."""
    way = np.concatenate(([0.0], np.cumsum(speed_mps / rate_hz)))
    turn = way / 200.0
    place = np.stack((200.0 * np.sin(turn), 200.0 * (1 - np.cos(turn)), 0.01 * way), -1)
    return np.arange(len(way)) / rate_hz, place


def stop_and_go(rate_hz: float) -> np.ndarray:
    """12 m/s, a light at which the car stands for 20 s, and on."""
    n = round(rate_hz)
    brakes = np.linspace(12.0, 0.0, 4 * n)
    parts = (np.full(20 * n, 12.0), brakes, np.zeros(20 * n), brakes[::-1], np.full(20 * n, 12.0))
    return np.concatenate(parts)


def joined_by_last(t: np.ndarray, place: np.ndarray, fixes_hz: float) -> np.ndarray:
    """For each frame the row of the last one that has a fix."""
    number = np.floor(t * fixes_hz + 1e-9)
    return np.searchsorted(number, number)


@pytest.mark.parametrize("rate_hz", [5.0, 15.0, 60.0])
@pytest.mark.parametrize("fixes_hz", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_frames_between_fixes_are_found_but_for_those_of_a_car_that_stands(
    rate_hz: float, fixes_hz: float, unit: float
) -> None:
    t, place = driven(stop_and_go(rate_hz), rate_hz)
    row = joined_by_last(t, place, fixes_hz)
    is_held = held_frames(1e9 * t, unit * place[row])
    is_between = row != np.arange(len(t))
    # It stands from 24 to 44 s; when it goes on is not seen before the next fix.
    drives = (t < 23.0) | (t > 45.0)
    assert np.array_equal(is_held[drives], is_between[drives])
    assert not is_held[(t > 26.0) & (t < 42.0)].any()


@pytest.mark.parametrize("rate_hz", [2.0, 15.0, 60.0])
def test_cars_that_drive_and_stand_hold_nothing(rate_hz: float) -> None:
    t, place = driven(stop_and_go(rate_hz), rate_hz)
    assert not held_frames(t, place).any()
    # Nor does a dropped frame now and then, that a reader filled with the one before.
    place[100::50] = place[99:-1:50]
    assert not held_frames(t, place).any()


def test_a_car_that_crawls_by_rounded_positions_holds_nothing() -> None:
    t, place = driven(np.concatenate((np.full(400, 12.0), np.full(150, 0.8))), 15.0)
    assert (np.diff(np.round(place, 1), axis=0) == 0).all(-1).any()
    assert not held_frames(t, np.round(place, 1)).any()


@pytest.mark.parametrize("frames", [0, 1, 3, 40])
def test_too_little_tells_nothing(frames: int) -> None:
    t = np.arange(frames) / 10.0
    assert not held_frames(t, np.zeros((frames, 3))).any()
    assert not held_frames(t, np.stack((t // 2, 0 * t, 0 * t), -1)).any()


def test_places_through_a_mount_and_back_are_still_the_same() -> None:
    t, place = driven(stop_and_go(15.0), 15.0)
    row = joined_by_last(t, place, 3.0)
    noise = 1e-12 * np.random.default_rng(0).standard_normal(place.shape)
    held, noisy = held_frames(t, place[row]), held_frames(t, place[row] + noise)
    assert held.any()
    assert np.array_equal(held, noisy)
