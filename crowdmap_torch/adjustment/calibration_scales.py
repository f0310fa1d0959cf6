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

Some cars are further off than a configuration allows for: a mount that was knocked, a rig.yaml of another lens. What a car
has to itself is therefore not normal but has the tails of Student's t, as if each car's sigma were f times that of the
configuration; of n degrees of freedom, with the mean and the covariance that are found (expectation maximisation; Lange,
Little and Taylor, Robust Statistical Modeling Using the t Distribution, 1989),

    f^2 = (n + E[d^2]) / (n + 1)        1 at least

so that it is hardly held back by a prior that it has nothing to do with, and as unsure as that leaves it. Of cars that
are within a sigma f is one: a fleet that errs less than configured has scales and no tails. d is what a car has beyond
the cars' common share, or their median: of one car nothing, for the same reason. Ten drives past KITTI's signs by one
car, whose reference errs with all of them, were 0.43 m off where its calibration had tails of its own, 0.23 m without.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.adjustment.calibration import Fleet
from crowdmap_torch.adjustment.calibration_priors import CalibrationScales, Variances, variances
from crowdmap_torch.optim.solvers.normal_equations import BorderInformation

_SCALES = (0.02, 6.0, 100)
"""Least, largest and number of the scales that are compared; 6 has 1e-8 of the half-normal's density."""
_LEAST_TOLD = 1e-9
"""Information, in units of the prior's, below which a number is not told at all."""
_SWEEPS, _RESTS = 10, 0.02
"""Alternations between scales and what is found with them, at most; the change of a scale's logarithm that ends them."""
_TAIL = 4.0
"""Degrees of freedom of Student's t: of numbers that have it one in sixty is beyond four sigmas."""


def rescaled(
    fleet: Fleet, values: Mapping[str, Tensor], border: BorderInformation, scales: CalibrationScales
) -> CalibrationScales:
    """By kind, what the sigmas of what cars have wrong are to be multiplied by, one at most, and which cars are beyond.

    `values` were found with the `scales` given, by the information `border`, which has the prior in it. What was found
    before keeps the sigma that it was found with, and has no say.
    """
    names = fleet.variables
    found = variances(fleet, scales)
    x = torch.cat([values[name] for name in names], dim=1)
    told = _by_car(border.on(*names), values, names)
    seen = told @ x.flatten()
    told = told - prior_information(found)
    for _ in range(_SWEEPS):
        covariance = torch.linalg.inv(told + prior_information(found))
        x = (covariance @ seen).view_as(x)
        before, joint = scales, covariance.view(*x.shape, *x.shape)
        far = far_beyond(x, joint.diagonal(dim1=1, dim2=3), found)
        scales = CalibrationScales(_of_kinds(fleet, x, joint, found, before.of_kind), far)
        found = variances(fleet, scales)
        if bool((scales.ratio_to(before).log().abs() < _RESTS).all()):
            break
    return scales


def far_beyond(
    value: Float[Tensor, "v k"], covariance: Float[Tensor, "v v k"], prior: Variances
) -> Float[Tensor, "v k"]:
    """How far each car is beyond the configuration's sigmas, by what was found of it with the `prior`."""
    # What all have in common is not the car's own: d = x - m, with m by all cars, ...
    by_car = torch.where(prior.is_new, 1 / prior.own, 0.0)
    total = 1 + prior.shared * by_car.sum(0)
    weight = prior.shared * by_car / total
    own = torch.eye(len(value)).to(value)[..., None] - weight
    missed = torch.einsum("cdk,dk->ck", own, value)
    left = torch.einsum("cdk,dek,cek->ck", own, covariance, own) + prior.shared / total
    # ... and where they have nothing in common, what most of them show.
    middle = torch.where(prior.is_new, value, torch.nan).nanquantile(0.5, dim=0)
    missed = torch.where(prior.shared > 0, missed, value - middle)
    square = (missed.square() + left) / prior.apart
    beyond = ((_TAIL + square) / (_TAIL + 1)).clamp_min(1).sqrt()
    return torch.where(prior.is_new & (prior.is_new.sum(0) > 1), beyond, 1.0)


def prior_information(prior: Variances) -> Float[Tensor, "n n"]:
    """What is known of all numbers of all cars before anything is seen, car by car."""
    alone, pair = prior.rows
    of_number = (
        torch.diag_embed((alone + pair * pair.sum(0)).mT) - pair.mT[..., None] * pair.mT[:, None]
    )
    cars, count = alone.shape
    joint = alone.new_zeros(cars, count, cars, count)
    joint.diagonal(dim1=1, dim2=3).copy_(of_number.permute(1, 2, 0))
    return joint.view(cars * count, -1)


