"""V-B, unlike the paper: how large biases are, and the first ones, by votes on whole drives and on stretches of them."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.crowd_signs.align import AlignConfig, no_bias
from crowdmap_torch.crowd_signs.cluster import moved
from crowdmap_torch.crowd_signs.gather import CrowdSigns
from crowdmap_torch.crowd_signs.journey_bias import JourneyBias, bias_at
from crowdmap_torch.crowd_signs.vote import VoteConfig, vote_biases
from crowdmap_torch.noise.bias_wander import LEAST_SHARE, WANDER_SHARE
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.optim.robust import median_along

_STRETCH = 1 / 10
"""Of the way on which a bias forgets where it was: the most that it is taken to stand still over."""
_FREE = 3.0
"""Biases are first looked for as if they were this many times as large as expected."""
_LEFT_M = 2.0
"""1-sigma of what a stretch may be off by beyond its drive [m]."""
_SHORT_M = 375.0
"""Ways of which a tenth is such a stretch [m]."""
_EXPECTED = 4.0
"""What is expected of biases counts as much as so many drives."""


FirstBiases = tuple[JourneyBias, Float[Tensor, " 3"]]
"""Biases, and how many times as large as expected they are, by axis."""


def first_biases(
    crowd: CrowdSigns,
    positioning: PositioningNoise,
    align: AlignConfig,
    config: VoteConfig,
    *,
    generator: torch.Generator,
) -> FirstBiases:
    """The biases that `vote_by_stretch` finds, and how many times as large as expected they are, at least one, by axis.

    Shifts of more than what is expected lose the vote to wrong ones between neighbours: a drive is placed beside all
    others, where its signs are nobody's or seem to be displaced. So biases are free in a vote of whole drives; what is
    left is voted on stretch by stretch, as it may change along a drive by more than a drift is expected to.
    """
    start = no_bias(crowd.signs, crowd.station, positioning, align, journeys=crowd.journeys)
    free = replace(crowd, bias_sigma=_FREE * crowd.bias_sigma)
    found = vote_by_stretch(free, start, positioning, config, generator=generator)
    away = (found.translation - median_along(found.translation, 0)) / crowd.bias_sigma
    # One that is further off than the free vote is for says no more of the others.
    square = away.clamp(-_FREE, _FREE).square().sum(0)
    larger = ((_EXPECTED + square) / (_EXPECTED + crowd.journeys)).sqrt().clamp_min(1)
    signs = crowd.signs
    rest = moved(signs, -bias_at(found, signs.journey, crowd.station, signs.center_world))
    left = replace(crowd, signs=rest, bias_sigma=torch.full_like(free.bias_sigma, _LEFT_M))
    short = replace(positioning, wander_length_m=_SHORT_M)
    wide = replace(config, outlier_m=max(config.outlier_m, _LEFT_M))
    more = vote_by_stretch(left, start, short, wide, generator=generator)
    found = replace(
        found,
        translation=found.translation + more.translation,
        node_drift=found.node_drift + more.node_drift,
    )
    return found, larger


def vote_by_stretch(
    crowd: CrowdSigns,
    start: JourneyBias,
    positioning: PositioningNoise,
    config: VoteConfig,
    *,
    generator: torch.Generator,
) -> JourneyBias:
    """The first biases (`vote_biases`); those of long drives change from stretch to stretch, linear between their middles.

    `start` says where the drives' nodes are; what it knows of their biases is of no account.
    """
    signs, station, bias_sigma = crowd.signs, crowd.station, crowd.bias_sigma
    length = positioning.wander_length_m
    is_long = (start.length >= LEAST_SHARE * length) & (positioning.wander_sigma_m > 0)
    count = torch.where(is_long, (start.length / (_STRETCH * length)).ceil().long(), 1)
    first, each = count.cumsum(0) - count, start.length / count
    owner = torch.repeat_interleave(torch.arange(len(start), device=count.device), count)
    own = signs.journey
    rank = ((station - start.node_origin[own]) / each[own]).floor().long()
    stretch = first[own] + torch.minimum(rank.clamp_min(0), count[own] - 1)
    follows = torch.nonzero(owner[1:] == owner[:-1])[:, 0]
    wander = WANDER_SHARE * bias_sigma[owner[follows]].square().mean(1)
    change = -2 * math.expm1(-_STRETCH) * wander
    found = vote_biases(
        replace(signs, journey=stretch),
        config,
        journeys=len(owner),
        bias_sigma=bias_sigma[owner],
        generator=generator,
        follows=follows,
        steps=change.sqrt(),
    )
    total = found.new_zeros(len(start), 3).index_add_(0, owner, found)
    translation = total / count[:, None]
    of_node = start.journey_of_node
    place = (start.node_station - start.node_origin[of_node]) / each[of_node] - 0.5
    before = place.floor().long().clamp_min(0)
    before = torch.minimum(before, (count[of_node] - 2).clamp_min(0))
    after = torch.minimum(before + 1, count[of_node] - 1)
    share = (place - before).clamp(0, 1)[:, None]
    at_node = torch.lerp(found[first[of_node] + before], found[first[of_node] + after], share)
    wander = torch.where(is_long[of_node, None], at_node - translation[of_node], 0.0)
    return replace(start, translation=translation, node_drift=wander, node_wander=wander)
