from __future__ import annotations

from dataclasses import replace

import torch
from worlds.lines import arc, curves_of_points, samples_of

from crowdmap_torch.crowd_lanes.splines import (
    fit_curves,
    knot_spacing,
    match,
    nearest_row,
    overlap,
    select_curves,
)
from crowdmap_torch.tables import concatenate


def test_curve_follows_an_arc() -> None:
    point, _ = arc(30.0, 60.0)
    curve = curves_of_points(point)
    radius = (curve.point[:, :2] - torch.tensor([0.0, 30.0], dtype=torch.float64)).norm(dim=1)
    # A natural spline has no curvature at its ends: centimetres there, millimetres inside.
    assert float((radius - 30).abs().max()) < 0.06
    assert float((radius - 30).abs()[10:-10].max()) < 0.005
    torch.testing.assert_close(
        curve.slope[5:-5], torch.full_like(curve.slope[5:-5], 0.03), rtol=0, atol=2e-3
    )


def test_match_tells_station_and_side() -> None:
    point, direction = arc(1e6, 50.0)
    curve = curves_of_points(point)
    left = torch.stack((-direction[:, 1], direction[:, 0], torch.zeros(len(point))), 1)
    samples = samples_of(point + 0.3 * left, direction)
    matched = match(samples, curve, gate=0.6)
    assert (matched.curve == 0).all()
    torch.testing.assert_close(
        matched.lateral, torch.full_like(matched.lateral, 0.3), rtol=0, atol=1e-3
    )
    torch.testing.assert_close(matched.station[1:-1], point[1:-1, 0], rtol=0, atol=0.02)
    assert (match(samples, curve, gate=0.2).curve == -1).all()


def test_match_keeps_a_track_on_one_of_two_curves() -> None:
    s = torch.arange(0, 60.5, 1.0, dtype=torch.float64)
    zero = torch.zeros_like(s)
    lines = [torch.stack((s, zero + y, zero), 1) for y in (0.0, 0.5)]
    both = curves_of_points(*lines, spacing=8.0)
    # A few samples of the first line lie beyond the middle.
    wobble = torch.where(torch.arange(len(s)) % 6 == 0, 0.28, 0.05)
    point = lines[0] + torch.stack((zero, wobble, zero), 1)
    east = torch.stack((zero + 1, zero), 1)
    matched = match(samples_of(point, east), both, gate=0.6)
    assert (matched.curve == 0).all()


def test_fit_resists_one_bad_owner(generator: torch.Generator) -> None:
    point, direction = arc(200.0, 80.0, 2.0)
    left = torch.stack((-direction[:, 1], direction[:, 0], torch.zeros(len(point))), 1)
    shifts = (-0.02, 0.0, 0.02, 0.01, 0.55)
    parts = [samples_of(point + d * left, direction, owner=k) for k, d in enumerate(shifts)]
    samples, curve = concatenate(parts), curves_of_points(point, spacing=8.0)
    spacing = torch.tensor([8.0], dtype=torch.float64)
    for _ in range(4):
        matched = match(samples, curve, gate=0.7)
        curve = fit_curves(samples, matched, curve, spacing, scale=0.15)
    across = match(samples_of(point, direction), curve, gate=0.7).lateral
    # The plain mean would be 0.11 m off.
    assert float(across.abs().max()) < 0.04


def test_overlapping_pieces_of_an_owner_count_once() -> None:
    point, direction = arc(1e6, 60.0, 2.0)
    up = torch.tensor([0.0, 0.2, 0.0], dtype=torch.float64)
    often = [samples_of(point, direction, owner=0) for _ in range(5)]
    samples = concatenate([*often, samples_of(point + up, direction, owner=1)])
    curve = curves_of_points(point, spacing=8.0)
    matched = match(samples, curve, gate=0.7)
    curve = fit_curves(samples, matched, curve, torch.tensor([8.0]).double(), scale=1e3)
    assert abs(float(curve.point[10:-10, 1].mean()) - 0.1) < 0.01


def test_knots_are_denser_in_bends() -> None:
    curve = curves_of_points(arc(20.0, 60.0)[0], spacing=4.0)
    straight = curves_of_points(arc(1e6, 60.0)[0], spacing=4.0)
    near = float(knot_spacing(curve, (4.0, 10.0))[0])
    far = float(knot_spacing(straight, (4.0, 10.0))[0])
    assert 4.0 <= near < 5.5
    assert far == 10.0


def test_a_curve_of_another_kind_is_farther() -> None:
    point, direction = arc(1e6, 40.0)
    up = torch.tensor([0.0, 0.2, 0.0], dtype=torch.float64)
    curves = replace(curves_of_points(point, point + up), kind=torch.tensor([0, 1]))
    # A little nearer to the first curve.
    place = point + 0.45 * up
    for kind, expected in ((-1, 0), (0, 0), (1, 1)):
        matched = match(samples_of(place, direction, kind=kind), curves, gate=0.6)
        assert (matched.curve == expected).all()


def test_a_shifted_match_is_the_match_of_shifted_samples() -> None:
    point, direction = arc(100.0, 60.0)
    curve, samples = curves_of_points(point), samples_of(point, direction)
    left = torch.stack((-direction[:, 1], direction[:, 0], torch.full((len(point),), 2.0)), 1)
    shift = 0.1 * left
    shifted = match(samples, curve, gate=0.7).shifted(shift)
    moved = match(replace(samples, point=point + shift), curve, gate=0.7)
    # Seen from the same points of the curve, up to what 0.1 m beside it changes along a bend.
    torch.testing.assert_close(shifted.lateral, moved.lateral, atol=1e-3, rtol=0)
    torch.testing.assert_close(shifted.height, moved.height, atol=1e-3, rtol=0)


def test_nearest_row_is_the_nearest_point_of_the_own_curve() -> None:
    point, direction = arc(1e6, 40.0, 1.7)
    curves = curves_of_points(arc(1e6, 40.0)[0], arc(1e6, 40.0)[0] + 5.0)
    matched = match(samples_of(point + 5.0, direction), curves, gate=0.6)
    used = matched.curve >= 0
    assert used.sum() > 15 and (matched.curve[used] == 1).all()
    row = nearest_row(curves, matched)
    assert (curves.curve[row[used]] == 1).all() and (row[~used] == -1).all()
    assert float((curves.station[row[used]] - matched.station[used]).abs().max()) <= 0.5 + 1e-9


def test_overlap_counts_samples_of_an_owner_on_four_metres() -> None:
    owner, curve = torch.tensor([0, 0, 0, 1, 0]), torch.tensor([0, 0, 0, 0, 1])
    station = torch.tensor([0.0, 3.9, 4.1, 1.0, 1.0], dtype=torch.float64)
    assert overlap(owner, curve, station, 2).tolist() == [2.0, 2.0, 1.0, 1.0, 1.0]


def test_nothing_matches_where_there_are_no_curves_or_samples() -> None:
    point, direction = arc(50.0, 20.0)
    samples, curve = samples_of(point, direction), curves_of_points(point)
    nothing = select_curves(curve, torch.tensor([False]))
    assert (match(samples, nothing, gate=1.0).curve == -1).all()
    assert len(match(samples[torch.arange(0)], curve, gate=1.0).curve) == 0
