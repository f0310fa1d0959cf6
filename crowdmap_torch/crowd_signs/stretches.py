"""V-B, unlike the paper: how large biases are, and the first ones, of long drives by a vote for every few kilometres."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.crowd_signs.align import AlignConfig, JourneyBias, no_bias
from crowdmap_torch.crowd_signs.gather import CrowdSigns
from crowdmap_torch.crowd_signs.vote import VoteConfig, vote_biases
from crowdmap_torch.noise.bias_wander import LEAST_SHARE, WANDER_SHARE
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.optim.robust import median_along, median_scale

_STRETCH = 1 / 10
"""Of the way on which a bias forgets where it was: the most that it is taken to stand still over."""
_FREE = 3.0
"""Biases are first looked for as if they were this many times as large as expected."""
_FARTHER = 2.0
"""... and shifts between drives this many times as far."""
_LARGER = 1.5
"""Where those found are larger than expected by this factor along any axis, they stand ..."""
_CHANCE = 4
"""... and by more where drives are few: of so many, by twice as much."""


def first_biases(
    crowd: CrowdSigns,
    positioning: PositioningNoise,
    align: AlignConfig,
    config: VoteConfig,
    *,
    generator: torch.Generator,
) -> tuple[JourneyBias, Float[Tensor, "j 3"]]:
    """The biases that `vote_by_stretch` finds, and 1-sigma of how large they may be, as wide as these are [m].

    Shifts of many times what is expected lose the vote to wrong ones between neighbours: a drive is placed beside all
    others, where its signs are nobody's or seem to be displaced. So a vote comes first that leaves biases free.
    """
    start = no_bias(crowd.signs, crowd.station, positioning, align, journeys=crowd.journeys)
    same = torch.Generator().set_state(generator.get_state())
    free = replace(crowd, bias_sigma=_FREE * crowd.bias_sigma)
    far = replace(config, radius_m=_FARTHER * config.radius_m, height_m=_FARTHER * config.height_m)
    found = vote_by_stretch(free, start, positioning, far, generator=same)
    away = (found.translation - median_along(found.translation, 0)) / crowd.bias_sigma
    least = _LARGER * (1 + _CHANCE / max(crowd.journeys, 1))
    if any(float(median_scale(axis)) > least for axis in away.unbind(1)):
        return found, free.bias_sigma
    found = vote_by_stretch(crowd, start, positioning, config, generator=generator)
    return found, crowd.bias_sigma


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
