"""What the positioning module gets wrong, as a prior of bundle adjustment (V-B, footnote).

The error of a journey's poses is a constant bias, a slow drift on top of it, a Gauss-Markov chain along the way, and
white noise from frame to frame. `drift` is the error without the noise, at nodes a few metres apart: it is drawn towards
the journey's `bias`, and the bias towards zero. The sigmas are the module's own where it gives them; how far each journey
is from them shows when many have seen the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.optim.problem import CostTerm
from crowdmap_torch.ranges import Freedom, Length, Settings
from crowdmap_torch.residuals import pose as residuals
from crowdmap_torch.tables import Journey

LEAST_SIGMA_M = 1e-3
"""What carrier phases leave under the open sky of a receiver that stands still: who states less states nothing."""
LEAST_SIGMA_RAD = 1e-5
"""Likewise of rotations: two seconds of arc, a theodolite's."""


@dataclass(frozen=True)
class PosePriorConfig(Settings):
    """How far the sigmas of journeys may be from those that they are given."""

    scale_strength: Freedom = 24.0
    """Degrees of freedom that the fleet's scale of the sigmas counts in a journey's own, before journeys show how far
    their scales are apart."""
    scale_trust: Freedom = 3.0
    """Degrees of freedom that the sigmas as they are given count in the fleet's scale."""
    scale_lag_m: Length = 100.0
    """Way over which the drift's changes are compared with their sigma."""


@dataclass(frozen=True)
class DriftNodes:
    """Stretches of road with one drift each: the blocks that form a journey's chain."""

    of_frame: Int[Tensor, " p"]
    """Node of each pose of the bundle."""
    first: Int[Tensor, " n"]
    """First pose of each node."""
    journey: Int[Tensor, " n"]
    way: Float[Tensor, " n"]
    """Distance travelled at the node [m]."""

    def mean(self, at_nodes: Float[Tensor, "n k"], journeys: int) -> Float[Tensor, "j k"]:
        """The mean over each journey's nodes; zero where it has none."""
        count = torch.bincount(self.journey, minlength=journeys).clamp_min(1)
        total = at_nodes.new_zeros(journeys, at_nodes.shape[1])
        return total.index_add_(0, self.journey, at_nodes) / count[:, None]


def drift_nodes(journey: Int[Tensor, " n"], way: Float[Tensor, " n"], spacing: float) -> DriftNodes:
    """Stretches of at most `spacing` metres in which the drift is taken to stand still."""
    cell = (way / spacing).floor()
    begins = _begins(journey)
    begins[1:] |= cell[1:] != cell[:-1]
    of_frame = begins.cumsum(0) - 1
    first = torch.nonzero(begins)[:, 0]
    count = torch.bincount(of_frame, minlength=len(first))
    centre = way.new_zeros(len(first)).index_add_(0, of_frame, way) / count
    return DriftNodes(of_frame, first, journey[first], centre)


