"""V-A.1, unlike the paper: who saw the signs of a map, by the detections that show them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import distinct_pairs, group_count
from crowdmap_torch.crowd_signs.completion import CompleteTracksConfig
from crowdmap_torch.tables import Association, Journey, Signs


def seen_by(
    label: Sequence[Int[Tensor, " _"]],
    count: int,
    trusted: Bool[Tensor, " j"],
    config: CompleteTracksConfig,
) -> Int[Tensor, " n"]:
    """How many `trusted` journeys saw each of `count` signs; `label`s are the signs that detections show, -1 is none."""
    used, journey = of_trusted(label, trusted)
    owner, _, views = distinct_pairs(torch.cat([*label])[used], journey)
    return group_count(owner[views >= config.evidence], count)


def of_its_shape(association: Association, journey: Journey, signs: Signs) -> Int[Tensor, " d"]:
    """The sign that each detection of a journey shows if it has that sign's shape; -1: it shows none, or as another one."""
    shown = association.sign
    alike = journey.signs.shape == signs.shape[shown.clamp_min(0)]
    return shown.masked_fill(~alike, -1)


def of_trusted(
    label: Sequence[Int[Tensor, " _"]], trusted: Bool[Tensor, " j"]
) -> tuple[Int[Tensor, " u"], Int[Tensor, " u"]]:
    """Rows, of all journeys' detections, that show a sign, of trusted journeys; and the journey of each."""
    size = torch.tensor([len(own) for own in label], device=trusted.device)
    journey = torch.repeat_interleave(torch.arange(len(label), device=trusted.device), size)
    used = torch.nonzero((torch.cat([*label]) >= 0) & trusted[journey])[:, 0]
    return used, journey[used]
