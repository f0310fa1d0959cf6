"""Natural cubic splines: values, derivatives, and their two forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline
from torch.func import jacfwd, vmap
from worlds.curves import basis, coefficients, derivative, evaluate, packed, rand, randn

from crowdmap_torch.geometry import spline_basis

COUNTS = [2, 3, 4, 5, 9, 40, 300]


@pytest.mark.parametrize("count", [c for c in COUNTS if c > 2])
def test_agrees_with_scipy(generator, count):
    control = randn(generator, count, 3)
    t = rand(generator, 200) * (count - 1)
    reference = CubicSpline(np.arange(count), control.numpy(), bc_type="natural")
    expected = torch.from_numpy(reference(t.numpy()))
    torch.testing.assert_close(evaluate(control, t), expected, atol=1e-12, rtol=0)
    slope = torch.from_numpy(reference(t.numpy(), 1))
    torch.testing.assert_close(derivative(control, t), slope, atol=1e-12, rtol=0)


def test_two_control_points_are_a_straight_line(generator):
    control = randn(generator, 2, 3)
    t = rand(generator, 20)
    expected = control[0] + t[:, None] * (control[1] - control[0])
    torch.testing.assert_close(evaluate(control, t), expected)


@pytest.mark.parametrize("count", COUNTS)
def test_passes_through_its_control_points(generator, count):
    control = randn(generator, count, 3)
    at_knots = evaluate(control, torch.arange(count, dtype=torch.float64))
    torch.testing.assert_close(at_knots, control, atol=1e-13, rtol=1e-13)


@pytest.mark.parametrize("count", COUNTS)
def test_coefficients_and_control_points_are_one_curve(generator, count):
    control, counts = randn(generator, 3 * count, 2), torch.full((3,), count)
    coefficient = spline_basis.to_coefficients_flat(control, counts)
    back = spline_basis.from_coefficients_flat(coefficient, counts)
    torch.testing.assert_close(back, control, atol=1e-13, rtol=1e-13)


def test_window_has_local_support_and_sums_to_one(generator):
    for count in COUNTS:
        t = rand(generator, 300) * (count - 1)
        start, weight, d_weight = spline_basis.window(t, count)
        assert (start >= 0).all()
        assert (start <= max(count - 4, 0)).all()
        torch.testing.assert_close(weight.sum(-1), torch.ones_like(t))
        torch.testing.assert_close(d_weight.sum(-1), torch.zeros_like(t), atol=1e-14, rtol=0)
        assert (weight[:, count:] == 0).all()


@pytest.mark.parametrize("count", COUNTS)
def test_window_derivatives_are_those_of_the_weights(generator, count):
    # between knots: at a knot the window itself moves on
    t = torch.randint(0, count - 1, (50,), generator=generator) + 0.01 + 0.98 * rand(generator, 50)
    _, _, d_weight, dd_weight = spline_basis.window_with_curvature(t, count)
    d = vmap(jacfwd(lambda x: spline_basis.window(x, count)[1]))(t)
    dd = vmap(jacfwd(lambda x: spline_basis.window(x, count)[2]))(t)
    torch.testing.assert_close(d_weight, d)
    torch.testing.assert_close(dd_weight, dd)


def test_goes_on_straight_beyond_its_ends(generator):
    control = randn(generator, 6, 3)
    for end, beyond in ((0.0, -1.7), (5.0, 8.1)):
        at_end = torch.tensor([end], dtype=torch.float64)
        t = torch.tensor([beyond], dtype=torch.float64)
        slope = derivative(control, at_end)
        expected = evaluate(control, at_end) + (beyond - end) * slope
        torch.testing.assert_close(evaluate(control, t), expected)
        torch.testing.assert_close(derivative(control, t), slope)


def test_packed_splines_are_the_same_as_one_by_one(generator):
    control, count, t, piece = packed(generator)
    value = spline_basis.evaluate_flat(control, count, t, piece)
    slope = spline_basis.derivative_flat(control, count, t, piece)
    coefficient = spline_basis.to_coefficients_flat(control, count)
    start = spline_basis.starts(count)
    for i, alone in enumerate(control.split(count.tolist())):
        mine = piece == i
        torch.testing.assert_close(value[mine], evaluate(alone, t[mine]))
        torch.testing.assert_close(slope[mine], derivative(alone, t[mine]))
        rows = slice(int(start[i]), int(start[i] + count[i]))
        torch.testing.assert_close(coefficient[rows], coefficients(alone))
    back = spline_basis.from_coefficients_flat(coefficient, count)
    torch.testing.assert_close(back, control, atol=1e-13, rtol=1e-13)


def test_windows_of_packed_splines_stay_within_their_spline(generator):
    _, count, t, piece = packed(generator)
    start = spline_basis.starts(count)[piece]
    index, weight, _ = spline_basis.window_flat(t, start, count[piece])
    assert (index >= start[:, None]).all()
    assert (index < (start + count[piece])[:, None]).all()
    torch.testing.assert_close(weight.sum(-1), torch.ones_like(t))


def test_evaluation_differentiates_in_control_points_and_parameter(generator):
    control, t = randn(generator, 6, 3), rand(generator, 10) * 5
    by_control = torch.func.jacrev(lambda c: evaluate(c, t))(control)
    expected = torch.einsum("mc,ij->micj", basis(t, 6), torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(by_control, expected)
    by_t = vmap(jacfwd(lambda x: evaluate(control, x[None])[0]))(t)
    torch.testing.assert_close(by_t, derivative(control, t))