@dataclass(frozen=True)
class PosePrior:
    """The prior of all poses and of what they have wrong."""

    pose: Float[Tensor, "p 4 4"]
    """The positioning module's poses."""
    nodes: DriftNodes
    spacing_m: float
    bias_sigma: Float[Tensor, "j 6"]
    """As given, by journey: position, then rotation about the camera's axes."""
    drift_sigma: Float[Tensor, "j 6"]
    length_m: Float[Tensor, "j 6"]
    white_sigma: Float[Tensor, " 6"]
    begins: Int[Tensor, " c"]
    """First node of each journey's chain."""
    follows: Int[Tensor, " e"]
    """Nodes that another one of their journey follows."""
    far: Int[Tensor, "q 2"]
    """Nodes about `scale_lag_m` apart, each the end of at most one such pair."""
    config: PosePriorConfig
    slots: dict[str, tuple[tuple[str, Tensor], ...]]
    """What each term touches."""

    def terms(
        self, scale: Float[Tensor, "j 3"], white_scale: Float[Tensor, "j 2"]
    ) -> dict[str, CostTerm]:
        """Absolute and relative regularisation of the poses, the sigmas scaled."""
        nodes = self.nodes
        bias, drift = self._scaled(scale)
        noise = self.white_sigma * white_scale.repeat_interleave(3, dim=1)
        white = (noise.square() + self.within_stretch(scale)).sqrt()
        journey, follows = nodes.journey, self.follows
        gap = (nodes.way[follows + 1] - nodes.way[follows]).clamp_min(0.1)[:, None]
        reach = self.length_m[journey[follows]]
        step = drift[journey[follows]] * (-torch.expm1(-2 * gap / reach)).sqrt()
        return {
            "pose_bias": CostTerm(
                residuals.gauss_markov_start,
                self.slots["pose_bias"],
                (torch.zeros_like(bias),),
                1 / bias,
                takes_rows=True,
            ),
            "pose_absolute": CostTerm(
                residuals.gauss_markov_start,
                self.slots["pose_absolute"],
                weight=1 / drift[journey[self.begins]],
                takes_rows=True,
            ),
            "pose_relative": CostTerm(
                residuals.gauss_markov_step,
                self.slots["pose_relative"],
                (torch.exp(-gap / reach),),
                weight=1 / step,
                jacobian=residuals.gauss_markov_step_jacobian,
            ),
            "pose_white": CostTerm(
                residuals.pose_deviation,
                self.slots["pose_white"],
                (self.pose,),
                1 / white[journey[nodes.of_frame]],
                jacobian=residuals.pose_deviation_jacobian,
            ),
        }

    def within_stretch(self, scale: Float[Tensor, "j 3"]) -> Float[Tensor, "j 6"]:
        """Variance of the drift within a stretch in which it is taken to stand still.

        It does move: by a random walk of a quarter of the stretch's length in the mean.
        """
        drift = self._scaled(scale)[1]
        return 2 * drift.square() / self.length_m * self.spacing_m / 4

    def rescaled(
        self, drift: Float[Tensor, "n 6"], scale: Float[Tensor, "j 3"], told: Float[Tensor, "j 6"]
    ) -> Float[Tensor, "j 3"]:
        """By journey, what the sigmas of its bias, of its drift and of its rotation are to be multiplied by.

        `drift` is the estimated one. What all journeys share is taken off, and costs its degrees of freedom (restricted
        maximum likelihood); a journey's scale is drawn towards the fleet's, and that towards one. Changes count as far as
        observations have `told` them: an estimate follows the prior where nothing is seen, and says nothing of it.
        """
        return self._scales(drift, scale, told)[0]

    def expected_scale(
        self, drift: Float[Tensor, "n 6"], scale: Float[Tensor, "j 3"], told: Float[Tensor, "j 6"]
    ) -> Float[Tensor, "j 3"]:
        """`rescaled` as covariances need it: the root of the mean that a scale's square has, not of its median.

        A variance found from few numbers may well be larger than it seems: what rests on it has Student's covariance,
        wider than a normal's by `n / (n - 2)` of n degrees of freedom (Gelman et al., Bayesian Data Analysis, 3.2).
        """
        found, wider = self._scales(drift, scale, told)
        return found * wider.sqrt()

    def expected_changes(self, pair: Int[Tensor, "q 2"]) -> Float[Tensor, "q 6"]:
        """Mean squares of the drift's changes between nodes, by the sigmas as given."""
        first, second = pair.unbind(1)
        own = self.nodes.journey[first]
        gap = (self.nodes.way[second] - self.nodes.way[first])[:, None]
        return -2 * torch.expm1(-gap / self.length_m[own]) * self.drift_sigma[own].square()

    def _scales(
        self, drift: Float[Tensor, "n 6"], scale: Float[Tensor, "j 3"], told: Float[Tensor, "j 6"]
    ) -> tuple[Float[Tensor, "j 3"], Float[Tensor, "j 3"]]:
        """The scales, and for each the mean of its square over the median."""
        journeys, own = len(scale), self.nodes.journey
        first, second = self.far.unbind(1)
        change = (drift[second] - drift[first]).square() / self.expected_changes(self.far)
        changes = drift.new_zeros(journeys, 6).index_add_(0, own[first], change)
        pairs = torch.bincount(own[first], minlength=journeys).to(drift)[:, None] * told
        count = torch.bincount(own, minlength=journeys).to(drift)[:, None]
        slow = self._share_of_mean()
        mean = self.nodes.mean(drift[:, :3], journeys)
        seen = count.clamp_max(1).expand(-1, 3)
        bias, moves, turns = scale.square().unbind(1)
        likely, wider = drift.new_ones(3), torch.ones_like(scale)
        slides, rolls = self.drift_sigma.square().split(3, dim=1)
        for _ in range(_SWEEPS):
            moves, of_moves, moves_wider = self._pooled(
                likely[1], changes[:, :3], pairs[:, :3], moves[:, None] * slides
            )
            turns, of_turns, turns_wider = self._pooled(
                likely[2], changes[:, 3:], pairs[:, 3:], turns[:, None] * rolls
            )
            spread = (
                bias[:, None] * self.bias_sigma[:, :3].square() + moves[:, None] * slow * slides
            )
            weight = seen / spread
            common = (weight * mean).sum(0) / weight.sum(0).clamp_min(1e-12)
            squares = seen * bias[:, None] * (mean - common).square() / spread
            bias, of_bias, bias_wider = self._pooled(likely[0], squares, seen, spread)
            likely = torch.stack((of_bias, of_moves, of_turns))
            wider = torch.stack((bias_wider, moves_wider, turns_wider), dim=1)
        return torch.stack((bias, moves, turns), dim=1).sqrt(), wider

    def _pooled(
        self,
        likely: Float[Tensor, ""],
        squares: Float[Tensor, "j 3"],
        count: Float[Tensor, "j 3"],
        variance: Float[Tensor, "j 3"],
    ) -> tuple[Float[Tensor, " j"], Float[Tensor, ""], Float[Tensor, " j"]]:
        """Variance scales of journeys from sums of squares in units of the given sigmas, the medians of what they may be.

        With them the fleet's `likely` one, anew, and the mean of each journey's over its median.
        """
        config = self.config
        weight = (count > 0) / variance
        of_common = weight / weight.sum(0).clamp_min(1e-300)
        freedom = (count * (1 - of_common)).sum(1)
        found, total = squares.sum(1), freedom.sum()
        seen = freedom > 0
        # Inverse chi-squared variances, their median the fleet's. Of it each journey tells by the mean of its inverse:
        # one that is far too bad does not move it.
        strength = _strength(found / likely, freedom, config.scale_strength)
        centre = strength - 2 / 3
        inverse = (strength + freedom) / (centre * likely + found) * seen
        likely = strength / centre * seen.sum() / inverse.sum().clamp_min(1e-300)
        likely = torch.where(total > 0, likely.clamp(*_SCALES_SQUARED), 1.0)
        fleet = likely ** (total / (total + config.scale_trust))
        own = (centre * fleet + found) / (centre + freedom)
        wider = _mean_over_median(strength, freedom) * _mean_over_median(config.scale_trust, total)
        return own.clamp(*_SCALES_SQUARED), likely, wider

    def _share_of_mean(self) -> Float[Tensor, "j 3"]:
        """Variance of a drift's mean over its journey's way, in units of the drift's."""
        journeys, own = len(self.length_m), self.nodes.journey
        first = self.nodes.way.new_full((journeys,), torch.inf)
        first = first.scatter_reduce(0, own, self.nodes.way, "amin")
        last = torch.zeros_like(first).scatter_reduce(0, own, self.nodes.way, "amax")
        ratio = ((last - first).clamp_min(1.0)[:, None] / self.length_m[:, :3]).nan_to_num(1.0)
        return variance_of_mean(ratio)

    def _scaled(
        self, scale: Float[Tensor, "j 3"]
    ) -> tuple[Float[Tensor, "j 6"], Float[Tensor, "j 6"]]:
        """Sigmas of bias and drift."""
        bias, moves, turns = (s[:, None].expand(-1, 3) for s in scale.unbind(1))
        return (
            self.bias_sigma * torch.cat((bias, turns), dim=1),
            self.drift_sigma * torch.cat((moves, turns), dim=1),
        )


