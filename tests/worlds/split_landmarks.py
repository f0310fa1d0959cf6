"""Signs and markers that clustering took for two: each half of their drives shows one of them."""

from __future__ import annotations

from dataclasses import replace

import torch

from crowdmap_torch.mapper import FirstMap
from crowdmap_torch.tables import concatenate, concatenate_lanes


def with_a_split_sign(first: FirstMap, *, apart_m: float = 0.3) -> FirstMap:
    """The map with its sign of most drives there twice: every other drive that saw it shows the one `apart_m` beside it."""
    sign, count = int(first.signs.n_journeys.argmax()), len(first.signs)
    other = first.signs[torch.tensor([sign])]
    T = other.T_world_sign.clone()
    T[:, 0, 3] += apart_m
    drives = [n for n, shown in enumerate(first.associations) if bool((shown.sign == sign).any())]
    moved = [
        replace(shown, sign=torch.where(shown.sign == sign, count, shown.sign))
        if number in drives[::2]
        else shown
        for number, shown in enumerate(first.associations)
    ]
    signs = concatenate([first.signs, replace(other, T_world_sign=T)])
    return replace(first, signs=signs, associations=tuple(moved))


def with_split_lanes(first: FirstMap, *, apart_m: float = 0.7) -> FirstMap:
    """The map with all of its markers there twice: what every other drive saw is of copies `apart_m` beside them."""
    lanes, support = first.lanes, first.lane_support
    beside = lanes.control.point_world + torch.tensor([apart_m, apart_m, 0.0]).to(
        support.point_world
    )
    copies = replace(lanes, control=replace(lanes.control, point_world=beside))
    moved = (support.lane >= 0) & (support.journey % 2 == 1)
    lane = torch.where(moved, support.lane + len(lanes), support.lane)
    both = concatenate_lanes([lanes, copies])
    return replace(first, lanes=both, lane_support=replace(support, lane=lane))
