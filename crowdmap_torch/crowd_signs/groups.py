"""Which journeys signs tie together, and which of them only loosely (V-B).

Signs that are alike stand beside each other: those over the lanes of a motorway are one like the other, and a drive that
made one of them may be matched with the next. Where all signs of a drive find others like them at another place of the
drive, these do not tell which place is right.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_count
from crowdmap_torch.clustering.neighbours import cross_pairs, layered, pairs_between
from crowdmap_torch.crowd_signs.align import connected_journeys, in_shared_clusters
from crowdmap_torch.crowd_signs.distance import sign_distance
from crowdmap_torch.crowd_signs.match import HeadMatchConfig
from crowdmap_torch.crowd_signs.register import Crowd

_AS_GOOD = 6.0
"""A head is as good as a sign's own unless it is dearer by so many squared standard deviations."""
_TOGETHER_M = 0.7
"""Shifts of two signs of one drive are one up to this."""


@dataclass(frozen=True)
class OtherPlaces:
    """Of drives that signs tie loosely, where their signs find heads like them."""

    journey: Int[Tensor, " p"]
    sign: Int[Tensor, " p"]
    """Row of the crowd's members."""
    is_own: Bool[Tensor, " p"]
    """Whether the head is that of the sign's cluster."""
    shift: Float[Tensor, "p 2"]
    """What brings the sign to the head, east and north [m]."""
    seen_by: Bool[Tensor, "p j"]
    """The other journeys that the head is made of."""
    bias: Float[Tensor, "j 2"]
    """Of all journeys, east and north, as signs tell it [m]: a shift by it takes a drive to where it was measured."""

    def loosely(self) -> Bool[Tensor, " j"]:
        """Which journeys signs tie loosely."""
        return torch.bincount(self.journey, minlength=len(self.bias)) > 0

    def of(self, own: Bool[Tensor, " j"], others: Bool[Tensor, " j"]) -> OtherPlaces | None:
        """Those of some journeys, at heads that others have seen; None: there are none."""
        seen_by = self.seen_by & others
        rows = torch.nonzero(own[self.journey] & seen_by.any(1))[:, 0]
        if not len(rows):
            return None
        return OtherPlaces(
            self.journey[rows],
            self.sign[rows],
            self.is_own[rows],
            self.shift[rows],
            seen_by[rows],
            self.bias,
        )

    @property
    def host(self) -> Int[Tensor, " p"]:
        """One of the journeys that have seen each head."""
        return self.seen_by.long().argmax(1)


def other_places(
    crowd: Crowd, config: HeadMatchConfig, *, nearest: float, farthest: float
) -> OtherPlaces:
    """Of each drive all of whose signs find heads as good as their own when it is moved by `nearest` to `farthest` [m]."""
    members, label, journeys = crowd.members, _of_good_drives(crowd), len(crowd.bias)
    used = torch.nonzero(in_shared_clusters(members.journey, label))[:, 0]
    place, head = members.center_world, crowd.heads.center_world
    pair = cross_pairs(place[used, :2], head[:, :2], radius=farthest, count=config.candidates)
    pair = torch.stack((used[pair[:, 0]], pair[:, 1]), dim=1)
    sigma = place.new_tensor((farthest, farthest, config.leftover_sigma_m))
    cost = sign_distance(members, crowd.heads, pair, config.similarity, sigma)
    sign, to = pair.T
    own = to == label[sign]
    dearest = cost.new_zeros(len(members)).index_put((sign[own],), cost[own] + _AS_GOOD)
    good = cost <= dearest[sign]
    sign, to, own = sign[good], to[good], own[good]
    journey, shift = members.journey[sign], head[to, :2] - place[sign, :2]
    far = shift.norm(dim=1) > nearest
    every = group_count(members.journey[used], journeys)
    # Where a sign has none like it nothing has to be compared: of long drives that is one of many.
    may_be = every == group_count(members.journey[torch.unique(sign[far])], journeys)
    kept = may_be[journey]
    sign, to, own, far = sign[kept], to[kept], own[kept], far[kept]
    journey, shift = journey[kept], shift[kept]
    layers = layered(shift, journey, _TOGETHER_M)
    one, other, _ = pairs_between(layers[far], layers, radius=_TOGETHER_M)
    met = torch.unique(torch.stack((one, sign[other]), dim=1), dim=0)[:, 0]
    of_rival = journey[far]
    loose = of_rival[group_count(met, len(of_rival)) == every[of_rival]]
    kept = torch.isin(journey, loose)
    sign, to, own = sign[kept], to[kept], own[kept]
    journey, shift = journey[kept], shift[kept]
    # Of the heads that are asked for alone: a city has many heads and many journeys.
    heads, place_of = torch.unique(to, return_inverse=True)
    of_heads = used[torch.isin(label[used], heads)]
    seen_by = torch.zeros(len(heads), journeys, dtype=torch.bool, device=label.device)
    seen_by[torch.searchsorted(heads, label[of_heads]), members.journey[of_heads]] = True
    seen_by = seen_by[place_of]
    seen_by[torch.arange(len(to), device=to.device), journey] = False
    bias = crowd.bias.translation[:, :2]
    return OtherPlaces(journey, sign, own, shift, seen_by, bias)


def groups_of(crowd: Crowd, loosely: Bool[Tensor, " j"]) -> Int[Tensor, " j"]:
    """By journey the group that it is in: those of one group saw signs in common, by one or several steps.

    Bad drives, and those that signs tie `loosely`, tie nobody to anybody, and are groups of their own.
    """
    journey = crowd.members.journey
    label = _of_good_drives(crowd).masked_fill(loosely[journey], -1)
    used = in_shared_clusters(journey, label)
    return connected_journeys(journey[used], label[used], len(crowd.bias))


def _of_good_drives(crowd: Crowd) -> Int[Tensor, " n"]:
    """Labels of the members; -1 for those of bad drives."""
    return crowd.label.masked_fill(crowd.journey_weight[crowd.members.journey] == 0, -1)