def variance_of_mean(ratio: Tensor) -> Tensor:
    """Of a Gauss-Markov chain's mean over a way `ratio` times its correlation length, in units of the chain's variance."""
    return 2 / ratio * (1 + torch.expm1(-ratio) / ratio)


def _strength(
    found: Float[Tensor, " j"], freedom: Float[Tensor, " j"], usual: float
) -> Float[Tensor, ""]:
    """Degrees of freedom of the inverse chi-squared variances that journeys have, as their spread shows.

    `found` are sums of so many squares in units of the fleet's median variance. Each, over `nu - 2/3`, is beta-prime with
    half of its own degrees of freedom and half of the `nu` that are asked for (empirical Bayes; Gelman et al., Bayesian
    Data Analysis, 5); those are about the `usual` ones.
    """
    seen = freedom > 0
    n = torch.where(seen, freedom, 1.0) / 2
    log = torch.linspace(-3, 1, 9, dtype=found.dtype, device=found.device) * math.log(2)
    nu = (usual * log.exp())[:, None].clamp_min(_LEAST_STRENGTH)
    x = (torch.where(seen, found, 1.0) / (nu - 2 / 3)).clamp_min(1e-12)
    evidence = (n - 1) * x.log() - (n + nu / 2) * torch.log1p(x) - (nu - 2 / 3).log()
    evidence = evidence + torch.lgamma(n + nu / 2) - torch.lgamma(n) - torch.lgamma(nu / 2)
    total = (evidence * seen).sum(1) - (log / _STRENGTH_SPREAD).square() / 2
    return (torch.softmax(total, 0) * nu[:, 0].log()).sum().exp()


