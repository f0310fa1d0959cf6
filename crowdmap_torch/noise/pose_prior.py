"""What the positioning module gets wrong, as a prior of bundle adjustment (V-B, footnote).

The error of a journey's poses is a bias, a slow drift on top of it, a Gauss-Markov chain along the way, and white noise
from frame to frame. `drift` is the error without the noise, at nodes a few metres apart: it is drawn towards the journey's
`bias`, and the bias towards zero. Where one drive is so long that its bias wanders (`bias_wander`), `drift` has three
numbers more: how far the bias is from the constant one at the node. Long drives are cut: where two nodes part, the state of
the chain between them is an unknown of its own, `cut`, and what it is made of is known on either side. The sigmas are the
module's own where it gives them; how far each journey is from them shows when many have seen the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.noise.bias_wander import (
    WANDER_SHARE,
    BiasWander,
    bias_wander,
    first_wander,
    nodes_apart,
    wandering_drives,
)
from crowdmap_torch.noise.drift_nodes import DriftNodes, begins_of
from crowdmap_torch.noise.pooled_scales import LEAST_SCALE, MOST_SCALE, pooled
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.noise.stated_sigmas import sigmas_of
from crowdmap_torch.optim.fixed_point import fixed_point
from crowdmap_torch.optim.problem import CostTerm
from crowdmap_torch.processes.sums import add_at
from crowdmap_torch.ranges import Freedom, Length, Settings
from crowdmap_torch.residuals import pose as residuals
from crowdmap_torch.tables import Journey

_CUT_TERMS = ("pose_before_cut", "pose_behind_cut")
"""The terms by which states at cuts are bound to the nodes around them."""
_CYCLES = 5
"""Extrapolations of the alternation between scales and what all journeys share."""
WANDER_SCALE = 3
"""Column of the scales that is of the bias's wander, where there is any: behind bias, drift and rotation."""
_LEAST_WHITE = 1e-5
"""Least noise of poses from frame to frame [m, rad]: where it is none a pose would weigh infinitely much at its node."""
MOST_NUMBERS = 9
"""Numbers of the drift at a node, at most."""


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
class PosePrior:
    """The prior of all poses and of what they have wrong."""

    pose: Float[Tensor, "p 4 4"]
    """The positioning module's poses."""
    nodes: DriftNodes
    bias_sigma: Float[Tensor, "j 6"]
    """As given, by journey: position, then rotation about the camera's axes."""
    drift_sigma: Float[Tensor, "j 6"]
    length_m: Float[Tensor, "j 6"]
    white_sigma: Float[Tensor, " 6"]
    begins: Int[Tensor, " c"]
    """First node of each journey's chain."""
    follows: Int[Tensor, " e"]
    """Nodes that another one of their journey follows, no cut between them."""
    cut: Int[Tensor, " s"]
    """Nodes that a cut is right before, in order."""
    far: Int[Tensor, "q 2"]
    """Nodes about `scale_lag_m` apart, each the end of at most one such pair."""
    config: PosePriorConfig
    slots: dict[str, tuple[tuple[str, Tensor], ...]]
    """What each term touches."""
    wander: BiasWander | None = None
    """How the bias wanders; None: there is no drive that is long enough."""
    first_cut: int = 0
    """Cuts of journeys before these."""

    def of_journeys(self, first: int, last: int) -> PosePrior:
        """The prior of the poses of successive journeys, the `first` to the one before the `last`.

        Journeys and cuts keep their numbers, poses and nodes are counted from the first.
        """
        nodes, bounds = self.nodes, self.nodes.journey.new_tensor([first, last])
        a, b = torch.searchsorted(nodes.journey.contiguous(), bounds).tolist()
        frames = torch.searchsorted(nodes.of_frame.contiguous(), bounds.new_tensor([a, b])).tolist()

        def own(of: Tensor) -> Tensor:
            node = of if of.ndim == 1 else of[:, 0]
            return of[(node >= a) & (node < b)] - a

        of_poses = slice(*frames)
        of_frame, starts = nodes.of_frame[of_poses] - a, nodes.first[a:b] - frames[0]
        apart = nodes.apart[of_poses]
        here = DriftNodes(of_frame, starts, nodes.journey[a:b], nodes.way[a:b], apart)
        begins, follows, cut = own(self.begins), own(self.follows), own(self.cut)
        first_cut = self.first_cut + int((self.cut < a).sum())
        every = torch.arange(first, last, device=cut.device)
        return replace(
            self,
            pose=self.pose[of_poses],
            nodes=here,
            begins=begins,
            follows=follows,
            cut=cut,
            far=own(self.far),
            slots=_slots(here, begins, follows, cut, first_cut, every),
            wander=self.wander and replace(self.wander, far=own(self.wander.far)),
            first_cut=first_cut,
        )

    @property
    def journeys(self) -> Int[Tensor, " j"]:
        """Those that it is of, by number."""
        return self.slots["pose_bias"][0][1]

    @property
    def scale_count(self) -> int:
        """Scales of each journey: of its bias, of its drift, of its rotation, and of its wander where there is one."""
        return 3 if self.wander is None else 4

    @property
    def numbers(self) -> int:
        """Numbers of the drift at a node."""
        return 6 if self.wander is None else MOST_NUMBERS

    def with_wander(self, error: Float[Tensor, "n 6"]) -> Float[Tensor, "n k"]:
        """Drift at the nodes where the poses' `error` is known there: with it how the bias wanders, where it may."""
        if self.wander is None:
            return error
        way, journey = self.nodes.way, self.nodes.journey
        return torch.cat((error, first_wander(error[:, :3], way, journey, self.wander)), dim=1)

    @property
    def chain(self) -> Int[Tensor, " n"]:
        """The stretch between two cuts, or of a whole journey, that each node is of."""
        begins = begins_of(self.nodes.journey)
        begins[self.cut] = True
        return begins.cumsum(0) - 1

    @property
    def journey_of_chain(self) -> Int[Tensor, " chains"]:
        """The journey of each such stretch."""
        begins = begins_of(self.nodes.journey)
        begins[self.cut] = True
        return self.nodes.journey[begins]

    @property
    def joint(self) -> Int[Tensor, "chains 2"]:
        """The cut that each such stretch begins at and the one that it ends at; -1: none."""
        chain = self.chain
        found = torch.full((len(self.journey_of_chain), 2), -1, device=chain.device)
        number = self.first_cut + torch.arange(len(self.cut), device=chain.device)
        found[chain[self.cut], 0] = number
        found[chain[self.cut - 1], 1] = number
        return found

    def at_cuts(self, drift: Float[Tensor, "n k"]) -> Float[Tensor, "s k"]:
        """Where the states at cuts may begin: half way between those around them."""
        return (drift[self.cut - 1] + drift[self.cut]) / 2

    def about_bias(self, drift: Float[Tensor, "n k"]) -> Float[Tensor, "n 6"]:
        """The drift at the nodes less what the bias is there beside its constant."""
        if self.wander is None:
            return drift
        return torch.cat((drift[:, :3] - drift[:, 6:], drift[:, 3:6]), dim=1)

    def terms(
        self, scale: Float[Tensor, "j _"], white_scale: Float[Tensor, "j 6"]
    ) -> dict[str, CostTerm]:
        """Absolute and relative regularisation of the poses, the sigmas scaled."""
        nodes = self.nodes
        bias, drift = self._scaled(scale)
        bias = bias[self.journeys]
        noise = self.white_sigma * white_scale
        white = (noise.square()[nodes.journey_of_pose] + self.within_stretch(scale)).sqrt()
        journey = nodes.journey
        start, far, length = residuals.gauss_markov_start, drift, self.length_m
        way, moves = residuals.gauss_markov_step, residuals.gauss_markov_step_jacobian
        if self.wander is not None:
            start = residuals.wandering_start
            way, moves = residuals.wandering_step, residuals.wandering_step_jacobian
            far = torch.cat((drift, self.wander.sigma * scale[:, WANDER_SCALE:]), dim=1)
            length = torch.cat((length, self.wander.length_m + 0 * length[:, :3]), dim=1)

        def steps(name: str, first: Int[Tensor, " e"], share: float) -> CostTerm:
            """Steps over this share of the way from each node to the next."""
            own = journey[first]
            gap = share * (nodes.way[first + 1] - nodes.way[first]).clamp_min(0.1)[:, None]
            step = far[own] * (-torch.expm1(-2 * gap / length[own])).sqrt()
            keep = torch.exp(-gap / length[own])
            return CostTerm(way, self.slots[name], (keep,), weight=1 / step, jacobian=moves)

        cuts = {}
        if len(self.cut):
            cuts = {name: steps(name, self.cut - 1, 0.5) for name in _CUT_TERMS}
        return {
            "pose_bias": CostTerm(
                residuals.gauss_markov_start,
                self.slots["pose_bias"],
                (torch.zeros_like(bias),),
                1 / bias,
                takes_rows=True,
            ),
            "pose_absolute": CostTerm(
                start,
                self.slots["pose_absolute"],
                weight=1 / far[journey[self.begins]],
                takes_rows=True,
            ),
            "pose_relative": steps("pose_relative", self.follows, 1.0),
            **cuts,
            "pose_white": CostTerm(
                residuals.pose_deviation,
                self.slots["pose_white"],
                (self.pose,),
                1 / white,
                jacobian=residuals.pose_deviation_jacobian,
            ),
        }

    def within_stretch(self, scale: Float[Tensor, "j _"]) -> Float[Tensor, "p 6"]:
        """Variance of the drift of every pose beside that of its stretch, in which it is taken to stand still.

        It does move: by a random walk from the stretch's middle.
        """
        walk = 2 * self._scaled(scale)[1].square() / self.length_m
        if self.wander is not None:
            walk[:, :3] += (
                2 * (self.wander.sigma * scale[:, WANDER_SCALE:]).square() / self.wander.length_m
            )
        return walk[self.nodes.journey_of_pose] * self.nodes.apart[:, None]

    def rescaled(
        self, drift: Float[Tensor, "n k"], scale: Float[Tensor, "j s"], told: Float[Tensor, "j k"]
    ) -> Float[Tensor, "j s"]:
        """By journey, what the sigmas of its bias, of its drift, of its rotation and its wander are to be multiplied by.

        `drift` is the estimated one. What all journeys share is taken off, and costs its degrees of freedom (restricted
        maximum likelihood); a journey's scale is drawn towards the fleet's, and that towards one. Changes count as far as
        observations have `told` them: an estimate follows the prior where nothing is seen, and says nothing of it. Where
        none is told yet, a drift that moves makes sigmas larger, and none that stands makes them smaller.
        """
        return self._scales(drift, scale, told)[0]

    def expected_scale(
        self, drift: Float[Tensor, "n k"], scale: Float[Tensor, "j s"], told: Float[Tensor, "j k"]
    ) -> Float[Tensor, "j s"]:
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
        self, drift: Float[Tensor, "n k"], scale: Float[Tensor, "j s"], told: Float[Tensor, "j k"]
    ) -> tuple[Float[Tensor, "j s"], Float[Tensor, "j s"]]:
        """The scales, and for each the mean of its square over the median."""
        journeys, own, config = len(scale), self.nodes.journey, self.config
        slides, rolls = self.drift_sigma.square().split(3, dim=1)
        expected = self.expected_changes(self.far)
        changes, pairs = self._changes(self.about_bias(drift), self.far, expected, journeys)
        pairs = pairs * told[:, :6]
        # Of drift, rotation and wander: sums of squared changes, how many they are, and variances as given.
        chains = list(zip(changes.split(3, 1), pairs.split(3, 1), (slides, rolls), strict=True))
        slow = [self._share_of_mean(self.length_m[:, :3]) * slides, torch.zeros_like(slides)]
        if self.wander is not None:
            wander, squares = self.wander, self.wander.sigma.square()
            expected = wander.expected_changes(wander.far, self.nodes.way, own)
            changes, pairs = self._changes(drift[:, 6:], wander.far, expected, journeys)
            chains.append((changes, pairs * told[:, 6:], squares))
            slow.append(self._share_of_mean(torch.full_like(squares, wander.length_m)) * squares)
        changes, pairs, given = (torch.stack(each) for each in zip(*chains, strict=True))
        of_mean, given_bias = torch.stack(slow), self.bias_sigma[:, :3].square()
        count = torch.bincount(own, minlength=journeys).to(drift)[:, None]
        mean = self.nodes.mean(drift[:, :3], journeys)
        seen = count.clamp_max(1).expand(-1, 3)
        strengths = config.scale_strength, config.scale_trust

        def swept(logs: Float[Tensor, "s k"]) -> tuple[Float[Tensor, "s k"], Float[Tensor, "s j"]]:
            """The fleet's scale of each kind and the journeys', log squares, anew; and their means over medians."""
            likely, found = logs[:, 0].exp(), logs[:, 1:].exp()
            variance = found[1:, :, None] * given
            of_chains = pooled(likely[1:], changes, pairs, variance, *strengths)
            spread = found[0, :, None] * given_bias + (of_chains[0][..., None] * of_mean).sum(0)
            weight = seen / spread
            common = (weight * mean).sum(0) / weight.sum(0).clamp_min(1e-12)
            squares = seen * found[0, :, None] * (mean - common).square() / spread
            of_bias = pooled(likely[:1], squares[None], seen[None], spread[None], *strengths)
            found, likely, wider = (
                torch.cat(each) for each in zip(of_bias, of_chains, strict=True)
            )
            return torch.cat((likely[:, None], found), dim=1).log(), wider

        begun = torch.cat((scale.new_ones(1, scale.shape[1]), scale.square())).T.log()
        bounds = (2 * math.log(bound) for bound in (LEAST_SCALE, MOST_SCALE))
        logs, wider = swept(fixed_point(lambda logs: swept(logs)[0], begun, _CYCLES, *bounds))
        return (logs[:, 1:] / 2).exp().T, wider.T

    def _changes(
        self,
        at_nodes: Float[Tensor, "n k"],
        pair: Int[Tensor, "q 2"],
        expected: Float[Tensor, "q k"],
        journeys: int,
    ) -> tuple[Float[Tensor, "j k"], Float[Tensor, "j 1"]]:
        """By journey the sum of squared changes in units of those expected, and their number."""
        first, second = pair.unbind(1)
        own = self.nodes.journey[first]
        change = (at_nodes[second] - at_nodes[first]).square() / expected
        total = add_at(at_nodes.new_zeros(journeys, at_nodes.shape[1]), 0, own, change)
        return total, torch.bincount(own, minlength=journeys).to(total)[:, None]

    def _share_of_mean(self, length_m: Float[Tensor, "j 3"]) -> Float[Tensor, "j 3"]:
        """Variance of a chain's mean over its journey's way, in units of the chain's."""
        journeys, own = len(self.length_m), self.nodes.journey
        first = self.nodes.way.new_full((journeys,), torch.inf)
        first = first.scatter_reduce(0, own, self.nodes.way, "amin")
        last = torch.zeros_like(first).scatter_reduce(0, own, self.nodes.way, "amax")
        ratio = ((last - first).clamp_min(1.0)[:, None] / length_m).nan_to_num(1.0)
        return variance_of_mean(ratio)

    def _scaled(
        self, scale: Float[Tensor, "j _"]
    ) -> tuple[Float[Tensor, "j 6"], Float[Tensor, "j 6"]]:
        """Sigmas of bias and drift."""
        bias, moves, turns = (s[:, None].expand(-1, 3) for s in scale[:, :3].unbind(1))
        return (
            self.bias_sigma * torch.cat((bias, turns), dim=1),
            self.drift_sigma * torch.cat((moves, turns), dim=1),
        )


