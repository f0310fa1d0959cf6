"""What an adjustment found of each car's calibration, how sure it is, and what could not be seen."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.adjustment import calibration
from crowdmap_torch.adjustment.bundle import Bundle
from crowdmap_torch.adjustment.calibration_priors import prior_sigmas
from crowdmap_torch.optim.solvers.normal_equations import MapCovariance

UNSEEN = 0.7
"""A number whose posterior sigma is above this share of its prior's has hardly been seen."""
_CONFOUNDED = 0.9
"""Two numbers of a car with a larger correlation cannot be told apart."""
_AXES = {1: ("",), 2: (" u", " v"), 3: (" x", " y", " z")}
"""What the numbers of a parameter are called."""


@dataclass(frozen=True)
class CarCalibration:
    """Of one car; by parameter of `CalibrationConfig`, in its units."""

    estimate: dict[str, tuple[float, ...]]
    """The truth minus what rig.yaml says, most likely."""
    sigma: dict[str, tuple[float, ...]]
    prior_sigma: dict[str, tuple[float, ...]]
    """The configuration's, by as much wider or narrower as the fleet shows, or that which it was found with before."""
    unseen: tuple[str, ...]
    """Numbers that are as unsure as before."""
    confounded: tuple[tuple[str, str, float], ...]
    """Numbers that cannot be told apart, with their correlation, the largest first."""

    def ratio(self, name: str) -> tuple[float, ...]:
        """Posterior over prior sigma of a parameter's numbers: near 0 it is seen, near 1 it is not."""
        return tuple(s / p for s, p in zip(self.sigma[name], self.prior_sigma[name], strict=True))


FleetCalibration = dict[str, CarCalibration]
"""By car: a `vehicle_id`, or a rig."""


def found_calibration(bundle: Bundle, covariance: MapCovariance) -> FleetCalibration:
    """Of every car of a bundle, at its values; `covariance` is that of its normal equations there."""
    fleet, values = bundle.fleet, bundle.values()
    if not fleet.variables:
        return {}
    joint = covariance.of_border(*fleet.variables)
    value = torch.cat([values[name] for name in fleet.variables], dim=1)
    unit, labels, places, first = [], [], {}, 0
    for variable in fleet.variables:
        for name, at in calibration.columns(variable, fleet.config).items():
            count = at.stop - at.start
            places[name] = slice(first, first + count)
            first += count
            unit += [getattr(fleet.config, name)] * count
            labels += [f"{name}{axis}" for axis in _AXES[count]]
    scale = value.new_tensor(unit)
    prior = prior_sigmas(fleet, bundle.calibration_scales)
    sigma = joint.diagonal(dim1=-2, dim2=-1).clamp_min(0).sqrt()
    found = {}
    for car, name in enumerate(fleet.vehicles):
        numbers = {
            part: {key: tuple(row[at].tolist()) for key, at in places.items()}
            for part, row in (
                ("estimate", value[car] * scale),
                ("sigma", sigma[car] * scale),
                ("prior_sigma", prior[car] * scale),
            )
        }
        unseen = (sigma[car] > UNSEEN * prior[car]).tolist()
        found[name] = CarCalibration(
            **numbers,
            unseen=tuple(label for label, is_so in zip(labels, unseen, strict=True) if is_so),
            confounded=_confounded(joint[car], labels),
        )
    return found


def sigma_of_mean(bundle: Bundle, covariance: MapCovariance) -> dict[str, tuple[float, ...]]:
    """1-sigma of the mean over all cars of a bundle, by parameter, in the units of `CalibrationConfig`.

    Cars err together in what they are told by together, signs and lanes, and in what nothing tells: were all of them wrong
    by as much, some of it would go into the map.
    """
    found = {}
    for variable in bundle.fleet.variables:
        of_mean = covariance.of_border_mean(variable).diagonal().clamp_min(0).sqrt()
        for name, at in calibration.columns(variable, bundle.fleet.config).items():
            found[name] = tuple((of_mean[at] * getattr(bundle.fleet.config, name)).tolist())
    return found


def _confounded(
    covariance: Float[Tensor, "k k"], labels: list[str]
) -> tuple[tuple[str, str, float], ...]:
    scale = covariance.diagonal().clamp_min(1e-300).rsqrt()
    correlation = scale[:, None] * covariance * scale
    pairs = torch.nonzero(correlation.tril(-1).abs() > _CONFOUNDED).tolist()
    named = [(labels[j], labels[i], float(correlation[i, j])) for i, j in pairs]
    return tuple(sorted(named, key=lambda pair: -abs(pair[2])))
