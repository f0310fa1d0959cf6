from __future__ import annotations

import torch
from torch import Tensor

from crowdmap_torch.clustering.lines import LineSamples
from crowdmap_torch.courses import curves as courses
from crowdmap_torch.courses.grow import drawn_out, supported_rows


def arc(radius: float, length: float, spacing: float = 1.0) -> tuple[Tensor, Tensor]:
    """Points and directions along an arc that starts at the origin heading east, climbing by 3 %."""
    s = torch.arange(0, length + 0.1, spacing, dtype=torch.float64)
    a = s / radius
    point = torch.stack((radius * a.sin(), radius * (1 - a.cos()), 0.03 * s), 1)
    return point, torch.stack((a.cos(), a.sin()), 1)


def samples_of(
    point: Tensor, direction: Tensor, owner: int = 0, track: int | None = None
) -> LineSamples:
    n = len(point)
    return LineSamples(
        point=point,
        direction=direction,
        slope=torch.full((n,), 0.03, dtype=torch.float64),
        kind=torch.full((n,), -1),
        track=torch.full((n,), owner if track is None else track),
        owner=torch.full((n,), owner),
        weight=torch.ones(n, dtype=torch.float64),
    )


def joined(parts: list[LineSamples]) -> LineSamples:
    columns = parts[0].__dict__
    return LineSamples(**{k: torch.cat([getattr(p, k) for p in parts]) for k in columns})


def curve_of(point: Tensor, spacing: float = 5.0) -> courses.Curves:
    return courses.curves_through(
        point,
        torch.zeros(len(point), dtype=torch.int64),
        torch.tensor([-1]),
        torch.tensor([spacing], dtype=torch.float64),
    )


def test_curve_follows_an_arc() -> None:
    point, _ = arc(30.0, 60.0)
    curve = curve_of(point)
    radius = (curve.point[:, :2] - torch.tensor([0.0, 30.0], dtype=torch.float64)).norm(dim=1)
    # A natural spline has no curvature at its ends: centimetres there, millimetres inside.
    assert float((radius - 30).abs().max()) < 0.06
    assert float((radius - 30).abs()[10:-10].max()) < 0.005
    torch.testing.assert_close(
        curve.slope[5:-5], torch.full_like(curve.slope[5:-5], 0.03), rtol=0, atol=2e-3
    )


def test_match_tells_station_and_side() -> None:
    point, direction = arc(1e6, 50.0)
    curve = curve_of(point)
    left = torch.stack((-direction[:, 1], direction[:, 0], torch.zeros(len(point))), 1)
    samples = samples_of(point + 0.3 * left, direction)
    matched = courses.match(samples, curve, gate=0.6)
    assert (matched.curve == 0).all()
    torch.testing.assert_close(
        matched.lateral, torch.full_like(matched.lateral, 0.3), rtol=0, atol=1e-3
    )
    torch.testing.assert_close(matched.station[1:-1], point[1:-1, 0], rtol=0, atol=0.02)
    assert (courses.match(samples, curve, gate=0.2).curve == -1).all()


def test_match_keeps_a_track_on_one_of_two_curves() -> None:
    s = torch.arange(0, 60.5, 1.0, dtype=torch.float64)
    zero = torch.zeros_like(s)
    lines = [torch.stack((s, zero + y, zero), 1) for y in (0.0, 0.5)]
    both = courses.curves_through(
        torch.cat(lines),
        torch.arange(2).repeat_interleave(len(s)),
        torch.tensor([-1, -1]),
        torch.tensor([8.0, 8.0], dtype=torch.float64),
    )
    # A few samples of the first line lie beyond the middle.
    wobble = torch.where(torch.arange(len(s)) % 6 == 0, 0.28, 0.05)
    point = lines[0] + torch.stack((zero, wobble, zero), 1)
    east = torch.stack((zero + 1, zero), 1)
    matched = courses.match(samples_of(point, east), both, gate=0.6)
    assert (matched.curve == 0).all()


def test_fit_resists_one_bad_owner(generator: torch.Generator) -> None:
    point, direction = arc(200.0, 80.0, 2.0)
    left = torch.stack((-direction[:, 1], direction[:, 0], torch.zeros(len(point))), 1)
    shifts = (-0.02, 0.0, 0.02, 0.01, 0.55)
    parts = [samples_of(point + d * left, direction, owner=k) for k, d in enumerate(shifts)]
    samples, curve = joined(parts), curve_of(point, 8.0)
    spacing = torch.tensor([8.0], dtype=torch.float64)
    for _ in range(4):
        matched = courses.match(samples, curve, gate=0.7)
        curve = courses.fit_curves(samples, matched, curve, spacing, scale=0.15)
    across = courses.match(samples_of(point, direction), curve, gate=0.7).lateral
    # The plain mean would be 0.11 m off.
    assert float(across.abs().max()) < 0.04


def test_overlapping_pieces_of_an_owner_count_once() -> None:
    point, direction = arc(1e6, 60.0, 2.0)
    up = torch.tensor([0.0, 0.2, 0.0], dtype=torch.float64)
    often = [samples_of(point, direction, owner=0) for _ in range(5)]
    samples = joined([*often, samples_of(point + up, direction, owner=1)])
    curve = curve_of(point, 8.0)
    matched = courses.match(samples, curve, gate=0.7)
    curve = courses.fit_curves(samples, matched, curve, torch.tensor([8.0]).double(), scale=1e3)
    assert abs(float(curve.point[10:-10, 1].mean()) - 0.1) < 0.01


def test_knots_are_denser_in_bends() -> None:
    curve = curve_of(arc(20.0, 60.0)[0], 4.0)
    straight = curve_of(arc(1e6, 60.0)[0], 4.0)
    near = float(courses.knot_spacing(curve, shortest=4.0, longest=10.0)[0])
    far = float(courses.knot_spacing(straight, shortest=4.0, longest=10.0)[0])
    assert 4.0 <= near < 5.5
    assert far == 10.0


def test_curves_grow_as_far_as_two_owners_saw() -> None:
    point, direction = arc(1e6, 60.0)
    ends = (52.0, 57.0, 60.0)
    samples = joined(
        [samples_of(point[: int(e)], direction[: int(e)], owner=k) for k, e in enumerate(ends)]
    )
    grown_point, of = drawn_out(curve_of(point[10:45]), 20.0)
    assert (of == 0).all()
    longer = curve_of(grown_point)
    matched = courses.match(samples, longer, gate=0.7)
    seen = supported_rows(longer, samples, matched, 2)
    x = longer.point[seen, 0]
    assert float(x.min()) < 1.5
    assert abs(float(x.max()) - 57.0) < 2.5
