"""What is known of cars before anything is seen: about as stated, about as other cars, and some of them far from it.

Numbers of a car are in units of the configuration's sigmas. Cars that run the same programs err alike: of the variance of
clocks, read-outs and detectors they have a share in common,

    x_c = m + d_c        m ~ N(0, h)        d_c ~ N(0, v_c)

With m marginalised, that of all cars is one row for each and one for each pair of them,

    sum_c a_c x_c^2 / A + sum_c<d h a_c a_d (x_c - x_d)^2 / A        a_c = 1 / v_c        A = 1 + h sum_c a_c

and of what cars have nothing in common in, mounts and lenses, h = 0. v_c = s^2 + f_c^2 - 1 times the share that is not in
common. The scale s is that of all cars, by kind, one at most (`calibration_scales`); f_c, one at least, is how far this one
is beyond what the configuration allows for: a mount that was knocked, the focal length of another lens.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from crowdmap_torch.adjustment.calibration import LOAD, Fleet, alike
from crowdmap_torch.optim.problem import CostTerm
from crowdmap_torch.residuals.pose import gauss_markov_start

_LEAST_APART = 1e-6
"""Share of the variance that cars have to themselves where all of it is said to be common."""


@dataclass(frozen=True)
class CalibrationScales:
    """How far cars are from the sigmas of the configuration."""

    of_kind: Float[Tensor, " kinds"]
    """By kind, for all cars: of what they have partly in common, of what they differ in."""
    far: Float[Tensor, "v k"]
    """By car and number, all variables beside each other: how far it is beyond the configuration's own."""

    def ratio_to(self, other: CalibrationScales) -> Float[Tensor, " n"]:
        """All of them in multiples of others."""
        return torch.cat((self.of_kind / other.of_kind, (self.far / other.far).flatten()))


@dataclass(frozen=True)
class Variances:
    """Prior variances of the numbers of cars, all variables beside each other."""

    own: Float[Tensor, "v k"]
    """Of what a car has to itself; of what was found before, of that."""
    apart: Float[Tensor, " k"]
    """The same of a new car as configured."""
    shared: Float[Tensor, " k"]
    """Of what all have in common."""
    is_new: Bool[Tensor, "v k"]
    """What was not found before: that alone has anything in common with other cars."""

    @property
    def of_cars(self) -> Float[Tensor, "v k"]:
        """Of each number by itself."""
        return self.own + torch.where(self.is_new, self.shared, 0.0)

    @property
    def rows(self) -> tuple[Float[Tensor, "v k"], Float[Tensor, "v k"]]:
        """Information of each car's row, and what that of a pair's row is the product of."""
        a = torch.where(self.is_new, 1 / self.own, 0.0)
        total = 1 + self.shared * a.sum(0)
        alone = torch.where(self.is_new, a / total, 1 / self.own)
        return alone, a * (self.shared / total).sqrt()


def variances(fleet: Fleet, scales: CalibrationScales) -> Variances:
    """Those by the configuration, the scales, and what was found before."""
    names, is_alike = fleet.variables, torch.cat([alike(n, fleet.config) for n in fleet.variables])
    is_alike = is_alike.to(scales.far.device)
    is_new = ~torch.cat([fleet.found_before[name] for name in names], dim=1)
    before = torch.cat([fleet.prior_sigma[name] for name in names], dim=1).square()
    square = _of_numbers(fleet, scales.of_kind).square()
    in_common = torch.where(is_alike, fleet.config.in_common, 0.0).to(square)
    apart = (1 - in_common).clamp_min(_LEAST_APART)
    # The mean of all cars stays as configured, whatever they differ in.
    mean = apart * (1 - square) / is_new.sum(0).clamp_min(1)
    shared = torch.where(is_alike, in_common + mean, 0.0)
    own = torch.where(is_new, apart * (square + scales.far.square() - 1), before)
    return Variances(own, apart, shared, is_new)


def priors(fleet: Fleet, scales: CalibrationScales) -> dict[str, CostTerm]:
    """Calibrations are about as stated, or as found before, and about as those of the other cars; loads are about 0."""
    terms: dict[str, CostTerm] = {}
    every = torch.arange(len(fleet.vehicles), device=fleet.velocity.device)
    first, second = torch.triu_indices(len(every), len(every), 1, device=every.device)
    if fleet.variables:
        alone, paired = variances(fleet, scales).rows
        wide = [fleet.expected[name].shape[1] for name in fleet.variables]
        parts = zip(fleet.variables, alone.split(wide, 1), paired.split(wide, 1), strict=True)
        for name, own, pair in parts:
            terms[f"{name}_prior"] = CostTerm(
                gauss_markov_start,
                ((name, every),),
                (fleet.expected[name],),
                own.sqrt(),
                takes_rows=True,
            )
            if len(first):
                terms[f"{name}_alike"] = CostTerm(
                    gauss_markov_start,
                    ((name, first), (name, second)),
                    weight=(pair[first] * pair[second]).sqrt(),
                    takes_rows=True,
                )
    if fleet.config.load_m:
        drives = torch.arange(len(fleet.of_journey), device=every.device)
        load = fleet.velocity.new_zeros(len(drives), 1)
        terms[f"{LOAD}_prior"] = CostTerm(
            gauss_markov_start, ((LOAD, drives),), (load,), torch.ones_like(load), takes_rows=True
        )
    return terms


def prior_sigmas(fleet: Fleet, scales: CalibrationScales) -> Float[Tensor, "v k"]:
    """1-sigma of what is known of every car before anything is seen, all variables beside each other."""
    return variances(fleet, scales).of_cars.sqrt()


def _of_numbers(fleet: Fleet, of_kind: Float[Tensor, " kinds"]) -> Float[Tensor, " k"]:
    """The scale of every number of a car."""
    count = torch.tensor([kind.at.stop - kind.at.start for kind in fleet.kinds])
    return of_kind.repeat_interleave(count.to(of_kind.device))
