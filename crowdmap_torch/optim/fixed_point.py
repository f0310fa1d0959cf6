"""Where a map that is applied again and again ends, in a few applications."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

_FURTHEST = 64.0
"""Steps of the map, at most, that one extrapolation goes."""


def fixed_point(
    of: Callable[[Float[Tensor, "k n"]], Float[Tensor, "k n"]],
    start: Float[Tensor, "k n"],
    cycles: int,
    least: float,
    most: float,
) -> Float[Tensor, "k n"]:
    """The point that `of` leaves where it is, about `start`; its numbers are between `least` and `most`.

    Squared extrapolation of a map that comes nearer by the same share at every step, as expectation maximisation does
    (SQUAREM, step length S3; Varadhan and Roland, Simple and globally convergent methods for accelerating the convergence
    of any EM algorithm, 2008). Each of the `k` rows has a step length of its own; a cycle applies the map three times.
    """
    x = start
    tiny = torch.finfo(x.dtype).tiny
    for _ in range(cycles):
        once = of(x)
        change = once - x
        bend = of(once) - once - change
        size, curve = change.norm(dim=1, keepdim=True), bend.norm(dim=1, keepdim=True)
        # One step of the map where it is straight, or has ended.
        length = (size / curve.clamp_min(tiny)).clamp(1, _FURTHEST)
        x = of((x + 2 * length * change + length.square() * bend).clamp(least, most))
    return x
