"""How far cars are from their rig.yaml, kind by kind of what they may have wrong: by evidence, not as configured alone.

The sigmas of a configuration are those of cars that have such errors. A fleet that has none would pay for them: what nobody
has wrong is looked for, and takes some of what poses have. So the sigmas of each kind are multiplied by a scale that the
fleet shows (automatic relevance; MacKay, Bayesian Interpolation, 1992). Of numbers x with the prior N(0, s^2), all else
that is unknown marginalised, the adjustment finds the mean x and the covariance P. In the axes of P images tell l = 1 / P
- 1 / s^2 and b = x / P of them, and any scale s has the evidence

    log p(s) = sum (b^2 s^2 / (1 + l s^2) - log(1 + l s^2)) / 2 - s^2 / 2

The last is a half-normal prior: E[s^2] = 1, so that what nothing tells stays as configured, and it is flat at zero, so
that few cars suffice to show that they have no such error (Gelman, Prior distributions for variance parameters, 2006).
No largest p(s) is run to: the scale is the one at which as many numbers are well determined, sum l s^2 / (1 + l s^2), as
in the mean over all s. What all cars show alike has no say, in either direction: it may be an error of poses that nobody
models. So the numbers are those that cars differ in, one car has no scale, and of what cars have partly in common their
mean stays as configured. Nor is a scale ever more than one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.calibration import Fleet, variances
from crowdmap_torch.optim.solvers.normal_equations import BorderInformation

_SCALES = (0.02, 6.0, 100)
"""Least, largest and number of the scales that are compared; 6 has 1e-8 of the half-normal's density."""
_LEAST_TOLD = 1e-9
"""Information, in units of the prior's, below which a number is not told at all."""
_SWEEPS, _RESTS = 20, 0.02
"""Alternations between scales and what is found with them, at most; the change of a scale's logarithm that ends them."""


@dataclass(frozen=True)
class Differences:
    """What cars differ in, in the numbers of one kind."""

    kind: int
    row: Int[Tensor, "cars k"]
    """Where the kind's numbers are among all of the cars."""
    basis: Float[Tensor, "cars q"]
    """Orthonormal, at right angles to the mean: differences are sums over cars with these weights."""
    of_prior: Float[Tensor, "cars cars"]
    """What is scaled of the prior: 1 / variance times the axes that it is the variance along."""
    variance: float
    """Of each difference, by the configuration."""

    def of(self, of_all: Float[Tensor, " n"]) -> Float[Tensor, " m"]:
        """The differences."""
        return (self.basis.mT @ of_all[self.row]).flatten()

    def covariance(self, of_all: Float[Tensor, "n n"]) -> Float[Tensor, "m m"]:
        """Theirs, from that of all numbers."""
        cars, k = self.row.shape
        at = self.row.flatten()
        joint = of_all[at[:, None], at].view(cars, k, cars, k)
        part = torch.einsum("aq,aibj,br->qirj", self.basis, joint, self.basis)
        return part.reshape(self.basis.shape[1] * k, -1)


def rescaled(
    fleet: Fleet,
    values: Mapping[str, Tensor],
    border: BorderInformation,
    scale: Float[Tensor, " kinds"],
) -> Float[Tensor, " kinds"]:
    """By kind, what the sigmas of what cars have wrong are to be multiplied by: one at most.

    `values` were found with the `scale` given, by the information `border`, which has the prior in it. What was found
    before keeps the sigma that it was found with, and has no say.
    """
    names, each = fleet.variables, _differences(fleet, values)
    if not each:
        return scale
    told, value = border.on(*names), torch.cat([values[name].flatten() for name in names])
    seen = told @ value
    told = told - _scaled_information(each, scale, value)
    found = scale.clone()
    for _ in range(_SWEEPS):
        covariance = torch.linalg.inv(told + _scaled_information(each, found, value))
        value, before = covariance @ seen, found.clone()
        for one in each:
            found[one.kind] = scale_of(
                one.of(value) / math.sqrt(one.variance),
                one.covariance(covariance) / one.variance,
                before[one.kind],
            ).clamp_max(1)
        if bool(((found / before).log().abs() < _RESTS).all()):
            break
    return found


