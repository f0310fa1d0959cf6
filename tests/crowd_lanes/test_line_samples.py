from __future__ import annotations

import math

import torch
from worlds.lines import arc, curves_of_points, straight

from crowdmap_torch.crowd_lanes.line_samples import (
    along_axis,
    left_of_axis,
    merge_in_cells,
    owners_around,
    points_along,
    scalar_key,
    stations,
)


def test_merging_keeps_the_line_of_a_track() -> None:
    samples = straight([0.0, 3.5])
    twice = samples[torch.arange(len(samples)).repeat_interleave(2)]
    fewer, went = merge_in_cells(twice, 2.0)
    assert len(fewer) < len(samples)
    assert (fewer.track[went] == twice.track).all()
    across = fewer.point[:, 1] - 3.5 * fewer.track
    assert float(across.abs().max()) < 1e-12


def test_owners_around_counts_each_once() -> None:
    samples = straight([0.0, 3.5, 40.0])
    count = owners_around(samples.point[:1], samples, 8.0)
    assert count.tolist() == [2]


def test_equal_rows_alone_have_equal_keys(generator: torch.Generator) -> None:
    rows = torch.randint(-3, 3, (60, 3), generator=generator)
    same = (rows[:, None] == rows[None]).all(2)
    key = scalar_key(rows)
    assert torch.equal(key[:, None] == key[None], same)


def test_ahead_and_left_are_coordinates_along_an_axis(generator: torch.Generator) -> None:
    delta = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    angle = 2 * math.pi * torch.rand(20, generator=generator, dtype=torch.float64)
    axis = torch.stack((angle.cos(), angle.sin()), 1)
    left = torch.stack((-axis[:, 1], axis[:, 0]), 1)
    a, b = along_axis(delta, axis), left_of_axis(delta, axis)
    # A few sums and products of numbers of order one.
    torch.testing.assert_close(
        a[:, None] * axis + b[:, None] * left, delta[:, :2], atol=1e-14, rtol=0
    )


def test_stations_begin_anew_with_each_polyline() -> None:
    point, _ = arc(1e9, 10.0, 2.0)
    s, length = stations(torch.cat((point, point)), torch.arange(3)[[0, 2]].repeat_interleave(6), 3)
    expected = torch.arange(0.0, 10.5, 2.0, dtype=torch.float64)
    # Horizontal: the climb of 3 % does not count.
    torch.testing.assert_close(s, expected.repeat(2), atol=1e-9, rtol=0)
    torch.testing.assert_close(
        length[[0, 2]], torch.tensor([10.0, 10.0]).double(), atol=1e-9, rtol=0
    )


def test_points_along_a_spline_reach_both_ends_and_know_the_way() -> None:
    curves = curves_of_points(arc(50.0, 60.0)[0], arc(1e9, 30.0)[0])
    along = points_along(curves.control, curves.count, 3.0)
    for number, control in enumerate(curves.control.split(curves.count.tolist())):
        own = along[along.spline == number]
        # Coefficients and back: rounding of numbers up to 60 m.
        torch.testing.assert_close(own.point[[0, -1]], control[[0, -1]], atol=1e-12, rtol=0)
        step = own.point.diff(dim=0)
        assert float(step.norm(dim=1).max()) < 3.2
        middle = torch.nn.functional.normalize(own.direction[1:] + own.direction[:-1], dim=1)
        # Over three metres of a radius of 50 m chord and mean tangent differ by less than a milliradian.
        ahead = torch.nn.functional.normalize(step[:, :2], dim=1)
        assert float(left_of_axis(ahead, middle).abs().max()) < 1e-2
        assert float((own.slope - 0.03).abs().max()) < 5e-3
