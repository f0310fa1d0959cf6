"""Linear least squares whose every equation touches a few neighbouring unknowns: chains, smooth curves."""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.band_cholesky import cholesky_banded
from crowdmap_torch.processes.sums import add_at


def solve_banded(
    start: Int[Tensor, " m"],
    row: Float[Tensor, "m k"],
    target: Float[Tensor, "m r"],
    weight: Float[Tensor, " m"],
    count: int,
) -> Float[Tensor, "count r"]:
    """The unknowns x that minimise the weighted squares of `sum_j row[:, j] x[start + j] - target`.

    Unknowns of independent problems may stand one behind the other: without an equation that touches both they do not
    mix. Every unknown needs an equation. Columns of `target` are solved for at once.
    """
    width = row.shape[1]
    lower = row.new_zeros(count, width)
    rhs = row.new_zeros(count, target.shape[1])
    weighted = row * weight[:, None]
    for j in range(width):
        # Rows near the end may reach behind the last unknown with coefficients of zero.
        at = (start + j).clamp_max(count - 1)
        add_at(rhs, 0, at, weighted[:, j, None] * target)
        for i in range(j, width):
            add_at(lower[:, i - j], 0, at, weighted[:, j] * row[:, i])
    factor = cholesky_banded(lower)
    if factor is None:
        raise ArithmeticError("an unknown is in no equation")
    return factor.solve(rhs)
