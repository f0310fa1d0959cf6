"""Robust losses of the squared norm s of a whitened residual: rho(s), and the weight rho'(s)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol, TypeGuard, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import root_scalar
from scipy.special import gammainc
from torch import Tensor

from crowdmap_torch.optim.shared_errors import cut_between_runs
from crowdmap_torch.processes.sums import add_at, lasting, running_sum

_EFFICIENCY = 0.95
"""Of Tukey's weights at normal residuals with the usual c of 4.685 (Holland and Welsch 1977)."""


@runtime_checkable
class Loss(Protocol):
    """A loss with `rho(0) = 0` and `rho'(0) = 1`; the cost of an observation is `rho(s) / 2`."""

    def rho(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """The loss of the squared norm `s`."""
        ...

    def weight(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """`d rho / d s`, 1 for a perfect fit, towards 0 for an outlier."""
        ...


@runtime_checkable
class JointLoss(Loss, Protocol):
    """A loss of several adjacent rows together, so that rows are not free to be cut anywhere."""

    def of_rows(self, index: slice | Tensor) -> JointLoss:
        """The loss of some of its rows; those that belong together are to stay together."""
        ...

    def cut(self, start: int, stop: int) -> int:
        """Where a piece from `start`, where rows may be parted, may end: at most at `stop`, if any place is there."""
        ...


def is_joint(loss: Loss) -> TypeGuard[JointLoss]:
    """Whether it is one of several rows together."""
    return _of_rows_together(type(loss))


@lru_cache(maxsize=64)
def _of_rows_together(kind: type) -> bool:
    """Looked up once for each class: to compare a class with a protocol takes a tenth of a millisecond."""
    return issubclass(kind, JointLoss)


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

    c: float | Float[Tensor, "*batch"] = 4.685
    least: float = 0.0
    """Weight that is left to all observations, such as of what nothing else holds."""

    def rho(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """`c^2 / 3 (1 - (1 - s / c^2)^3)` up to `c^2`, constant beyond, and `least s`."""
        inside = (1 - s / self.c**2).clamp_min(0)
        bounded = self.c**2 / 3 * (1 - inside * inside * inside)
        return bounded + self.least * s if self.least else bounded

    def weight(self, s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """`(1 - s / c^2)^2` up to `c^2`, zero beyond, and `least`."""
        bounded = (1 - s / self.c**2).clamp_min(0).square()
        return bounded + self.least if self.least else bounded


@dataclass(frozen=True)
class JointTukey:
    """Tukey's biweight of the rows of a whole detection: its corners stand or fall together.

    With the same efficiency a detection of four corners is given up at half the cost that its corners one by one would
    be: what is wrong with a detection is mostly wrong with all of it, and the more there is to say against it.
    """

    run: Int[Tensor, " m"]
    """The detection of each row, counted up by one along the rows."""
    share: Float[Tensor, " m"]
    """One over the number of rows of each row's detection."""
    c: Float[Tensor, " m"]
    """Bound of each row's detection in standard deviations."""
    gain: Float[Tensor, " m"]
    """Factor on the loss of each row's detection."""
    row_dim: int
    """Numbers that each row consists of."""

    @classmethod
    def by_efficiency(
        cls, label: Int[Tensor, " m"], c: Float[Tensor, ""], *, row_dim: int
    ) -> JointTukey:
        """Bounds as efficient for the `row_dim` numbers of each of a detection's rows as `c` is for one number.

        The rows of a detection are adjacent and have the same `label`.
        """
        _, run, count = torch.unique_consecutive(label, return_inverse=True, return_counts=True)
        sizes = range(1, int(count.max()) + 1 if len(count) else 1)
        ratio = c.new_tensor([1.0] + [_bound(row_dim * size) / _bound(1) for size in sizes])
        count = count[run]
        gain = torch.ones_like(c).expand(len(run))
        return cls(run, 1 / count.to(c), c * ratio[count], gain, row_dim)

    def informative(self) -> JointTukey:
        """The same weights, raised so that in the mean over normal residuals they are the information that is kept.

        As they are they lower the Gauss-Newton Hessian by more than the estimate loses: covariances would be too large.
        """
        kinds, kind = torch.unique(torch.stack((self.c, self.share)), dim=1, return_inverse=True)
        gain = []
        for c, share in kinds.T.tolist():
            mean_weight, efficiency = _at_normal(c, round(self.row_dim / share))
            gain.append(efficiency / mean_weight)
        return replace(self, gain=self.gain * self.c.new_tensor(gain)[kind])

    def without(self, given_up: Bool[Tensor, " m"]) -> JointTukey:
        """The loss to which the rows of some detections are of no account."""
        return replace(self, gain=self.gain * ~given_up)

    def wider(self, factor: Float[Tensor, " m"]) -> JointTukey:
        """The loss with the bounds of each row's detection so much further out."""
        return replace(self, c=self.c * factor)

    def rho(self, s: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
        """The loss of each row's detection, an equal share for every row of it."""
        return self.gain * self.share * Tukey(self.c).rho(self._together(s))

    def weight(self, s: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
        """The weight of each row's detection."""
        return self.gain * Tukey(self.c).weight(self._together(s))

    def of_rows(self, index: slice | Tensor) -> JointTukey:
        """The loss of some whole detections."""
        run = self.run[index]
        if isinstance(index, Tensor):
            _, run = torch.unique_consecutive(run, return_inverse=True)
        return JointTukey(run, self.share[index], self.c[index], self.gain[index], self.row_dim)

    def cut(self, start: int, stop: int) -> int:
        """The last beginning of a detection behind `start` and up to `stop`, or else the first behind that."""
        return cut_between_runs(self.run, start, stop)

    def _together(self, s: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
        """The sum over each row's detection."""
        if not len(s):
            return s
        own = lasting("own", lambda: self.run - self.run[0], self.run)
        # As many as there are rows are enough: how many there are is not asked for, which would stop a GPU.
        total = torch.zeros_like(s)
        return add_at(total, 0, own, s)[own]


@lru_cache(maxsize=64)
def _bound(dim: int) -> float:
    """Tukey's c for the length of `dim` numbers that has the efficiency of 4.685 for one."""
    found = root_scalar(lambda c: _at_normal(c, dim)[1] - _EFFICIENCY, bracket=(4.0, 4.0 + 2 * dim))
    return float(found.root)


def _at_normal(c: float, dim: int) -> tuple[float, float]:
    """Of Tukey's weights at `dim` independent standard normal numbers: their mean, and their efficiency.

    The efficiency is by the asymptotic variance of a location (Maronna, Martin and Yohai, Robust Statistics, chapter 6).
    """

    def moment(k: int) -> float:
        """Of the squared length up to the bound: the k-th one, as a chi-squared with more degrees of freedom."""
        factor = 1.0
        for i in range(k):
            factor *= dim + 2 * i
        return factor * float(gammainc(dim / 2 + k, c * c / 2))

    below = [moment(k) / c ** (2 * k) for k in range(6)]
    mean = below[0] - 2 * below[1] + below[2]
    slope = mean - 4 / dim * (below[1] - below[2])
    square = c * c / dim * (below[1] - 4 * below[2] + 6 * below[3] - 4 * below[4] + below[5])
    return mean, slope**2 / square


def median_along(value: Float[Tensor, ...], dim: int) -> Float[Tensor, ...]:
    """As `Tensor.median(dim).values`, which torch has on a GPU only in no fixed order."""
    ranked = value.sort(dim=dim).values
    middle = ranked.select(dim, (value.shape[dim] - 1) // 2)
    last = ranked.select(dim, -1)
    return torch.where(last.isnan(), last, middle)


def median_scale(residual: Float[Tensor, " n"], *, floor: float = 0.0) -> Float[Tensor, ""]:
    """Robust standard deviation: 1.4826 times the median absolute value, at least `floor`."""
    if not len(residual):
        return residual.new_tensor(floor)
    return (1.4826 * residual.abs().median()).clamp_min(floor)


def usual(
    value: Float[Tensor, " n"], weight: Float[Tensor, " n"], *, assumed: float, beside: float
) -> float:
    """Median of values by their weights, beside the weight of what is `assumed` where few values tell."""
    every, order = torch.cat((value, value.new_full((1,), assumed))).sort()
    below = running_sum(torch.cat((weight, weight.new_full((1,), beside)))[order])
    return float(every[torch.searchsorted(below, below[-1:] / 2)])