def _mean_over_median(given: float | Tensor, found: Tensor) -> Tensor:
    """Of an inverse chi-squared variance with so many degrees of freedom; 1 where none were found: it is as given."""
    freedom = (given + found).clamp_min(3)
    return torch.where(found > 0, (freedom - 2 / 3) / (freedom - 2), 1.0)


_LEAST_STRENGTH = 3.0
"""With fewer degrees of freedom a variance has no mean worth the name."""
_STRENGTH_SPREAD = 1.0
"""1-sigma of the logarithm of the journeys' degrees of freedom about the usual ones."""
_SWEEPS = 60
"""Alternations between scales and what all journeys share."""
LEAST_SCALE, MOST_SCALE = 0.1, 10.0
"""Sigmas are never taken for further from those that are given."""
_SCALES_SQUARED = (LEAST_SCALE**2, MOST_SCALE**2)


def pose_prior(
    journeys: Sequence[Journey],
    pose: Float[Tensor, "p 4 4"],
    nodes: DriftNodes,
    spacing: float,
    positioning: PositioningNoise,
    config: PosePriorConfig,
) -> PosePrior:
    """The prior of the poses `pose` of a bundle, whose drift stands still within `spacing` metres."""
    bias, drift = (
        torch.stack(part)
        for part in zip(*(_sigmas(journey, positioning, pose) for journey in journeys), strict=True)
    )
    length = pose.new_tensor([positioning.drift_length_m] * 3 + [positioning.rotation_length_m] * 3)
    white = pose.new_tensor([positioning.white_sigma_m] * 3 + [positioning.white_sigma_rad] * 3)
    begins = torch.nonzero(_begins(nodes.journey))[:, 0]
    follows = torch.nonzero(nodes.journey[1:] == nodes.journey[:-1])[:, 0]
    far = _far_apart(nodes, begins, config.scale_lag_m)
    every = torch.arange(len(journeys), device=pose.device)
    frame = torch.arange(len(pose), device=pose.device)
    slots = {
        "pose_bias": (("bias", every),),
        "pose_absolute": (("drift", begins), ("bias", nodes.journey[begins])),
        "pose_relative": (
            ("drift", follows),
            ("drift", follows + 1),
            ("bias", nodes.journey[follows]),
        ),
        "pose_white": (("pose", frame), ("drift", nodes.of_frame)),
    }
    length = length.expand(len(journeys), 6)
    return PosePrior(
        pose, nodes, spacing, bias, drift, length, white, begins, follows, far, config, slots
    )


def stated_sigmas(journey: Journey) -> tuple[Float[Tensor, " 3"] | None, Float[Tensor, ""] | None]:
    """The module's own sigmas of position [m] and rotation [rad], the medians of its frames; None where it states none.

    A sigma of zero, or below what any receiver or gyro can know of where it is, is no statement.
    """
    position, rotation = journey.sigma_position, journey.sigma_rotation
    if position is not None:
        position = position.median(0).values
        position = position if bool((position >= LEAST_SIGMA_M).all()) else None
    if rotation is not None:
        rotation = rotation.median()
        rotation = rotation if bool(rotation >= LEAST_SIGMA_RAD) else None
    return position, rotation


def _sigmas(
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


def _far_apart(nodes: DriftNodes, begins: Tensor, lag: float) -> Int[Tensor, "q 2"]:
    """The first nodes of successive stretches of `lag` metres of each journey."""
    chain = _begins(nodes.journey).cumsum(0) - 1
    cell = ((nodes.way - nodes.way[begins][chain]) / lag).floor()
    enters = _begins(nodes.journey)
    enters[1:] |= cell[1:] != cell[:-1]
    at = torch.nonzero(enters)[:, 0]
    same = nodes.journey[at[1:]] == nodes.journey[at[:-1]]
    return torch.stack((at[:-1], at[1:]), dim=1)[same]


def _begins(journey: Int[Tensor, " n"]) -> Tensor:
    """True for the first row of each journey."""
    begins = torch.ones_like(journey, dtype=torch.bool)
    begins[1:] = journey[1:] != journey[:-1]
    return begins
