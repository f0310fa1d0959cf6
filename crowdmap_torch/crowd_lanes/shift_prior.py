"""What is known of a group's shift before lanes say anything: how large biases are, and where signs that are alike stand."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.crowd_signs.groups import OtherPlaces

_FREEDOM = 4.0
"""Degrees of freedom of shifts, as Student's t has them: a few drives tell little of how large biases are."""


@dataclass(frozen=True)
class ShiftPrior:
    """The prior of a group's shift, and for a drive that signs tie loosely what its signs say of it."""

    sigma: Float[Tensor, " 3"]
    """Of the shift, by axis [m]."""
    loose: OtherPlaces | None
    move: Float[Tensor, "j 3"]
    """By how much journeys have been moved, and the drive itself with those that have seen its own heads [m]."""

    def logs(
        self, grid: Float[Tensor, "x y 2"], *, sign_noise_m: float, sign_missed: float
    ) -> Float[Tensor, "x y"]:
        """The logarithms of the prior of shifts [m], but for a constant.

        A sign may be any of those that are like it, each with an error of `sign_noise_m`; it is none of them with a
        likelihood of `sign_missed`.
        """
        if self.loose is None:
            return self._of_bias(grid)
        loose = self.loose
        own = self.move[loose.journey, :2]
        shift = loose.shift + self.move[loose.host, :2] - own
        away = (grid - shift[:, None, None]).square().sum(-1) / sign_noise_m**2
        sign, row = torch.unique(loose.sign, return_inverse=True)
        fit = grid.new_zeros(len(sign), *grid.shape[:2])
        fit.scatter_reduce_(0, row[:, None, None].expand_as(away), (-away / 2).exp(), "amax")
        said = (sign_missed + fit).log().sum(0)
        return said + self._of_bias(grid - loose.bias[0] + own[0])

    def _of_bias(self, shift: Float[Tensor, "x y 2"]) -> Float[Tensor, "x y"]:
        odds = (1 + (shift / self.sigma[:2]).square().sum(-1) / _FREEDOM).log()
        return -(_FREEDOM + 2) / 2 * odds
