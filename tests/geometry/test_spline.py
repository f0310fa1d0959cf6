"""Natural cubic splines: values, forms, fits, nearest points, lengths."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline
from torch.func import jacfwd, vmap

from crowdmap_torch.geometry import spline

COUNTS = [2, 3, 4, 5, 9, 40, 300]


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def randn(generator: torch.Generator, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def rand(generator: torch.Generator, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=generator, dtype=torch.float64)


def packed(generator: torch.Generator):
    """Splines of many lengths, packed, and points on them in no order."""
    count = torch.tensor([5, 2, 3, 17, 4, 2, 90])
    control = randn(generator, int(count.sum()), 3)
    piece = torch.randint(0, len(count), (200,), generator=generator)
    t = rand(generator, 200) * (count[piece] - 1)
    return control, count, t, piece


def road(count: int, generator: torch.Generator) -> torch.Tensor:
    """A winding, climbing line of about 20 m between knots, kilometres from the origin."""
    heading = (0.25 * randn(generator, count)).cumsum(0)
    step = 20 * torch.stack((heading.cos(), heading.sin(), 0.02 * heading), dim=-1)
    return step.cumsum(0) + torch.tensor([4000.0, -3000.0, 50.0], dtype=torch.float64)


@pytest.mark.parametrize("count", [c for c in COUNTS if c > 2])
def test_agrees_with_scipy(generator, count):
    control = randn(generator, count, 3)
    t = rand(generator, 200) * (count - 1)
    reference = CubicSpline(np.arange(count), control.numpy(), bc_type="natural")
    expected = torch.from_numpy(reference(t.numpy()))
    torch.testing.assert_close(spline.evaluate(control, t), expected, atol=1e-12, rtol=0)
    slope = torch.from_numpy(reference(t.numpy(), 1))
    torch.testing.assert_close(spline.derivative(control, t), slope, atol=1e-12, rtol=0)


def test_two_control_points_are_a_straight_line(generator):
    control = randn(generator, 2, 3)
    t = rand(generator, 20)
    expected = control[0] + t[:, None] * (control[1] - control[0])
    torch.testing.assert_close(spline.evaluate(control, t), expected)


@pytest.mark.parametrize("count", COUNTS)
def test_passes_through_its_control_points(generator, count):
    control = randn(generator, count, 3)
    at_knots = spline.evaluate(control, torch.arange(count, dtype=torch.float64))
    torch.testing.assert_close(at_knots, control, atol=1e-13, rtol=1e-13)


@pytest.mark.parametrize("count", COUNTS)
def test_basis_takes_control_points_to_the_curve(generator, count):
    control, t = randn(generator, count, 2), rand(generator, 50) * (count - 1)
    torch.testing.assert_close(spline.basis(t, count) @ control, spline.evaluate(control, t))


@pytest.mark.parametrize("count", COUNTS)
def test_coefficients_and_control_points_are_one_curve(generator, count):
    control = randn(generator, 3, count, 2)
    coefficient = spline.to_coefficients(control)
    back = spline.from_coefficients(coefficient)
    torch.testing.assert_close(back, control, atol=1e-13, rtol=1e-13)


def test_window_has_local_support_and_sums_to_one(generator):
    for count in COUNTS:
        t = rand(generator, 300) * (count - 1)
        start, weight, d_weight = spline.window(t, count)
        assert (start >= 0).all()
        assert (start <= max(count - 4, 0)).all()
        torch.testing.assert_close(weight.sum(-1), torch.ones_like(t))
        torch.testing.assert_close(d_weight.sum(-1), torch.zeros_like(t), atol=1e-14, rtol=0)
        assert (weight[:, count:] == 0).all()


@pytest.mark.parametrize("count", COUNTS)
def test_window_derivatives_are_those_of_the_weights(generator, count):
    # between knots: at a knot the window itself moves on
    t = torch.randint(0, count - 1, (50,), generator=generator) + 0.01 + 0.98 * rand(generator, 50)
    _, _, d_weight, dd_weight = spline.window_with_curvature(t, count)
    d = vmap(jacfwd(lambda x: spline.window(x, count)[1]))(t)
    dd = vmap(jacfwd(lambda x: spline.window(x, count)[2]))(t)
    torch.testing.assert_close(d_weight, d)
    torch.testing.assert_close(dd_weight, dd)


def test_goes_on_straight_beyond_its_ends(generator):
    control = randn(generator, 6, 3)
    for end, beyond in ((0.0, -1.7), (5.0, 8.1)):
        at_end = torch.tensor([end], dtype=torch.float64)
        t = torch.tensor([beyond], dtype=torch.float64)
        slope = spline.derivative(control, at_end)
        expected = spline.evaluate(control, at_end) + (beyond - end) * slope
        torch.testing.assert_close(spline.evaluate(control, t), expected)
        torch.testing.assert_close(spline.derivative(control, t), slope)


def test_packed_splines_are_the_same_as_one_by_one(generator):
    control, count, t, piece = packed(generator)
    value = spline.evaluate_flat(control, count, t, piece)
    slope = spline.derivative_flat(control, count, t, piece)
    coefficient = spline.to_coefficients_flat(control, count)
    start = spline.starts(count)
    for i, alone in enumerate(control.split(count.tolist())):
        mine = piece == i
        torch.testing.assert_close(value[mine], spline.evaluate(alone, t[mine]))
        torch.testing.assert_close(slope[mine], spline.derivative(alone, t[mine]))
        rows = slice(int(start[i]), int(start[i] + count[i]))
        torch.testing.assert_close(coefficient[rows], spline.to_coefficients(alone))
    back = spline.from_coefficients_flat(coefficient, count)
    torch.testing.assert_close(back, control, atol=1e-13, rtol=1e-13)


def test_windows_of_packed_splines_stay_within_their_spline(generator):
    _, count, t, piece = packed(generator)
    start = spline.starts(count)[piece]
    index, weight, _ = spline.window_flat(t, start, count[piece])
    assert (index >= start[:, None]).all()
    assert (index < (start + count[piece])[:, None]).all()
    torch.testing.assert_close(weight.sum(-1), torch.ones_like(t))


def test_batches_broadcast(generator):
    control, t = randn(generator, 4, 5, 7, 3), rand(generator, 4, 5, 11) * 6
    value = spline.evaluate(control, t)
    assert value.shape == (4, 5, 11, 3)
    torch.testing.assert_close(value[2, 3], spline.evaluate(control[2, 3], t[2, 3]))
    shared = spline.evaluate(control, t[0, 0])
    torch.testing.assert_close(shared[2, 3], spline.evaluate(control[2, 3], t[0, 0]))


def test_bending_is_the_integral_of_the_squared_second_derivative(generator):
    for count in (2, 3, 5, 12):
        control = randn(generator, count, 2)
        energy = spline.bending(torch.tensor([count]), count, control)[0]
        coefficient = spline.to_coefficients(control)
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
        points = spline.evaluate(control, t)
        fitted = spline.fit(points, count, t=t)
        # the ridge's pull: 1e-9 of the weight, times 20 m of road and the condition
        torch.testing.assert_close(fitted, control, atol=1e-4, rtol=0)


def test_fit_is_the_weighted_least_squares_solution(generator):
    t, weight = rand(generator, 60) * 5, rand(generator, 60)
    points = randn(generator, 60, 3)
    fitted = spline.fit(points, 6, weight, t, smoothing=0.0)
    root = weight.sqrt()[:, None]
    expected = torch.linalg.lstsq(root * spline.basis(t, 6), root * points).solution
    torch.testing.assert_close(fitted, expected, atol=1e-6, rtol=0)


def test_fit_minimises_misfit_plus_bending(generator):
    t, points = rand(generator, 40) * 5, randn(generator, 40, 2)
    smoothing = 0.3
    energy = spline.bending(torch.tensor([6]), 6, points)[0]

    def cost(control: torch.Tensor) -> torch.Tensor:
        coefficient = spline.to_coefficients(control)
        bend = (coefficient * (energy @ coefficient)).sum()
        return (spline.evaluate(control, t) - points).square().sum() + smoothing * bend

    fitted = spline.fit(points, 6, t=t, smoothing=smoothing)
    assert torch.func.grad(cost)(fitted).abs().max() < 1e-5


def test_fit_with_dear_bending_is_a_straight_line(generator):
    t, points = rand(generator, 40) * 5, randn(generator, 40, 2)
    fitted = spline.fit(points, 6, t=t, smoothing=1e9)
    second_difference = fitted[:-2] - 2 * fitted[1:-1] + fitted[2:]
    assert second_difference.abs().max() < 1e-6


def test_fit_bridges_a_gap_without_points(generator):
    control = road(9, generator)
    t = rand(generator, 200) * 8
    t = t[(t < 2.5) | (t > 5.5)]
    fitted = spline.fit(spline.evaluate(control, t), 9, t=t)
    # three spans of 20 m that nothing but least bending decides: metres, not kilometres
    assert (fitted - control).norm(dim=-1).max() < 20


def test_fits_of_packed_splines_are_the_same_as_one_by_one(generator):
    _, count, t, piece = packed(generator)
    count = count[:5]
    mine = piece < 5
    t, piece = t[mine], piece[mine]
    points, weight = 1000 + randn(generator, len(t), 3), rand(generator, len(t))
    smoothing = 0.1 + rand(generator, 5)
    together = spline.fit_flat(points, piece, t, count, weight, smoothing)
    for i, part in enumerate(together.split(count.tolist())):
        m = piece == i
        alone = spline.fit(points[m], int(count[i]), weight[m], t[m], smoothing[i].item())
        torch.testing.assert_close(part, alone, atol=1e-6, rtol=0)


def test_fit_of_no_points_or_of_one_is_finite():
    count = torch.tensor([5, 4])
    point = torch.tensor([[3.0, 4.0, 5.0]], dtype=torch.float64)
    t = torch.tensor([1.5], dtype=torch.float64)
    control = spline.fit_flat(point, torch.tensor([1]), t, count)
    assert control.isfinite().all()
    torch.testing.assert_close(control[5:], point.expand(4, 3))


def test_fit_without_parameters_follows_a_curve_whose_points_come_in_any_order(generator):
    # 80 m of an arc of 400 m radius with 3 cm of noise
    s = 80 * rand(generator, 400)
    arc = torch.stack((400 * (s / 400).sin(), 400 - 400 * (s / 400).cos(), 0 * s), dim=-1)
    fitted = spline.fit(arc + 0.03 * randn(generator, 400, 3), 9)
    sampled = spline.evaluate(fitted, torch.linspace(0, 8, 100, dtype=torch.float64))
    to_centre = (sampled - torch.tensor([0.0, 400.0, 0.0], dtype=torch.float64)).norm(dim=-1)
    # 3 cm / sqrt(44 points a control point) is 0.5 cm, twice that at the ends, and natural ends
    # bend away by 1 cm
    assert (to_centre - 400).abs().max() < 0.05
    # the outermost points are noisy too
    assert spline.arc_length(fitted).item() == pytest.approx(80, abs=1.0)


def test_principal_parameter_spans_the_knots_along_the_line(generator):
    count = torch.tensor([5, 3])
    piece = torch.tensor([0, 0, 0, 1, 1])
    points = torch.tensor(
        [[10.0, 1, 0], [0.0, 0, 0], [5.0, 0.5, 0], [0.0, 7, 0], [0, 3.0, 0]],
        dtype=torch.float64,
    )
    t = spline.principal_parameter(points, piece, count)
    expected = torch.tensor([4.0, 0.0, 2.0, 2.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(t, expected)


def test_closest_parameter_of_points_on_the_curve(generator):
    for count in (2, 3, 5, 20):
        control = road(count, generator)
        t = rand(generator, 100) * (count - 1)
        found = spline.closest_parameter(control, spline.evaluate(control, t))
        torch.testing.assert_close(found, t, atol=1e-9, rtol=0)


def test_closest_parameter_is_the_nearest_of_fine_samples(generator):
    control = road(8, generator)
    points = control[torch.randint(0, 8, (200,), generator=generator)] + 5 * randn(
        generator, 200, 3
    )
    t = spline.closest_parameter(control, points)
    assert (t >= 0).all()
    assert (t <= 7).all()
    distance = (spline.evaluate(control, t) - points).norm(dim=-1)
    fine = spline.evaluate(control, torch.linspace(0, 7, 20_001, dtype=torch.float64))
    nearest = torch.cdist(points, fine).amin(-1)
    assert (distance <= nearest + 1e-6).all()


def test_closest_parameter_stops_at_the_ends(generator):
    control = road(5, generator)
    before = control[0] - 10 * spline.derivative(control, torch.zeros(1, dtype=torch.float64))[0]
    after = control[-1] + 10 * (control[-1] - control[-2])
    t = spline.closest_parameter(control, torch.stack((before, after)))
    assert t.tolist() == [0.0, 4.0]


def test_closest_parameters_of_packed_splines_are_the_same_as_one_by_one(generator, monkeypatch):
    count = torch.tensor([5, 2, 12])
    control = torch.cat([road(int(c), generator) for c in count])
    piece = torch.randint(0, 3, (100,), generator=generator)
    points = control[spline.starts(count)[piece]] + 15 * randn(generator, 100, 3)
    together = spline.closest_parameter_flat(control, count, points, piece)
    for i, alone in enumerate(control.split(count.tolist())):
        mine = piece == i
        found = spline.evaluate(alone, spline.closest_parameter(alone, points[mine]))
        expected = spline.evaluate(alone, together[mine])
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)
    monkeypatch.setattr("crowdmap_torch.geometry.spline_fit._CHUNK_POINTS", 500)
    in_chunks = spline.closest_parameter_flat(control, count, points, piece)
    torch.testing.assert_close(in_chunks, together)


def test_length_of_a_line_and_of_an_arc():
    line = torch.tensor([[0.0, 0, 0], [3.0, 4.0, 0], [6.0, 8.0, 0]], dtype=torch.float64)
    assert spline.arc_length(line).item() == pytest.approx(10)
    angle = torch.linspace(0, math.pi / 2, 40, dtype=torch.float64)
    arc = 100 * torch.stack((angle.cos(), angle.sin(), 0 * angle), dim=-1)
    # natural ends straighten the first and last knots a little
    assert spline.arc_length(arc).item() == pytest.approx(50 * math.pi, abs=1e-3)


def test_length_agrees_with_fine_chords(generator):
    control = road(10, generator)
    fine = spline.evaluate(control, torch.linspace(0, 9, 100_001, dtype=torch.float64))
    chords = (fine[1:] - fine[:-1]).norm(dim=-1).sum().item()
    # five Gauss nodes on a quarter of a span
    assert spline.arc_length(control).item() == pytest.approx(chords, abs=1e-5)


def test_samples_are_evenly_spaced_and_reach_both_ends(generator):
    count = torch.tensor([10, 2, 5])
    control = torch.cat([road(int(c), generator) for c in count])
    # knots that are not even at all
    control[2] = control[1] + 0.1 * (control[2] - control[1])
    points, t, piece = spline.sample_flat(control, count, 1.0)
    length = spline.arc_length_flat(control, count)
    start = spline.starts(count)
    for i in range(3):
        mine = points[piece == i]
        chord = (mine[1:] - mine[:-1]).norm(dim=-1)
        assert 0 <= len(mine) - math.ceil(length[i].item()) <= 3
        assert chord.max() <= 1.0 + 1e-9
        # chords are shorter than the arcs they span only where the curve bends within a metre
        assert t[piece == i].diff().min() > 0
        torch.testing.assert_close(mine[0], control[start[i]])
        torch.testing.assert_close(mine[-1], control[start[i] + count[i] - 1])
        between = spline.parameter_at_length_flat(
            control, count, torch.arange(3, dtype=torch.float64), torch.full((3,), i)
        )
        assert between[0].item() == 0


def test_parameter_at_length_undoes_length(generator):
    control = road(7, generator)
    count = torch.tensor([7])
    length = spline.arc_length(control)
    along = rand(generator, 50) * length
    t = spline.parameter_at_length_flat(control, count, along, torch.zeros(50, dtype=torch.long))
    for want, end in zip(along.tolist()[:10], t.tolist()[:10], strict=True):
        part = spline.evaluate(control, torch.linspace(0, end, 20_001, dtype=torch.float64))
        assert (part[1:] - part[:-1]).norm(dim=-1).sum().item() == pytest.approx(want, abs=1e-4)


def test_resampling_keeps_the_curve_and_evens_the_knots(generator):
    control = road(12, generator)
    denser = spline.resample(control, 40)
    assert denser.shape == (40, 3)
    t = torch.linspace(0, 39, 500, dtype=torch.float64)
    on_new = spline.evaluate(denser, t)
    on_old = spline.evaluate(control, spline.closest_parameter(control, on_new))
    assert (on_new - on_old).norm(dim=-1).max() < 0.02
    chord = (denser[1:] - denser[:-1]).norm(dim=-1)
    assert (chord.max() / chord.min()).item() < 1.02


def test_evaluation_differentiates_in_control_points_and_parameter(generator):
    control, t = randn(generator, 6, 3), rand(generator, 10) * 5
    by_control = torch.func.jacrev(lambda c: spline.evaluate(c, t))(control)
    expected = torch.einsum("mc,ij->micj", spline.basis(t, 6), torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(by_control, expected)
    by_t = vmap(jacfwd(lambda x: spline.evaluate(control, x[None])[0]))(t)
    torch.testing.assert_close(by_t, spline.derivative(control, t))


def test_nothing_in_nothing_out():
    control = torch.zeros(0, 3, dtype=torch.float64)
    count = torch.zeros(0, dtype=torch.long)
    t, piece = torch.zeros(0, dtype=torch.float64), torch.zeros(0, dtype=torch.long)
    assert spline.evaluate_flat(control, count, t, piece).shape == (0, 3)
    assert spline.fit_flat(control, piece, t, count).shape == (0, 3)
    assert spline.closest_parameter_flat(control, count, control, piece).shape == (0,)
    assert spline.sample_flat(control, count, 1.0)[0].shape == (0, 3)
    assert spline.arc_length_flat(control, count).shape == (0,)
    assert spline.principal_parameter(control, piece, count).shape == (0,)


def test_control_points_that_coincide_give_finite_results():
    control = torch.ones(3, 3, dtype=torch.float64)
    count = torch.tensor([3])
    point, t, _ = spline.sample_flat(control, count, 1.0)
    assert torch.equal(point, torch.ones(2, 3, dtype=torch.float64))
    assert t.tolist() == [0.0, 2.0]
    assert (
        spline.closest_parameter(control, torch.zeros(4, 3, dtype=torch.float64)).isfinite().all()
    )
    assert spline.resample(control, 5).isfinite().all()
