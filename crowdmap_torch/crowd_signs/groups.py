"""Which journeys signs tie together, and which of them only loosely (V-B).

Signs that are alike stand beside each other: those over the lanes of a motorway are one like the other, and a drive that
made one of them may be matched with the next. Where all signs of a drive find others like them at another place of the
drive, these do not tell which place is right.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_count
from crowdmap_torch.clustering.neighbours import cross_pairs, layered, pairs_between
from crowdmap_torch.crowd_signs.align import connected_journeys, in_shared_clusters
from crowdmap_torch.crowd_signs.distance import sign_distance
from crowdmap_torch.crowd_signs.match import HeadMatchConfig
from crowdmap_torch.crowd_signs.register import Crowd
from crowdmap_torch.tables import Rows

_AS_GOOD = 6.0
"""A head is as good as a sign's own unless it is dearer by so many squared standard deviations."""
_TOGETHER_M = 0.7
"""Shifts of two signs of one drive are one up to this."""


@dataclass(frozen=True, repr=False)
class OtherPlaces(Rows):
    """Of drives that signs tie loosely, where their signs find heads like them."""

    journey: Int[Tensor, " p"]
    sign: Int[Tensor, " p"]
    """Row of the crowd's members."""
    head: Int[Tensor, " p"]
    is_own: Bool[Tensor, " p"]
    """Whether the head is that of the sign's cluster."""
    shift: Float[Tensor, "p 2"]
    """What brings the sign to the head, east and north [m]."""
    bias: Float[Tensor, "p 2"]
    """Of the journey, as signs tell it [m]: a shift by it takes the drive to where it was measured."""
    seen_by: Bool[Tensor, "p j"]
    """The other journeys that the head is made of."""

    def loosely(self) -> Bool[Tensor, " j"]:
        """Which journeys signs tie loosely."""
        return torch.bincount(self.journey, minlength=self.seen_by.shape[1]) > 0

    def of(self, own: Bool[Tensor, " j"], others: Bool[Tensor, " j"]) -> OtherPlaces | None:
        """Those of some journeys, at heads that others have seen; None: there are none."""
        seen = replace(self, seen_by=self.seen_by & others)
        seen = seen[own[self.journey] & seen.seen_by.any(1)]
        return seen if len(seen) else None

    @property
    def host(self) -> Int[Tensor, " p"]:
        """One of the journeys that have seen each head."""
        return self.seen_by.long().argmax(1)

    def followed(self, move: Float[Tensor, "j 3"]) -> Float[Tensor, " 3"]:
        """By how much those were moved who have seen the heads of own signs; zero: nobody has [m]."""
        return move[self.host[self.is_own][:1]].sum(0)


def other_places(
    crowd: Crowd, config: HeadMatchConfig, *, nearest: float, farthest: float
) -> OtherPlaces:
    """Of each drive all of whose signs find heads as good as their own when it is moved by `nearest` to `farthest` [m]."""
    journeys, label = len(crowd.bias), _of_good_drives(crowd)
    used = torch.nonzero(in_shared_clusters(crowd.members.journey, label))[:, 0]
    every = group_count(crowd.members.journey[used], journeys)
    found = _alike(crowd, used, config, farthest)
    far = found.shift.norm(dim=1) > nearest
    # Where a sign has none like it nothing has to be compared: of long drives that is one of many.
    with_others = crowd.members.journey[torch.unique(found.sign[far])]
    may_be = (group_count(with_others, journeys) == every)[found.journey]
    found, far = found[may_be], far[may_be]
    layers = layered(found.shift, found.journey, _TOGETHER_M)
    one, other, _ = pairs_between(layers[far], layers, radius=_TOGETHER_M)
    met = torch.unique(torch.stack((one, found.sign[other]), dim=1), dim=0)[:, 0]
    elsewhere = found.journey[far]
    loose = elsewhere[group_count(met, len(elsewhere)) == every[elsewhere]]
    found = found[torch.isin(found.journey, loose)]
    # Of the heads that are asked for alone: a city has many heads and many journeys.
    heads, row = torch.unique(found.head, return_inverse=True)
    of_heads = used[torch.isin(label[used], heads)]
    seen_by = torch.zeros(len(heads), journeys, dtype=torch.bool, device=label.device)
    seen_by[torch.searchsorted(heads, label[of_heads]), crowd.members.journey[of_heads]] = True
    is_itself = torch.arange(journeys, device=label.device) == found.journey[:, None]
    return replace(found, seen_by=seen_by[row] & ~is_itself)


def _alike(
    crowd: Crowd, rows: Int[Tensor, " n"], config: HeadMatchConfig, farthest: float
) -> OtherPlaces:
    """Members with heads that are as good as their own, up to so far away [m]; who has seen these is left out."""
    members, place, head = crowd.members, crowd.members.center_world, crowd.heads.center_world
    pair = cross_pairs(place[rows, :2], head[:, :2], radius=farthest, count=config.candidates)
    pair = torch.stack((rows[pair[:, 0]], pair[:, 1]), dim=1)
    sigma = place.new_tensor((farthest, farthest, config.leftover_sigma_m))
    cost = sign_distance(members, crowd.heads, pair, config.similarity, sigma)
    own = pair[:, 1] == crowd.label[pair[:, 0]]
    dearest = cost.new_zeros(len(members)).index_put((pair[own, 0],), cost[own] + _AS_GOOD)
    good = cost <= dearest[pair[:, 0]]
    (sign, to), own = pair[good].T, own[good]
    journey = members.journey[sign]
    return OtherPlaces(
        journey=journey,
        sign=sign,
        head=to,
        is_own=own,
        shift=head[to, :2] - place[sign, :2],
        bias=crowd.bias.translation[journey, :2],
        seen_by=torch.zeros(len(sign), 0, dtype=torch.bool, device=sign.device),
    )


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
