"""Natural cubic splines with uniform knots t = 0 .. C - 1 (IV-D): the one module to import.

`spline_basis` evaluates them, `spline_fit` fits them to points, `spline_length` measures along
them.
"""

from crowdmap_torch.geometry.spline_basis import (
    basis,
    derivative,
    derivative_flat,
    evaluate,
    evaluate_flat,
    from_coefficients,
    from_coefficients_flat,
    rows,
    starts,
    to_coefficients,
    to_coefficients_flat,
    window,
    window_flat,
    window_with_curvature,
)
from crowdmap_torch.geometry.spline_fit import (
    bending,
    closest_parameter,
    closest_parameter_flat,
    fit,
    fit_flat,
    principal_parameter,
    refine_flat,
)
from crowdmap_torch.geometry.spline_length import (
    arc_length,
    arc_length_flat,
    parameter_at_length_flat,
    resample,
    resample_flat,
    sample_flat,
)

__all__ = [
    "arc_length",
    "arc_length_flat",
    "basis",
    "bending",
    "closest_parameter",
    "closest_parameter_flat",
    "derivative",
    "derivative_flat",
    "evaluate",
    "evaluate_flat",
    "fit",
    "fit_flat",
    "from_coefficients",
    "from_coefficients_flat",
    "parameter_at_length_flat",
    "principal_parameter",
    "refine_flat",
    "resample",
    "resample_flat",
    "rows",
    "sample_flat",
    "starts",
    "to_coefficients",
    "to_coefficients_flat",
    "window",
    "window_flat",
    "window_with_curvature",
]
