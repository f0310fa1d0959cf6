"""Tridiagonal systems along long rows, all rows at once: cyclic reduction in parallel.

Hockney (A fast direct solution of Poisson's equation using Fourier analysis, JACM 1965); Hockney and Jesshope, Parallel
Computers (1981), on reduction in parallel, which eliminates both neighbours of every row, those twice as far away each time.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def solve_tridiagonal(
    diagonal: Float[Tensor, "n ..."],
    beside: Float[Tensor, "n ..."],
    right: Float[Tensor, "n ..."],
    longest: int,
) -> Float[Tensor, "n ..."]:
    """The x of symmetric systems A x = `right` that lie one behind the other along the first axis.

    `beside` joins each row with the next one, and is zero behind the last of a system; none has more rows than `longest`. A
    is positive definite: rows are not exchanged.
    """
    before, behind = _moved(beside, 1, 0.0), beside
    apart = 1
    while apart < min(longest, len(right)):
        of_before = -before / _moved(diagonal, apart, 1.0)
        of_behind = -behind / _moved(diagonal, -apart, 1.0)
        diagonal = diagonal + of_before * _moved(behind, apart, 0.0)
        diagonal = diagonal + of_behind * _moved(before, -apart, 0.0)
        right = (
            right + of_before * _moved(right, apart, 0.0) + of_behind * _moved(right, -apart, 0.0)
        )
        before = of_before * _moved(before, apart, 0.0)
        behind = of_behind * _moved(behind, -apart, 0.0)
        apart *= 2
    return right / diagonal


def _moved(value: Float[Tensor, "n ..."], rows: int, fill: float) -> Float[Tensor, "n ..."]:
    """The value so many rows before each one; after it, if that is negative."""
    beyond = value.new_full((abs(rows), *value.shape[1:]), fill)
    parts = (beyond, value[:-rows]) if rows > 0 else (value[-rows:], beyond)
    return torch.cat(parts)
