"""Robust losses of the squared norm s of a whitened residual: rho(s), and the weight rho'(s)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor


@runtime_checkable
class Loss(Protocol):
    """A loss with `rho(0) = 0` and `rho'(0) = 1`; the cost of an observation is `rho(s) / 2`."""

    def rho(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """The loss of the squared norm `s`."""
        ...

    def weight(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """`d rho / d s`, 1 for a perfect fit, towards 0 for an outlier."""
        ...


@dataclass(frozen=True)
class Quadratic:
    """Plain least squares."""

    def rho(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """`s` itself."""
        return s

    def weight(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """One for every observation."""
        return torch.ones_like(s)


@dataclass(frozen=True)
class Huber:
    """Quadratic up to `c` standard deviations, linear beyond (Huber 1964)."""

    c: float = 1.345

    def rho(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """`s` below `c^2`, `2 c sqrt(s) - c^2` above."""
        bound = self.c**2
        return torch.where(s <= bound, s, 2 * self.c * s.clamp_min(bound).sqrt() - bound)

    def weight(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """`min(1, c / sqrt(s))`."""
        return self.c / s.clamp_min(self.c**2).sqrt()


@dataclass(frozen=True)
class Tukey:
    """Tukey's biweight: an observation beyond `c` standard deviations has no say (V-B; Zhang 1997)."""

    c: float = 4.685

    def rho(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """`c^2 / 3 (1 - (1 - s / c^2)^3)` up to `c^2`, constant beyond."""
        inside = (1 - s / self.c**2).clamp_min(0)
        return self.c**2 / 3 * (1 - inside * inside * inside)

    def weight(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """`(1 - s / c^2)^2` up to `c^2`, zero beyond."""
        return (1 - s / self.c**2).clamp_min(0).square()


def median_scale(residual: Float[Tensor, " n"], *, floor: float = 0.0) -> Float[Tensor, ""]:
    """Robust standard deviation: 1.4826 times the median absolute value, at least `floor`."""
    if not len(residual):
        return residual.new_tensor(floor)
    return (1.4826 * residual.abs().median()).clamp_min(floor)
