"""Lengths along splines, points at equal distances, and what all three modules of splines do at the margins."""

from __future__ import annotations

import math

import pytest
import torch
from worlds.curves import arc_length, closest_parameter, evaluate, rand, road

from crowdmap_torch.geometry import spline_basis, spline_fit, spline_length


def test_length_of_a_line_and_of_an_arc():
    line = torch.tensor([[0.0, 0, 0], [3.0, 4.0, 0], [6.0, 8.0, 0]], dtype=torch.float64)
    assert arc_length(line) == pytest.approx(10)
    angle = torch.linspace(0, math.pi / 2, 40, dtype=torch.float64)
    arc = 100 * torch.stack((angle.cos(), angle.sin(), 0 * angle), dim=-1)
    # natural ends straighten the first and last knots a little
    assert arc_length(arc) == pytest.approx(50 * math.pi, abs=1e-3)


def test_length_agrees_with_fine_chords(generator):
    control = road(10, generator)
    fine = evaluate(control, torch.linspace(0, 9, 100_001, dtype=torch.float64))
    chords = (fine[1:] - fine[:-1]).norm(dim=-1).sum().item()
    # five Gauss nodes on a quarter of a span
    assert arc_length(control) == pytest.approx(chords, abs=1e-5)


def test_samples_are_evenly_spaced_and_reach_both_ends(generator):
    count = torch.tensor([10, 2, 5])
    control = torch.cat([road(int(c), generator) for c in count])
    # knots that are not even at all
    control[2] = control[1] + 0.1 * (control[2] - control[1])
    points, t, piece = spline_length.sample_flat(control, count, 1.0)
    length = spline_length.arc_length_flat(control, count)
    start = spline_basis.starts(count)
    for i in range(3):
        mine = points[piece == i]
        chord = (mine[1:] - mine[:-1]).norm(dim=-1)
        assert 0 <= len(mine) - math.ceil(length[i].item()) <= 3
        assert chord.max() <= 1.0 + 1e-9
        # chords are shorter than the arcs they span only where the curve bends within a metre
        assert t[piece == i].diff().min() > 0
        torch.testing.assert_close(mine[0], control[start[i]])
        torch.testing.assert_close(mine[-1], control[start[i] + count[i] - 1])
        between = spline_length.parameter_at_length_flat(
            control, count, torch.arange(3, dtype=torch.float64), torch.full((3,), i)
        )
        assert between[0].item() == 0


def test_parameter_at_length_undoes_length(generator):
    control = road(7, generator)
    count = torch.tensor([7])
    length = arc_length(control)
    along = rand(generator, 50) * length
    t = spline_length.parameter_at_length_flat(
        control, count, along, torch.zeros(50, dtype=torch.long)
    )
    for want, end in zip(along.tolist()[:10], t.tolist()[:10], strict=True):
        part = evaluate(control, torch.linspace(0, end, 20_001, dtype=torch.float64))
        assert (part[1:] - part[:-1]).norm(dim=-1).sum().item() == pytest.approx(want, abs=1e-4)


def test_nothing_in_nothing_out():
    control = torch.zeros(0, 3, dtype=torch.float64)
    count = torch.zeros(0, dtype=torch.long)
    t, piece = torch.zeros(0, dtype=torch.float64), torch.zeros(0, dtype=torch.long)
    assert spline_basis.evaluate_flat(control, count, t, piece).shape == (0, 3)
    assert spline_fit.fit_flat(control, piece, t, count).shape == (0, 3)
    assert spline_fit.closest_parameter_flat(control, count, control, piece).shape == (0,)
    assert spline_length.sample_flat(control, count, 1.0)[0].shape == (0, 3)
    assert spline_length.arc_length_flat(control, count).shape == (0,)
    assert spline_fit.principal_parameter(control, piece, count).shape == (0,)


def test_control_points_that_coincide_give_finite_results():
    control = torch.ones(3, 3, dtype=torch.float64)
    count = torch.tensor([3])
    point, t, _ = spline_length.sample_flat(control, count, 1.0)
    assert torch.equal(point, torch.ones(2, 3, dtype=torch.float64))
    assert t.tolist() == [0.0, 2.0]
    assert closest_parameter(control, torch.zeros(4, 3, dtype=torch.float64)).isfinite().all()
