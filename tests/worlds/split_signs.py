"""Signs that clustering took for two: each half of their drives shows one of them."""

from __future__ import annotations

from dataclasses import replace

import torch

from crowdmap_torch.mapper import FirstMap
from crowdmap_torch.tables import concatenate


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
