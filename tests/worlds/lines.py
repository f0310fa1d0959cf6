"""Samples of lines and curves through points, for the tests of the lane markers of many drives."""

from __future__ import annotations

import torch
from torch import Tensor

from crowdmap_torch.crowd_lanes.density_ridge import (
    RidgeConfig,
    RidgePoints,
    seed_points,
    shift_to_ridges,
)
from crowdmap_torch.crowd_lanes.line_samples import LineSamples
from crowdmap_torch.crowd_lanes.splines import Curves, curves_through


def straight(
    offsets: list[float], *, kind: list[int] | None = None, turned: list[int] | None = None
) -> LineSamples:
    """One owner with one straight line of 40 m along x for each offset."""
    s = torch.arange(0.0, 40.5, 1.0, dtype=torch.float64)
    n, k = len(s), len(offsets)
    owner = torch.arange(k).repeat_interleave(n)
    y = torch.tensor(offsets, dtype=torch.float64).repeat_interleave(n)
    sign = torch.tensor([-1.0 if i in (turned or []) else 1.0 for i in range(k)])
    direction = torch.stack((sign, torch.zeros(k)), 1).repeat_interleave(n, 0).double()
    return LineSamples(
        point=torch.stack((s.repeat(k), y, torch.zeros(n * k, dtype=torch.float64)), 1),
        direction=direction,
        slope=torch.zeros(n * k, dtype=torch.float64),
        kind=torch.tensor(kind or [-1] * k).repeat_interleave(n),
        track=owner,
        owner=owner,
        weight=torch.ones(n * k, dtype=torch.float64),
    )


def ridges(samples: LineSamples, bandwidth: float = 0.2) -> RidgePoints:
    """Points that have climbed to the ridges of the samples."""
    config = RidgeConfig(bandwidth=bandwidth)
    return shift_to_ridges(seed_points(samples, config, 4), samples, config, iterations=30)


def arc(radius: float, length: float, spacing: float = 1.0) -> tuple[Tensor, Tensor]:
    """Points and directions along an arc that starts at the origin heading east, climbing by 3 %."""
    s = torch.arange(0, length + 0.1, spacing, dtype=torch.float64)
    a = s / radius
    point = torch.stack((radius * a.sin(), radius * (1 - a.cos()), 0.03 * s), 1)
    return point, torch.stack((a.cos(), a.sin()), 1)


def samples_of(
    point: Tensor, direction: Tensor, owner: int = 0, track: int | None = None, kind: int = -1
) -> LineSamples:
    """Samples of one track."""
    n = len(point)
    return LineSamples(
        point=point,
        direction=direction,
        slope=torch.full((n,), 0.03, dtype=torch.float64),
        kind=torch.full((n,), kind),
        track=torch.full((n,), owner if track is None else track),
        owner=torch.full((n,), owner),
        weight=torch.ones(n, dtype=torch.float64),
    )


def curves_of_points(*points: Tensor, spacing: float = 5.0) -> Curves:
    """A curve of unknown kind through each list of points."""
    return curves_through(
        torch.cat(points),
        torch.repeat_interleave(torch.tensor([len(p) for p in points])),
        torch.full((len(points),), -1),
        torch.full((len(points),), spacing, dtype=torch.float64),
    )
