"""The bias of positioning over kilometres: a second Gauss-Markov process, far slower than the drift about it.

Of a drive that is long beside the way on which the bias forgets where it was, one constant is no longer what its poses have
in common. Its drift is then drawn to the constant bias and to what this process adds to it, which stands behind the
pose's error in every node's state. Shorter drives have it where they show that they need it, else one next to zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_range
from crowdmap_torch.processes.sums import add_at

LEAST_SHARE = 0.5
"""Drives that are as long as this share of the way on which their bias forgets where it was have one that wanders."""
WANDER_SHARE = 0.5
"""Most of the variance that is stated for a bias that is taken for one that wanders."""
_LAG = 1 / 3
"""Over this share of that way changes are compared with their sigma."""
_START = 1 / 6
"""Over this share of it an estimate that is known is averaged where the process begins."""
_SOME_SHARE = 0.2
"""Drives that are shorter than this share of it have one bias whatever they show."""
_SHORT = 1 / 20
"""Over this share of it a drift has nearly forgotten where it was, and a bias is where it was."""
_SHOWN = 1.0
"""By how many standard deviations of their mean squares must be larger to show it: a false alarm costs a little time, one
that is missed makes covariances too small."""
_AT_REST_M = 1e-4
"""1-sigma of the process in drives that have one bias."""


@dataclass(frozen=True)
class BiasWander:
    """The prior of the process, in the drives of a bundle of which one at least needs it."""

    sigma: Float[Tensor, "j 3"]
    """By journey, east, north and up [m]; next to none where one needs none."""
    wanders: Bool[Tensor, " j"]
    """Whether it needs one: it is long, or shows it."""
    length_m: float
    far: Int[Tensor, "q 2"]
    """Nodes of drives that wander whose changes tell of the sigma, each the end of at most one such pair."""

    def expected_changes(
        self, pair: Int[Tensor, "q 2"], way: Float[Tensor, " n"], journey: Int[Tensor, " n"]
    ) -> Float[Tensor, "q 3"]:
        """Mean squares of the process's changes between nodes, by the sigmas as given."""
        first, second = pair.unbind(1)
        gap = (way[second] - way[first])[:, None]
        return -2 * torch.expm1(-gap / self.length_m) * self.sigma[journey[first]].square()


def wandering_drives(
    way: Float[Tensor, " n"],
    journey: Int[Tensor, " n"],
    length_m: float,
    error: Float[Tensor, "n 3"] | None,
    drift_sigma: Float[Tensor, "j 3"],
    drift_length_m: Float[Tensor, "j 3"],
) -> Bool[Tensor, " j"]:
    """True for the journeys whose bias wanders within what was driven.

    That is taken for granted of long drives. Of others of some length it is, if the first estimate of the positions'
    `error` at nodes changes more from end to end than a drift would that changes over short ways as it does.
    """
    low, high = group_range(way, journey, len(drift_sigma))
    is_long = high - low >= LEAST_SHARE * length_m
    some = (high - low >= _SOME_SHARE * length_m) & ~is_long
    if error is None or not bool(some.any()):
        return is_long

    def changes(pair: Int[Tensor, "q 2"]) -> Float[Tensor, "q 3"]:
        """Squares of changes, in units of those that a drift makes."""
        first, second = pair[some[journey[pair[:, 0]]]].T
        own, gap = journey[first], (way[second] - way[first])[:, None]
        expected = -2 * torch.expm1(-gap / drift_length_m[own]) * drift_sigma[own].square()
        return (error[second] - error[first]).square() / expected

    over_all = changes(_ends(journey, len(low)))
    over_short = changes(nodes_apart(journey, way, _SHORT * length_m))
    usual = over_short.mean().clamp_min(1) if len(over_short) else 1.0
    chance = 1 + _SHOWN * (2 / over_all.numel()) ** 0.5
    return is_long | (some & (over_all.mean() > chance * usual))


def bias_wander(
    sigma: Float[Tensor, "j 3"],
    wanders: Bool[Tensor, " j"],
    journey: Int[Tensor, " n"],
    way: Float[Tensor, " n"],
    length_m: float,
) -> BiasWander:
    """The prior of journeys of which those that `wanders` names wander by `sigma`, by journey and way of their nodes."""
    far = nodes_apart(journey, way, _LAG * length_m)
    within = torch.bincount(journey[far[:, 0]], minlength=len(wanders)) == 0
    ends = _ends(journey, len(wanders))
    # Of drives that are shorter than that, from end to end.
    far = torch.cat((far, ends[within[journey[ends[:, 0]]]]))
    far = far[wanders[journey[far[:, 0]]]]
    return BiasWander(torch.where(wanders[:, None], sigma, _AT_REST_M), wanders, length_m, far)


def nodes_apart(
    journey: Int[Tensor, " n"], way: Float[Tensor, " n"], lag_m: float
) -> Int[Tensor, "q 2"]:
    """The first nodes of successive stretches of `lag_m` metres of each journey."""
    begins = torch.ones_like(journey, dtype=torch.bool)
    begins[1:] = journey[1:] != journey[:-1]
    first = torch.nonzero(begins)[:, 0]
    cell = ((way - way[first][begins.cumsum(0) - 1]) / lag_m).floor()
    begins[1:] |= cell[1:] != cell[:-1]
    at = torch.nonzero(begins)[:, 0]
    same = journey[at[1:]] == journey[at[:-1]]
    return torch.stack((at[:-1], at[1:]), dim=1)[same]


def _ends(journey: Int[Tensor, " n"], journeys: int) -> Int[Tensor, "q 2"]:
    """The first and the last node of every journey that has nodes."""
    every = torch.arange(journeys, device=journey.device)
    journey = journey.contiguous()
    first = torch.searchsorted(journey, every)
    last = torch.searchsorted(journey, every, right=True) - 1
    return torch.stack((first, last), dim=1)[last >= first]


def first_wander(
    error: Float[Tensor, "n 3"],
    way: Float[Tensor, " n"],
    journey: Int[Tensor, " n"],
    wander: BiasWander,
) -> Float[Tensor, "n 3"]:
    """Where the process may begin: the positions' `error` averaged over stretches of some hundred metres, less its mean."""
    wanders, length_m = wander.wanders, wander.length_m
    cell = (way / (_START * length_m)).floor().long()
    _, of_node = torch.unique_consecutive(torch.stack((journey, cell)), dim=1, return_inverse=True)
    count = torch.bincount(of_node)[:, None]
    mean = add_at(error.new_zeros(len(count), 3), 0, of_node, error) / count
    centre = add_at(way.new_zeros(len(count)), 0, of_node, way) / count[:, 0]
    owner = torch.zeros_like(of_node[: len(count)]).index_copy_(0, of_node, journey)
    # Journeys one behind the other, far enough apart that no place lies between two of them.
    apart = way.max() + 2 * length_m if len(way) else 0.0
    at, place = owner * apart + centre, journey * apart + way
    after = torch.searchsorted(at, place).clamp(1, max(len(at) - 1, 1)).clamp_max(len(at) - 1)
    before = (after - 1).clamp_min(0)
    before = torch.where(owner[before] == journey, before, after)
    after = torch.where(owner[after] == journey, after, before)
    share = ((place - at[before]) / (at[after] - at[before]).clamp_min(1e-9)).clamp(0, 1)[:, None]
    smooth = torch.lerp(mean[before], mean[after], share)
    total = add_at(smooth.new_zeros(len(wanders), 3), 0, journey, smooth)
    total = total / torch.bincount(journey, minlength=len(wanders)).clamp_min(1)[:, None]
    return (smooth - total[journey]) * wanders[journey, None]
