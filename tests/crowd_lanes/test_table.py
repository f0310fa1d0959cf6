from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from worlds import lane_world
from worlds.lines import curves_of_points

from crowdmap_torch.crowd_lanes.samples import LaneSamples, sample_lanes
from crowdmap_torch.crowd_lanes.splines import Curves, match
from crowdmap_torch.crowd_lanes.table import lanes_table
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.tables import Lanes

F64 = torch.float64
LEFT = (0.1, -0.1, 0.0)
"""How far to the left of the marker each journey saw it [m]."""


def straight(left: float, last: float = 80.0) -> np.ndarray:
    x = np.arange(0.0, last + 1, 10.0)
    return np.stack((x, np.full_like(x, left), 0 * x), 1)


def seen() -> tuple[Lanes, LaneSamples, Curves]:
    """A marker that three journeys saw, one of them over its first half, and a curve on it."""
    lasts = (80.0, 80.0, 40.0)
    lanes = lane_world.pieces(
        [straight(left, last) for left, last in zip(LEFT, lasts, strict=True)],
        type=[2] * 3,
        journey=[0, 1, 2],
        tracklet=[4, 5, 6],
        frame=[10, 20, 5],
    )
    curves = curves_of_points(torch.from_numpy(straight(0.0)), spacing=10.0)
    samples = sample_lanes(lanes, 2.0, PositioningNoise(), few_observations=10.0)
    return lanes, samples, replace(curves, kind=torch.tensor([2]))


def test_sigma_is_that_of_the_mean_of_the_journeys_that_saw_the_place() -> None:
    lanes, samples, curves = seen()
    table = lanes_table(
        curves, lanes, samples, match(samples.line, curves, gate=0.6), offset_sigma=0.2
    )
    first, last = table.control.sigma[0], table.control.sigma[-1]
    # Three journeys with a scatter of (0.1^2 + 0.1^2) / 2, then two with twice that.
    assert float(first) == pytest.approx(((0.2**2 + 0.01) / 3) ** 0.5, rel=1e-6)
    assert float(last) == pytest.approx(((0.2**2 + 0.02) / 2) ** 0.5, rel=1e-6)


def test_journeys_times_and_observations_are_those_of_the_pieces() -> None:
    lanes, samples, curves = seen()
    table = lanes_table(
        curves, lanes, samples, match(samples.line, curves, gate=0.6), offset_sigma=0.2
    )
    assert table.n_journeys.tolist() == [3]
    assert table.n_observations.tolist() == [int(lanes.n_observations.sum())]
    assert table.first_seen_ns.tolist() == [int(lanes.first_seen_ns.min())]
    assert table.last_seen_ns.tolist() == [int(lanes.last_seen_ns.max())]
    assert table.type.tolist() == [2] and table.journey.tolist() == [-1]
    assert float(table.confidence[0]) == pytest.approx(1 - 0.6**3)


def test_a_piece_counts_by_the_share_that_lies_on_the_lane() -> None:
    lanes, samples, curves = seen()
    matched = match(samples.line, curves, gate=0.6)
    half = (samples.piece == 0) & (samples.line.point[:, 0] > 40)
    matched = replace(matched, curve=matched.curve.masked_fill(half, -1))
    table = lanes_table(curves, lanes, samples, matched, offset_sigma=0.2)
    whole = samples.piece == 0
    share = float((whole & ~half).sum() / whole.sum())
    expected = lanes.n_observations[0] * share + lanes.n_observations[1:].sum()
    assert table.n_observations.tolist() == [round(float(expected))]


def test_a_lane_that_nothing_lies_on_has_no_journeys() -> None:
    lanes, samples, curves = seen()
    matched = match(samples.line, curves, gate=0.6)
    matched = replace(matched, curve=torch.full_like(matched.curve, -1))
    table = lanes_table(curves, lanes, samples, matched, offset_sigma=0.2)
    assert table.n_journeys.tolist() == [0] and table.n_observations.tolist() == [0]
    assert table.control.sigma.isfinite().all() and float(table.confidence[0]) == 0.0
