"""What observations tell of what positioning gets wrong: by how much the sigmas of its prior may be judged.

An estimate follows its prior where nothing is seen, and says nothing of it. How much it does say is one less the share of
the prior's variance that is left when all is observed; of many numbers, the sum of these shares is the effective number of
well determined ones (MacKay, Bayesian Interpolation, 1992): what sums of squares are divided by. Landmarks are as unknown as
the poses: a sign that one drive passes goes where the drive wants it, and tells next to nothing of where that was.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.noise.pooled_scales import MOST_SCALE
from crowdmap_torch.noise.pose_prior import PosePrior
from crowdmap_torch.optim.solvers.normal_equations import ChainChanges, MapEquations
from crowdmap_torch.processes.sums import add_at

_SAMPLED = 16
"""Changes of a journey whose variances are asked for, at most."""
_CHANGES = 50
"""Of many journeys about so many in all, and one of each at least: they tell of the fleet together."""
_WHITE_TRUST = 24.0
"""Well determined numbers that the noise from frame to frame as it is given counts as, and that of all axes in one's."""
_WHITE_SCALES = (1.0, MOST_SCALE)
"""Least and largest scale of that noise: narrower than it is given it gains nothing even where it is (docs/RESULTS.md)."""


@dataclass(frozen=True)
class PoseEvidence:
    """What the observations of a bundle tell of its poses' errors."""

    told: Float[Tensor, "j k"]
    """By journey and number of a pose, the share of the drift's changes that observations tell; behind them, where the
    bias wanders, those of its wander."""
    left: Float[Tensor, "p 6"]
    """Variance that is left of every pose's deviation from its drift, the landmarks known."""


def pose_evidence(
    prior: PosePrior, equations: MapEquations, scale: Float[Tensor, "j _"]
) -> PoseEvidence:
    """That at the point of normal equations, which have been solved, with the prior's scales that they were made with."""
    told = share_of_changes_told(prior, equations, scale)
    left = equations.variance_of_leaves() if len(prior.pose) else prior.pose.new_zeros(0, 6)
    return PoseEvidence(told, left)


def share_of_changes_told(
    prior: PosePrior, equations: MapEquations, scale: Float[Tensor, "j _"]
) -> Float[Tensor, "j k"]:
    """By journey and number, the share of the changes of its drift, and of its wander, that observations tell."""
    told = prior.bias_sigma.new_ones(len(scale), prior.numbers)
    changes = sampled_changes(prior, prior.far, prior.about_bias(_numbers(prior)))
    told[:, :6] = share_told(prior, changes, equations.variance_of_changes(changes), scale)
    if prior.wander is not None:
        changes = sampled_changes(prior, prior.wander.far, _numbers(prior)[:, 6:])
        told[:, 6:] = _wander_told(prior, changes, equations.variance_of_changes(changes), scale)
    return told


def _numbers(prior: PosePrior) -> Float[Tensor, "k k"]:
    """Each of a node's numbers by itself."""
    return torch.eye(prior.numbers).to(prior.bias_sigma)


def sampled_changes(
    prior: PosePrior, pair: Int[Tensor, "q 2"], of: Float[Tensor, "k m"]
) -> ChainChanges:
    """Some of the changes that scales are told by, spread over each journey: as many as are solved for at once."""
    journey, drives = prior.nodes.journey[pair[:, 0]], len(prior.bias_sigma)
    most = max(min(_SAMPLED, _CHANGES // max(drives, 1)), 1)
    _, group, count = torch.unique_consecutive(journey, return_inverse=True, return_counts=True)
    rank = torch.arange(len(group), device=group.device) - (count.cumsum(0) - count)[group]
    column = torch.where(count[group] > most, rank * most // count[group], rank)
    starts = torch.ones_like(column, dtype=torch.bool)
    starts[1:] = (column[1:] != column[:-1]) | (group[1:] != group[:-1])
    return ChainChanges(
        *(pair[starts], column[starts], most, journey[starts], of),
        *(prior.journey_of_chain, drives),
    )


def share_told(
    prior: PosePrior,
    changes: ChainChanges,
    variance: Float[Tensor, "q 6"],
    scale: Float[Tensor, "j _"],
) -> Float[Tensor, "j 6"]:
    """By journey and number of a pose, the share of changes that observations tell, not the prior at this `scale`.

    `variance` is what is left of each change: of one that nothing tells of, the prior's own.
    """
    of_each = scale[:, 1:3].repeat_interleave(3, dim=1)[changes.whose].square()
    share = 1 - variance / (of_each * prior.expected_changes(changes.pair))
    return _by_journey(share.clamp(0, 1), changes.whose, len(scale))


def _wander_told(
    prior: PosePrior,
    changes: ChainChanges,
    variance: Float[Tensor, "q 3"],
    scale: Float[Tensor, "j 4"],
) -> Float[Tensor, "j 3"]:
    """The same of the changes of a bias that wanders."""
    assert prior.wander is not None
    expected = prior.wander.expected_changes(changes.pair, prior.nodes.way, prior.nodes.journey)
    share = 1 - variance / (scale[changes.whose, 3:].square() * expected)
    return _by_journey(share.clamp(0, 1), changes.whose, len(scale))


def _by_journey(
    share: Float[Tensor, "q m"], journey: Int[Tensor, " q"], journeys: int
) -> Float[Tensor, "j m"]:
    """The mean of each journey's; zero where it has none."""
    total = add_at(share.new_zeros(journeys, share.shape[1]), 0, journey, share)
    return total / torch.bincount(journey, minlength=journeys).clamp_min(1)[:, None]


def white_scales(
    prior: PosePrior,
    residual: Float[Tensor, "p 6"],
    left: Float[Tensor, "p 6"],
    scale: Float[Tensor, "j _"],
    white_scale: Float[Tensor, "j 6"],
) -> Float[Tensor, "j 6"]:
    """By journey and number of a pose, what the noise from frame to frame is to be multiplied by.

    `residual` is the poses' deviation from their drift, in units of their noise at the present scales. A receiver's
    heights tremble more than its places, a camera nods more than it turns: each number has a scale of its own, drawn to
    that of the three of its kind.
    """
    journey = prior.nodes.journey_of_pose
    within = prior.within_stretch(scale)
    noise = prior.white_sigma * white_scale
    present = noise.square()[journey] + within
    share = (1 - left / present).clamp(0, 1)

    def summed(of_each: Float[Tensor, "p 6"]) -> Float[Tensor, "j 6"]:
        return add_at(of_each.new_zeros(len(scale), 6), 0, journey, of_each)

    squares, told = summed(residual.square()), summed(share)
    of_kind = (_of_kinds(squares) + _WHITE_TRUST) / (_of_kinds(told) + _WHITE_TRUST)
    usual = of_kind.repeat_interleave(3, dim=1)
    grown = (squares + _WHITE_TRUST * usual) / (told + _WHITE_TRUST)
    count = torch.bincount(journey, minlength=len(scale)).clamp_min(1)[:, None]
    found = (grown * summed(present) - summed(within)) / count
    return (found / prior.white_sigma.square()).clamp_min(0).sqrt().clamp(*_WHITE_SCALES)


def white_scales_of_kinds(white_scale: Float[Tensor, "j 6"]) -> Float[Tensor, "j 2"]:
    """Of scales of noise by number of a pose those of positions and of rotations, root mean squares."""
    return (_of_kinds(white_scale.square()) / 3).sqrt()


def _of_kinds(of_each: Float[Tensor, "j 6"]) -> Float[Tensor, "j 2"]:
    """Sums over positions and over rotations."""
    return of_each.view(-1, 2, 3).sum(-1)