def prior_sigmas(fleet: Fleet, scale: Float[Tensor, " kinds"]) -> dict[str, Float[Tensor, "v _"]]:
    """1-sigma of what is known of every car before anything is seen, by variable, with the scales that the fleet shows."""
    found = {name: sigma.clone() for name, sigma in fleet.prior_sigma.items()}
    for kind, own in zip(fleet.kinds, scale, strict=True):
        new = fleet.new(kind)
        if not len(new):
            continue
        of_car = own.square()
        if kind.alike:
            cars = len(new)
            apart, together = variances(scale.new_tensor(cars), fleet.config.in_common)
            of_car = (apart * of_car * (cars - 1) + together) / cars
        found[kind.variable][new, kind.at] *= of_car.sqrt()
    return found


def scale_of(
    value: Float[Tensor, " n"], covariance: Float[Tensor, "n n"], scale: Float[Tensor, ""]
) -> Float[Tensor, ""]:
    """What the sigmas of numbers that are 1 as configured are to be multiplied by.

    `value` and `covariance` are what was found of them with sigmas of `scale`.
    """
    left, axes = torch.linalg.eigh(covariance)
    left = left.clamp_min(1e-12)
    told = (1 / left - scale**-2).clamp_min(_LEAST_TOLD)
    mean = (axes.mT @ value / left).square()
    least, most, count = _SCALES
    like = {"dtype": value.dtype, "device": value.device}
    s = torch.linspace(math.log(least), math.log(most), count, **like).exp()
    square = s.square()[:, None]
    gain = 1 + told * square
    evidence = (mean * square / gain - gain.log()).sum(1) / 2 - s.square() / 2
    # Steps of even logarithms are as wide as the scale is large.
    weight = torch.softmax(evidence + s.log(), 0)
    determined = (told * square / gain).sum(1)
    wanted = (weight * determined).sum()
    behind = torch.searchsorted(determined, wanted[None]).clamp(1, count - 1)
    around = torch.cat((behind - 1, behind))
    below, above = determined[around].unbind(0)
    low, high = s[around].unbind(0)
    return low * (high / low) ** ((wanted - below) / (above - below))


def _differences(fleet: Fleet, values: Mapping[str, Tensor]) -> list[Differences]:
    """Of every kind that is new of two cars or more."""
    first, offset = 0, {}
    for name in fleet.variables:
        offset[name] = first
        first += values[name].numel()
    found = []
    for number, kind in enumerate(fleet.kinds):
        new, wide = fleet.new(kind), values[kind.variable].shape[1]
        if len(new) < 2:
            continue
        column = torch.arange(kind.at.start, kind.at.stop, device=new.device)
        row = offset[kind.variable] + new[:, None] * wide + column
        like = values[kind.variable]
        eye = torch.eye(len(new), dtype=like.dtype, device=like.device)
        # Whatever is at right angles to the mean.
        basis = torch.linalg.qr(torch.cat((torch.ones_like(eye[:, :1]), eye[:, 1:]), dim=1)).Q
        basis, variance, of_prior = basis[:, 1:], 1.0, eye
        if kind.alike:
            variance, _ = variances(eye.new_tensor(len(new)), fleet.config.in_common)
            of_prior = basis @ basis.mT / variance
        found.append(Differences(number, row, basis, of_prior, variance))
    return found


def _scaled_information(
    each: list[Differences], scale: Float[Tensor, " kinds"], like: Float[Tensor, " n"]
) -> Float[Tensor, "n n"]:
    """What the prior says, as far as it goes by the scales."""
    found = like.new_zeros(len(like), len(like))
    for one in each:
        for row in one.row.unbind(1):
            found[row[:, None], row] += one.of_prior / scale[one.kind].square()
    return found
