"""A car that drives, stops and goes on."""

from __future__ import annotations

import torch
from torch import Tensor

from crowdmap_torch.geometry import se3

F64 = torch.float64


def driven(rate_hz: float, seconds: float, seed: int) -> tuple[Tensor, Tensor]:
    """Poses and times of a car that brakes, stands, goes on and turns, with 2 cm of white noise."""
    t = torch.arange(round(rate_hz * seconds), dtype=F64) / rate_hz
    # A stop in the middle, braked for and left at 3 m/s^2.
    speed = (3 * ((t - seconds / 2).abs() - 3.0)).clamp(0.0, 12.0)
    way = torch.cumsum(speed / rate_hz, 0)
    heading = 0.5 * torch.sin(way / 40.0)
    step = speed[:, None] / rate_hz * torch.stack((heading.cos(), heading.sin(), 0 * t), -1)
    noise = 0.02 * torch.randn(len(t), 3, dtype=F64, generator=torch.Generator().manual_seed(seed))
    turn = torch.stack((0 * t, 0 * t, heading), -1)
    T = se3.make(se3.so3_exp(turn), torch.cumsum(step, 0) + noise)
    return T, (1e9 * t).round().long()
