"""Control points of splines, packed and as of a road, and one spline at a time, for the tests of splines."""

from __future__ import annotations

import torch
from torch import Tensor

from crowdmap_torch.geometry import spline_basis, spline_fit, spline_length


def randn(generator: torch.Generator, *shape: int) -> Tensor:
    """Normal numbers."""
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def rand(generator: torch.Generator, *shape: int) -> Tensor:
    """Numbers from 0 to 1."""
    return torch.rand(*shape, generator=generator, dtype=torch.float64)


def packed(generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
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


def alone(control: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Number of control points, parameters and spline of points on one spline, for the packed forms."""
    return torch.tensor([len(control)]), t, torch.zeros(len(t), dtype=torch.long)


def evaluate(control: Tensor, t: Tensor) -> Tensor:
    """Points of one spline."""
    return spline_basis.evaluate_flat(control, *alone(control, t))


def derivative(control: Tensor, t: Tensor) -> Tensor:
    """Derivatives of one spline by its parameter."""
    return spline_basis.derivative_flat(control, *alone(control, t))


def coefficients(control: Tensor) -> Tensor:
    """B-spline coefficients of one spline."""
    return spline_basis.to_coefficients_flat(control, torch.tensor([len(control)]))


def basis(t: Tensor, count: int) -> Tensor:
    """The matrix that takes `count` control points to the points of one spline."""
    return evaluate(torch.eye(count, dtype=t.dtype), t)


def fit(points: Tensor, count: int, t: Tensor) -> Tensor:
    """Control points of one spline fitted to points at known parameters."""
    piece = torch.zeros(len(points), dtype=torch.long)
    return spline_fit.fit_flat(points, piece, t, torch.tensor([count]))


def closest_parameter(control: Tensor, points: Tensor) -> Tensor:
    """Parameters of the points of one spline that are nearest to given points."""
    piece = torch.zeros(len(points), dtype=torch.long)
    return spline_fit.closest_parameter_flat(control, torch.tensor([len(control)]), points, piece)


def arc_length(control: Tensor) -> float:
    """Length of one spline [m]."""
    return spline_length.arc_length_flat(control, torch.tensor([len(control)])).item()
