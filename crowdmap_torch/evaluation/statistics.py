"""Mean, median, 95th percentile and spread of errors."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class ErrorFigures:
    """What is told of a set of errors; NaN where there are none."""

    mean: float
    median: float
    p95: float
    """95th percentile, interpolated linearly."""
    std: float
    """1-sigma about the mean."""
    count: int


def error_figures(error: Float[Tensor, " n"]) -> ErrorFigures:
    """Mean, median, 95th percentile and spread of errors; what is not finite is unknown and left out."""
    known = error[error.isfinite()]
    if len(known) == 0:
        return ErrorFigures(math.nan, math.nan, math.nan, math.nan, 0)
    # torch.quantile refuses more than 16 million elements; a sorted copy has no such limit.
    ordered = known.sort().values
    return ErrorFigures(
        mean=float(ordered.mean()),
        median=_quantile(ordered, 0.5),
        p95=_quantile(ordered, 0.95),
        std=float(ordered.std(correction=0)),
        count=len(ordered),
    )


@dataclass(frozen=True)
class PositionFigures:
    """Errors of positions [m]: Euclidean, and its horizontal and vertical part."""

    total: ErrorFigures
    horizontal: ErrorFigures
    vertical: ErrorFigures


def position_figures(
    error_world: Float[Tensor, "n k 3"], mask: Bool[Tensor, "n k"], row_known: Bool[Tensor, " n"]
) -> PositionFigures:
    """Figures over rows of the mean length of each row's error vectors in `mask`."""
    total, horizontal, vertical = mean_lengths(error_world, mask)
    return PositionFigures(
        total=error_figures(total[row_known]),
        horizontal=error_figures(horizontal[row_known]),
        vertical=error_figures(vertical[row_known]),
    )


def mean_lengths(
    error_world: Float[Tensor, "n k 3"], mask: Bool[Tensor, "n k"]
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Mean Euclidean, horizontal and vertical length of each row's error vectors in `mask`."""
    weight = mask.to(error_world) / mask.sum(-1, keepdim=True).clamp_min(1)
    return (
        (weight * error_world.norm(dim=-1)).sum(-1),
        (weight * error_world[..., :2].norm(dim=-1)).sum(-1),
        (weight * error_world[..., 2].abs()).sum(-1),
    )


def share(part: int, whole: int) -> float:
    """`part / whole`, NaN of nothing."""
    return part / whole if whole else math.nan


def _quantile(ordered: Float[Tensor, " n"], q: float) -> float:
    position = q * (len(ordered) - 1)
    low = math.floor(position)
    high = min(low + 1, len(ordered) - 1)
    return float(torch.lerp(ordered[low], ordered[high], position - low))
