"""Fits of splines to points, and their points nearest to given ones."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline
from worlds.curves import (
    arc_length,
    basis,
    closest_parameter,
    coefficients,
    derivative,
    evaluate,
    fit,
    packed,
    rand,
    randn,
    road,
)

from crowdmap_torch.geometry import spline_basis, spline_fit


def test_bending_is_the_integral_of_the_squared_second_derivative(generator):
    for count in (2, 3, 5, 12):
        control = randn(generator, count, 2)
        energy = spline_fit.bending(torch.tensor([count]), count, control)[0]
        coefficient = coefficients(control)
        found = (coefficient * (energy @ coefficient)).sum().item()
        expected = 0.0
        if count > 2:
            second = CubicSpline(np.arange(count), control.numpy(), bc_type="natural").derivative(2)
            # piecewise linear, so Simpson's rule is exact for its square
            a, m, b = (second(np.arange(count - 1) + x) for x in (0, 0.5, 1))
            expected = ((a**2 + 4 * m**2 + b**2) / 6).sum()
        assert found == pytest.approx(expected, abs=1e-10)


def test_fit_of_points_on_a_spline_is_that_spline(generator):
    for count in (2, 3, 4, 7, 30):
        control = road(count, generator)
        t = rand(generator, 40 * count) * (count - 1)
        points = evaluate(control, t)
        fitted = fit(points, count, t)
        # the pull of least bending: 1e-9 of the weight, times 20 m of road and the condition
        torch.testing.assert_close(fitted, control, atol=1e-4, rtol=0)


def test_fit_is_the_least_squares_solution(generator):
    t, points = rand(generator, 60) * 5, randn(generator, 60, 3)
    expected = torch.linalg.lstsq(basis(t, 6), points).solution
    torch.testing.assert_close(fit(points, 6, t), expected, atol=1e-6, rtol=0)


def test_fit_bridges_a_gap_without_points(generator):
    control = road(9, generator)
    t = rand(generator, 200) * 8
    t = t[(t < 2.5) | (t > 5.5)]
    fitted = fit(evaluate(control, t), 9, t)
    # three spans of 20 m that nothing but least bending decides: metres, not kilometres
    assert (fitted - control).norm(dim=-1).max() < 20


def test_fits_of_packed_splines_are_the_same_as_one_by_one(generator):
    _, count, t, piece = packed(generator)
    count = count[:5]
    mine = piece < 5
    t, piece = t[mine], piece[mine]
    points = 1000 + randn(generator, len(t), 3)
    together = spline_fit.fit_flat(points, piece, t, count)
    for i, part in enumerate(together.split(count.tolist())):
        m = piece == i
        alone = fit(points[m], int(count[i]), t[m])
        torch.testing.assert_close(part, alone, atol=1e-6, rtol=0)


def test_fit_of_no_points_or_of_one_is_finite():
    count = torch.tensor([5, 4])
    point = torch.tensor([[3.0, 4.0, 5.0]], dtype=torch.float64)
    t = torch.tensor([1.5], dtype=torch.float64)
    control = spline_fit.fit_flat(point, torch.tensor([1]), t, count)
    assert control.isfinite().all()
    torch.testing.assert_close(control[5:], point.expand(4, 3))


def test_fit_without_parameters_follows_a_curve_whose_points_come_in_any_order(generator):
    # 80 m of an arc of 400 m radius with 3 cm of noise
    s = 80 * rand(generator, 400)
    arc = torch.stack((400 * (s / 400).sin(), 400 - 400 * (s / 400).cos(), 0 * s), dim=-1)
    points = arc + 0.03 * randn(generator, 400, 3)
    count, piece = torch.tensor([9]), torch.zeros(400, dtype=torch.long)
    laid = fit(points, 9, spline_fit.principal_parameter(points, piece, count))
    fitted = spline_fit.refine_flat(points, piece, laid, count)
    sampled = evaluate(fitted, torch.linspace(0, 8, 100, dtype=torch.float64))
    to_centre = (sampled - torch.tensor([0.0, 400.0, 0.0], dtype=torch.float64)).norm(dim=-1)
    # 3 cm / sqrt(44 points a control point) is 0.5 cm, twice that at the ends, and natural ends
    # bend away by 1 cm
    assert (to_centre - 400).abs().max() < 0.05
    # the outermost points are noisy too
    assert arc_length(fitted) == pytest.approx(80, abs=1.0)


def test_principal_parameter_spans_the_knots_along_the_line(generator):
    count = torch.tensor([5, 3])
    piece = torch.tensor([0, 0, 0, 1, 1])
    points = torch.tensor(
        [[10.0, 1, 0], [0.0, 0, 0], [5.0, 0.5, 0], [0.0, 7, 0], [0, 3.0, 0]], dtype=torch.float64
    )
    t = spline_fit.principal_parameter(points, piece, count)
    expected = torch.tensor([4.0, 0.0, 2.0, 2.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(t, expected)


def test_closest_parameter_of_points_on_the_curve(generator):
    for count in (2, 3, 5, 20):
        control = road(count, generator)
        t = rand(generator, 100) * (count - 1)
        found = closest_parameter(control, evaluate(control, t))
        torch.testing.assert_close(found, t, atol=1e-9, rtol=0)


def test_closest_parameter_is_the_nearest_of_fine_samples(generator):
    control = road(8, generator)
    points = control[torch.randint(0, 8, (200,), generator=generator)] + 5 * randn(
        generator, 200, 3
    )
    t = closest_parameter(control, points)
    assert (t >= 0).all()
    assert (t <= 7).all()
    distance = (evaluate(control, t) - points).norm(dim=-1)
    fine = evaluate(control, torch.linspace(0, 7, 20_001, dtype=torch.float64))
    nearest = torch.cdist(points, fine).amin(-1)
    assert (distance <= nearest + 1e-6).all()


def test_closest_parameter_stops_at_the_ends(generator):
    control = road(5, generator)
    before = control[0] - 10 * derivative(control, torch.zeros(1, dtype=torch.float64))[0]
    after = control[-1] + 10 * (control[-1] - control[-2])
    t = closest_parameter(control, torch.stack((before, after)))
    assert t.tolist() == [0.0, 4.0]


def test_closest_parameters_of_packed_splines_are_the_same_as_one_by_one(generator, monkeypatch):
    count = torch.tensor([5, 2, 12])
    control = torch.cat([road(int(c), generator) for c in count])
    piece = torch.randint(0, 3, (100,), generator=generator)
    points = control[spline_basis.starts(count)[piece]] + 15 * randn(generator, 100, 3)
    together = spline_fit.closest_parameter_flat(control, count, points, piece)
    for i, alone in enumerate(control.split(count.tolist())):
        mine = piece == i
        found = evaluate(alone, closest_parameter(alone, points[mine]))
        expected = evaluate(alone, together[mine])
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)
    monkeypatch.setattr("crowdmap_torch.geometry.spline_fit._CHUNK_POINTS", 500)
    in_chunks = spline_fit.closest_parameter_flat(control, count, points, piece)
    torch.testing.assert_close(in_chunks, together)