def scale_of(
    value: Float[Tensor, "*b n"], covariance: Float[Tensor, "*b n n"], scale: Float[Tensor, "*b"]
) -> Float[Tensor, "*b"]:
    """What the sigmas of numbers that are 1 as configured are to be multiplied by, of many sets of numbers at once.

    `value` and `covariance` are what was found of them with sigmas of `scale`.
    """
    left, axes = torch.linalg.eigh(covariance)
    left = left.clamp_min(1e-12)
    told = (1 / left - scale[..., None] ** -2).clamp_min(_LEAST_TOLD)[..., None, :]
    mean = ((axes.mT @ value[..., None])[..., 0] / left).square()[..., None, :]
    least, most, count = _SCALES
    like = {"dtype": value.dtype, "device": value.device}
    s = torch.linspace(math.log(least), math.log(most), count, **like).exp()
    square = s.square()[:, None]
    gain = 1 + told * square
    evidence = (mean * square / gain - gain.log()).sum(-1) / 2 - s.square() / 2
    # Steps of even logarithms are as wide as the scale is large.
    weight = torch.softmax(evidence + s.log(), -1)
    determined = (told * square / gain).sum(-1)
    wanted = (weight * determined).sum(-1)
    behind = torch.searchsorted(determined, wanted[..., None]).clamp(1, count - 1)
    around = torch.cat((behind - 1, behind), dim=-1)
    below, above = determined.gather(-1, around).unbind(-1)
    low, high = s[around].unbind(-1)
    return low * (high / low) ** ((wanted - below) / (above - below))


def _of_kinds(
    fleet: Fleet,
    value: Float[Tensor, "v k"],
    covariance: Float[Tensor, "v k v k"],
    prior: Variances,
    scale: Float[Tensor, " kinds"],
) -> Float[Tensor, " kinds"]:
    """The scale of what cars differ in, of every kind that is new of two cars or more, found with `prior` and `scale`."""
    found, sigma = scale.clone(), prior.own.sqrt()
    # Kinds of as many numbers, and of as many cars, at once.
    alike: dict[tuple[int, int], list[tuple[int, Tensor, range]]] = {}
    first = 0
    for number, kind in enumerate(fleet.kinds):
        new, count = fleet.new(kind), kind.at.stop - kind.at.start
        if len(new) > 1:
            some = alike.setdefault((len(new), count), [])
            some.append((number, new, range(first, first + count)))
        first += count
    for (cars, _), some in alike.items():
        numbers, every, places = zip(*some, strict=True)
        of_kind = torch.tensor(numbers, device=scale.device)
        new, at = torch.stack(every), torch.tensor(places, device=scale.device)
        # Whatever is at right angles to the mean of the cars, each in its own sigmas but for the scale.
        eye = torch.eye(cars).to(value)
        basis = torch.linalg.qr(torch.cat((torch.ones_like(eye[:, :1]), eye[:, 1:]), dim=1)).Q
        row, column = new[:, :, None], at[:, None]
        units = scale[of_kind, None, None] / sigma[row, column]
        basis = basis[:, None, 1:] * units[..., None]
        joint = covariance[
            row[..., None, None], column[..., None, None], row[:, None, None], column[:, None, None]
        ]
        differences = torch.einsum("kaiq,kai->kiq", basis, value[row, column])
        of_them = torch.einsum("kaiq,kaibj,kbjr->kiqjr", basis, joint, basis)
        told = differences.flatten(1)
        of_them = of_them.reshape(*told.shape, told.shape[1])
        found[of_kind] = scale_of(told, of_them, scale[of_kind]).clamp_max(1)
    return found


def _by_car(
    matrix: Float[Tensor, "n n"], values: Mapping[str, Tensor], names: tuple[str, ...]
) -> Float[Tensor, "n n"]:
    """A matrix of all numbers, one variable behind the other, as one of all numbers of one car behind those of another."""
    first, places = 0, []
    for name in names:
        count = values[name].numel()
        places.append(torch.arange(first, first + count).view(values[name].shape))
        first += count
    place = torch.cat(places, dim=1).flatten().to(matrix.device)
    return matrix[place[:, None], place]