def variance_of_mean(ratio: Tensor) -> Tensor:
    """Of a Gauss-Markov chain's mean over a way `ratio` times its correlation length, in units of the chain's variance."""
    return 2 / ratio * (1 + torch.expm1(-ratio) / ratio)


def pose_prior(
    journeys: Sequence[Journey],
    pose: Float[Tensor, "p 4 4"],
    nodes: DriftNodes,
    positioning: PositioningNoise,
    config: PosePriorConfig,
    cut: Int[Tensor, " s"] | None = None,
    error: Float[Tensor, "n 3"] | None = None,
) -> PosePrior:
    """The prior of the poses `pose` of a bundle, whose drift stands still along the stretches of `nodes`.

    Drives are cut before the nodes `cut`, each of which another one of its journey is before. By a first estimate of the
    positions' `error` at nodes biases show whether they wander.
    """
    bias, drift = (
        torch.stack(part)
        for part in zip(
            *(sigmas_of(journey, positioning, pose) for journey in journeys), strict=True
        )
    )
    length = pose.new_tensor([positioning.drift_length_m] * 3 + [positioning.rotation_length_m] * 3)
    white = pose.new_tensor([positioning.white_sigma_m] * 3 + [positioning.white_sigma_rad] * 3)
    white = white.clamp_min(_LEAST_WHITE)
    begins = torch.nonzero(begins_of(nodes.journey))[:, 0]
    cut = begins[:0] if cut is None else cut
    follows = nodes.journey[1:] == nodes.journey[:-1]
    follows[cut - 1] = False
    follows = torch.nonzero(follows)[:, 0]
    far = nodes_apart(nodes.journey, nodes.way, config.scale_lag_m)
    every = torch.arange(len(journeys), device=pose.device)
    slots = _slots(nodes, begins, follows, cut, 0, every)
    length = length.expand(len(journeys), 6)
    wander, reach = None, positioning.wander_length_m
    wanders = wandering_drives(
        *(nodes.way, nodes.journey, reach, error, drift[:, :3], length[:, :3])
    )
    if positioning.wander_sigma_m and bool(wanders.any()):
        sigma = (WANDER_SHARE**0.5 * bias[:, :3]).clamp_max(positioning.wander_sigma_m)
        left = (bias[:, :3].square() - sigma.square()).sqrt()
        wander = bias_wander(sigma, wanders, nodes.journey, nodes.way, reach)
        bias = torch.cat((torch.where(wanders[:, None], left, bias[:, :3]), bias[:, 3:]), dim=1)
    chains = (begins, follows, cut, far)
    return PosePrior(
        *(pose, nodes, bias, drift, length, white, *chains, config, slots), wander=wander
    )


def _slots(
    nodes: DriftNodes,
    begins: Int[Tensor, " c"],
    follows: Int[Tensor, " e"],
    cut: Int[Tensor, " s"],
    first_cut: int,
    journeys: Int[Tensor, " j"],
) -> dict[str, tuple[tuple[str, Tensor], ...]]:
    """What each term touches."""
    frame = torch.arange(len(nodes.of_frame), device=cut.device)
    number = first_cut + torch.arange(len(cut), device=cut.device)
    at_cut, of_cut = ("cut", number), ("bias", nodes.journey[cut])
    return {
        "pose_before_cut": (("drift", cut - 1), at_cut, of_cut),
        "pose_behind_cut": (at_cut, ("drift", cut), of_cut),
        "pose_bias": (("bias", journeys),),
        "pose_absolute": (("drift", begins), ("bias", nodes.journey[begins])),
        "pose_relative": (
            ("drift", follows),
            ("drift", follows + 1),
            ("bias", nodes.journey[follows]),
        ),
        "pose_white": (("pose", frame), ("drift", nodes.of_frame)),
    }
