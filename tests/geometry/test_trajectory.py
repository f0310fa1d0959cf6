"""The way along a trajectory."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from crowdmap_torch.geometry import se3, trajectory
from crowdmap_torch.geometry.trajectory import motion, passes, station

F64 = torch.float64


def at(position: Tensor) -> Tensor:
    """Poses at places [f, 3], turned anyhow."""
    return se3.make(se3.so3_exp(0.1 * position), position)


def test_way_at_constant_speed_is_the_distance():
    place = torch.arange(50, dtype=F64)[:, None] * torch.tensor([0.6, 0.8, 0.0], dtype=F64)
    torch.testing.assert_close(station(at(place)), torch.arange(50, dtype=F64))


def test_noise_makes_no_way_where_it_would_sum_up(generator):
    noise = 0.02 * torch.randn(400, 3, dtype=F64, generator=generator)
    summed = noise.diff(dim=0).norm(dim=-1).sum()
    # Positions 14 frames apart: a fourteenth of the way that neighbours make.
    assert float(station(at(noise))[-1]) < float(summed) / 10


def test_way_never_falls_and_does_not_depend_on_the_world(generator):
    place = torch.randn(80, 3, dtype=F64, generator=generator).cumsum(0)
    T_there_world = se3.exp(torch.tensor([50.0, -30.0, 4.0, 0.2, -0.3, 2.0], dtype=F64))
    way = station(at(place))
    assert bool((way.diff() >= 0).all()) and float(way[0]) == 0.0
    torch.testing.assert_close(station(T_there_world @ at(place)), way)


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_few_frames(frames):
    place = torch.arange(frames, dtype=F64)[:, None].expand(frames, 3)
    way = station(at(place))
    assert way.shape == (frames,)
    assert way.tolist() == pytest.approx([3**0.5 * k for k in range(frames)])


def lap(length_m: float) -> torch.Tensor:
    """Poses every metre along a round of 400 m."""
    angle = torch.arange(int(length_m), dtype=F64) * (2 * torch.pi / 400)
    place = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), dim=-1)
    return at(400 / (2 * torch.pi) * place)


def test_a_trajectory_that_comes_back_is_cut_where_it_does():
    T = lap(1000)
    found = passes(T)
    assert [piece.start for piece in found] == [0, *(piece.stop for piece in found[:-1])]
    assert found[-1].stop == len(T)
    # 15 m before a round is full, to a metre: ways are smoothed at their ends.
    assert len(found) == 3
    assert all(abs(piece.stop - piece.start - 386) <= 2 for piece in found[:-1])
    for piece in found:
        place, way = T[piece, :2, 3], station(T)[piece]
        near = (place[:, None] - place).norm(dim=-1) < 15
        assert float((way[:, None] - way).abs()[near].max()) <= 50


def test_a_car_that_stands_does_not_come_back():
    place = torch.zeros(300, 3, dtype=F64)
    place[:100, 0] = torch.arange(100)
    place[100:, 0] = 99
    assert passes(at(place)) == [slice(0, 300)]
    assert passes(at(place[:1])) == [slice(0, 1)]


def times(seconds: Tensor) -> Tensor:
    return (seconds * 1e9).long()


def test_motion_is_that_of_a_smooth_drive_whenever_its_pictures_are_taken(generator):
    t = torch.rand(200, dtype=F64, generator=generator).sort().values * 8
    place = torch.stack((10 * t + t**2 / 2, 2 * t - t**3 / 30, 0.1 * t), dim=-1)
    heading = torch.zeros_like(place)
    heading[:, 1] = 0.3 * t - 0.02 * t**2
    velocity, turning = motion(se3.make(se3.so3_exp(heading), place), times(t))
    expected = torch.stack((10 + t, 2 - t**2 / 10, torch.full_like(t, 0.1)), dim=-1)
    torch.testing.assert_close(velocity, expected, rtol=0, atol=0.1)
    # At the ends cubics are held back a little: there they know one side only.
    torch.testing.assert_close(velocity[40:-40], expected[40:-40], rtol=0, atol=5e-3)
    torch.testing.assert_close(turning[:, 1], 0.3 - 0.04 * t, rtol=0, atol=2e-3)


def test_noise_of_poses_is_little_of_their_motion(generator):
    # What a delay is found by: were velocities noisy, it would be found too small by as much.
    t = torch.arange(450, dtype=F64) / 15
    place = torch.stack((12 * t, torch.zeros_like(t), torch.zeros_like(t)), dim=-1)
    noise = 0.05 * torch.randn(450, 3, dtype=F64, generator=generator)
    velocity, _ = motion(se3.make(se3.so3_exp(0 * place), place + noise), times(t))
    off = (velocity - torch.tensor([12.0, 0.0, 0.0], dtype=F64))[25:-25]
    assert float(off.std()) < 0.03


def test_motion_of_a_long_drive_is_found_in_pieces(generator, monkeypatch):
    t = torch.arange(100, dtype=F64) / 10
    T = at(torch.randn(100, 3, dtype=F64, generator=generator).cumsum(0))
    whole = motion(T, times(t))
    monkeypatch.setattr(trajectory, "_AT_ONCE", 200)
    for part, of_whole in zip(motion(T, times(t)), whole, strict=True):
        torch.testing.assert_close(part, of_whole)


def test_motion_over_gaps_and_of_few_frames():
    t = torch.tensor([0.0, 0.1, 0.2, 60.0, 60.1, 60.2], dtype=F64)
    place = torch.stack((10 * t, 0 * t, 0 * t), dim=-1)
    place[3:, 0] -= 400.0
    velocity, _ = motion(se3.make(se3.so3_exp(0 * place), place), times(t))
    torch.testing.assert_close(velocity[:, 0], torch.full((6,), 10.0, dtype=F64), rtol=0, atol=0.05)
    for frames in (0, 1):
        T = se3.make(se3.so3_exp(0 * place[:frames]), place[:frames])
        assert [part.shape for part in motion(T, times(t[:frames]))] == [(frames, 3), (frames, 3)]
