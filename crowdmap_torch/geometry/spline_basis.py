"""Natural cubic splines on uniform knots t = 0 .. C - 1, in two forms (IV-D).

*Control points* are what the curve passes through at its knots (the paper's representation, and a
map's). *Coefficients* are those of the same curve in cubic B-splines: each point of the curve
depends on four of them only, which keeps a bundle adjustment sparse. `to_coefficients_flat` and
`from_coefficients_flat` change between the two; both have C rows, because the natural ends (no
curvature) fold the two outer coefficients into their neighbours, `c_-1 = 2 c_0 - c_1`.

Functions ending in `_flat` take many splines at once, their rows packed one spline after the other,
`count[i]` rows for spline i. Beyond its ends a spline goes on as a straight line. `spline_fit` fits
splines to points, `spline_length` measures along them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_Four = tuple[Tensor, Tensor, Tensor, Tensor]
_SOLVE_STEPS = 6
"""Of cyclic reduction: influence decays by 0.27 a knot, 2^6 knots away it is below rounding."""


def starts(count: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
    """First row of each of n packed splines."""
    return count.cumsum(0) - count


def rows(count: Int[Tensor, " n"]) -> tuple[Int[Tensor, " c"], Int[Tensor, " c"]]:
    """Spline and rank within it of each packed row."""
    spline = torch.repeat_interleave(torch.arange(len(count), device=count.device), count)
    return spline, torch.arange(len(spline), device=count.device) - starts(count)[spline]


def window(
    t: Float[Tensor, "*batch"], count: Int[Tensor, "*batch"] | int
) -> tuple[Int[Tensor, "*batch"], Float[Tensor, "*batch 4"], Float[Tensor, "*batch 4"]]:
    """Start, weights and their derivatives by t of the four coefficients that make up a point.

    The curve is the sum over k of `weight_k coefficient[start + k]`.
    `count` is the number of coefficients. With fewer than four the start is 0 and the slots past
    the last coefficient have weight 0 (do not read there: `window_flat` gives indices that are
    safe).
    """
    at = _place(t, count)
    first = at.folded(at.slopes)
    return at.start, at.folded(at.weights) + at.over[..., None] * first, first


def window_with_curvature(
    t: Float[Tensor, "*batch"], count: Int[Tensor, "*batch"] | int
) -> tuple[
    Int[Tensor, "*batch"],
    Float[Tensor, "*batch 4"],
    Float[Tensor, "*batch 4"],
    Float[Tensor, "*batch 4"],
]:
    """As `window`, with the second derivatives of the weights too."""
    at = _place(t, count)
    first, second = at.folded(at.slopes), at.folded(at.curvatures)
    # Straight on beyond the ends.
    second = torch.where((at.over != 0)[..., None], 0.0, second)
    return at.start, at.folded(at.weights) + at.over[..., None] * first, first, second


@dataclass(frozen=True)
class _Place:
    """Where on its spline a point is: in which span, how far into it, and how far beyond the ends."""

    u: Float[Tensor, "*batch"]
    over: Float[Tensor, "*batch"]
    start: Int[Tensor, "*batch"]
    before: Bool[Tensor, "*batch"]
    behind: Bool[Tensor, "*batch"]
    shift: Int[Tensor, "*batch"]

    @property
    def weights(self) -> _Four:
        """Of the coefficients around the span, those before and behind the spline too."""
        u, v = self.u, 1 - self.u
        uu, vv = u * u, v * v
        return v * vv / 6, (4 - 3 * uu * (2 - u)) / 6, (4 - 3 * vv * (2 - v)) / 6, u * uu / 6

    @property
    def slopes(self) -> _Four:
        """Their derivatives by t, ..."""
        u, v = self.u, 1 - self.u
        return -(v * v) / 2, u * (3 * u - 4) / 2, v * (4 - 3 * v) / 2, u * u / 2

    @property
    def curvatures(self) -> _Four:
        """... and the second ones."""
        u, v = self.u, 1 - self.u
        return v, 3 * u - 2, 3 * v - 2, u

    def folded(self, four: _Four) -> Float[Tensor, "*batch 4"]:
        """The weights of the four slots that are read."""
        return _folded(four, self.before, self.behind, self.shift)


def _place(t: Float[Tensor, "*batch"], count: Int[Tensor, "*batch"] | int) -> _Place:
    last = torch.as_tensor(count, device=t.device) - 1
    inside = torch.minimum(t.clamp_min(0), last.to(t))
    span = torch.minimum(inside.detach().floor().long(), last - 1).clamp_min(0)
    u = inside - span
    over = t - inside
    # Of the coefficients from span - 1 to span + 2 the first may be before the spline and the last behind it: such a ghost
    # is its neighbour twice, less the next. What is left of four begins one further on, or before.
    start = torch.minimum(span - 1, last - 3).clamp_min(0)
    before, behind, shift = span == 0, span == last - 1, start - span + 1
    return _Place(u, over, start, before, behind, shift)


def _folded(
    weight: Sequence[Float[Tensor, "*batch"]],
    before: Bool[Tensor, "*batch"],
    behind: Bool[Tensor, "*batch"],
    shift: Int[Tensor, "*batch"],
) -> Float[Tensor, "*batch 4"]:
    """The weights of four slots, from those of four coefficients of which the first or the last may be a ghost."""
    first, second, third, fourth = weight
    ahead, after = torch.where(before, first, 0.0), torch.where(behind, fourth, 0.0)
    first, fourth = first - ahead, fourth - after
    second, third = second + 2 * ahead - after, third - ahead + 2 * after
    nothing = torch.zeros_like(first)
    padded = (nothing, first, second, third, fourth, nothing)
    on, back = shift > 0, shift < 0
    slots = zip(padded, padded[1:], padded[2:], strict=False)
    return torch.stack([torch.where(on, c, torch.where(back, a, b)) for a, b, c in slots], dim=-1)


def window_flat(
    t: Float[Tensor, " m"], start_of_spline: Int[Tensor, " m"], count_of_spline: Int[Tensor, " m"]
) -> tuple[Int[Tensor, "m 4"], Float[Tensor, "m 4"], Float[Tensor, "m 4"]]:
    """Rows of packed coefficients, weights and their derivatives by t, for points on many splines.

    The rows always belong to the point's own spline; those that pad a spline of two or three
    coefficients have weight 0.
    """
    start, weight, d_weight = window(t, count_of_spline)
    return _rows_of(start, start_of_spline, count_of_spline), weight, d_weight


def _rows_of(
    start: Int[Tensor, " m"], start_of_spline: Int[Tensor, " m"], count_of_spline: Int[Tensor, " m"]
) -> Int[Tensor, "m 4"]:
    slot = torch.arange(4, device=start.device)
    rank = torch.minimum(start[:, None] + slot, count_of_spline[:, None] - 1)
    return start_of_spline[:, None] + rank


def to_coefficients_flat(
    control: Float[Tensor, "c k"], count: Int[Tensor, " n"]
) -> Float[Tensor, "c k"]:
    """B-spline coefficients of packed splines that pass through `control`.

    The equations `c_(i-1) + 4 c_i + c_(i+1) = 6 p_i` are solved by parallel cyclic reduction: every
    row eliminates its neighbours 1, 2, 4, ... away at once. Rows of different splines never mix, as
    the first and last row of each have no neighbours.
    """
    _, rank = rows(count)
    spline_count = torch.repeat_interleave(count, count)
    interior = ((rank > 0) & (rank < spline_count - 1))[:, None]
    lower = torch.where(interior, 0.25, 0.0).to(control)
    upper = lower
    rhs = torch.where(interior, 1.5, 1.0).to(control) * control
    for step in (2**power for power in range(_SOLVE_STEPS)):
        # Rows are scaled to a unit diagonal throughout.
        before = tuple(_shifted(column, step) for column in (lower, upper, rhs))
        after = tuple(_shifted(column, -step) for column in (lower, upper, rhs))
        scale = 1 / (1 - lower * before[1] - upper * after[0])
        rhs = scale * (rhs - lower * before[2] - upper * after[2])
        lower, upper = -scale * lower * before[0], -scale * upper * after[1]
    return rhs


def from_coefficients_flat(
    coefficient: Float[Tensor, "c k"], count: Int[Tensor, " n"]
) -> Float[Tensor, "c k"]:
    """Points at the knots of packed splines, the inverse of `to_coefficients_flat`."""
    _, rank = rows(count)
    spline_count = torch.repeat_interleave(count, count)
    interior = ((rank > 0) & (rank < spline_count - 1))[:, None]
    neighbours = _shifted(coefficient, 1) + _shifted(coefficient, -1)
    return torch.where(interior, (neighbours + 4 * coefficient) / 6, coefficient)


def evaluate_flat(
    control: Float[Tensor, "c k"],
    count: Int[Tensor, " n"],
    t: Float[Tensor, " m"],
    spline: Int[Tensor, " m"],
) -> Float[Tensor, "m k"]:
    """Points at parameters t of packed splines; `spline` says which one each point is on."""
    row, weight, _ = window_flat(t, starts(count)[spline], count[spline])
    return _summed(row, weight, to_coefficients_flat(control, count))


def derivative_flat(
    control: Float[Tensor, "c k"],
    count: Int[Tensor, " n"],
    t: Float[Tensor, " m"],
    spline: Int[Tensor, " m"],
) -> Float[Tensor, "m k"]:
    """Derivatives by t of packed splines; `spline` says which one each point is on."""
    of_spline = count[spline]
    at = _place(t, of_spline)
    row = _rows_of(at.start, starts(count)[spline], of_spline)
    return _summed(row, at.folded(at.slopes), to_coefficients_flat(control, count))


def _summed(
    row: Int[Tensor, "m 4"], weight: Float[Tensor, "m 4"], coefficient: Float[Tensor, "c k"]
) -> Float[Tensor, "m k"]:
    return (weight[..., None] * coefficient[row]).sum(-2)


def _shifted(column: Tensor, step: int) -> Tensor:
    """Row i of the result is row `i - step`, zero where there is none."""
    size = min(abs(step), len(column))
    zero = torch.zeros_like(column[:size])
    if step > 0:
        return torch.cat((zero, column[: len(column) - size]))
    return torch.cat((column[size:], zero))
