"""What positioning modules say of their own errors, drive by drive, and what is taken for it where they say nothing."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.optim.robust import median_along
from crowdmap_torch.tables import Journey

LEAST_SIGMA_M = 1e-3
"""What carrier phases leave under the open sky of a receiver that stands still: who states less states nothing."""
LEAST_SIGMA_RAD = 1e-5
"""Likewise of rotations: two seconds of arc, a theodolite's."""


def stated_sigmas(journey: Journey) -> tuple[Float[Tensor, " 3"] | None, Float[Tensor, ""] | None]:
    """The module's own sigmas of position [m] and rotation [rad], the medians of its frames; None where it states none.

    A sigma of zero, or below what any receiver or gyro can know of where it is, is no statement.
    """
    position, rotation = journey.sigma_position, journey.sigma_rotation
    if position is not None:
        position = median_along(position, 0)
        position = position if bool((position >= LEAST_SIGMA_M).all()) else None
    if rotation is not None:
        rotation = rotation.median()
        rotation = rotation if bool(rotation >= LEAST_SIGMA_RAD) else None
    return position, rotation


def sigmas_of(
    journey: Journey, positioning: PositioningNoise, like: Tensor
) -> tuple[Float[Tensor, " 6"], Float[Tensor, " 6"]]:
    """Sigmas of bias and drift of one journey, as its module or else `positioning` gives them."""
    drift = like.new_tensor([positioning.drift_sigma_m] * 3)
    bias = like.new_tensor(positioning.bias_sigma_m)
    turn = like.new_tensor([positioning.rotation_sigma_rad] * 3)
    tilt = like.new_tensor([positioning.bias_sigma_rad] * 3)
    # The module gives the sigma of both together; of a small one the drift takes half.
    position, rotation = stated_sigmas(journey)
    if position is not None:
        total = position.to(like).square()
        drift = torch.minimum(drift.square(), total / 2).sqrt()
        bias = (total - drift.square()).sqrt()
    if rotation is not None:
        total = rotation.to(like).square()
        tilt = torch.minimum(tilt.square(), total / 2).sqrt()
        turn = (total - tilt.square()).sqrt()
    return torch.cat((bias, tilt)), torch.cat((drift, turn))
