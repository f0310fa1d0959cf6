"""V-A.1, unlike the paper: how sure it is that a sign exists, from who passed by and who saw it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from crowdmap_torch.clustering.groups import distinct_pairs, group_count, group_median, group_sum
from crowdmap_torch.crowd_signs.gather import CrowdSigns
from crowdmap_torch.ranges import Length, Settings, Share, Spacing
from crowdmap_torch.tables import Association, Signs, Tracklets


@dataclass(frozen=True)
class ExistenceConfig(Settings):
    """What a passing journey that saw a sign, or did not, says."""

    false_rate: Share = 0.01
    """Probability that a passing journey shows a sign where there is none, at the same place as another journey."""
    passing_m: Length = 12.0
    """A journey passed by a sign if it came this close to where others saw it from, heading the same way [m]."""
    tentative: Share = 0.45
    """Most confidence of a sign that too few journeys saw."""
    cell_m: Spacing = 25.0
    """Cells in which journeys are counted that could have seen a single sign [m]."""


def existence(
    seen: Int[Tensor, " c"], passed: Int[Tensor, " c"], config: ExistenceConfig
) -> Float[Tensor, " c"]:
    """Probability that a sign exists which `seen` of `passed` journeys saw, as likely as not beforehand.

    A real sign is seen by each journey with a probability that nobody knows (uniform between 0 and 1), a false one with
    `false_rate`.
    """
    n, m = seen.double(), torch.maximum(passed, seen).double()
    real = torch.lgamma(n + 1) + torch.lgamma(m - n + 1) - torch.lgamma(m + 2)
    false = n * np.log(config.false_rate) + (m - n) * np.log1p(-config.false_rate)
    return torch.sigmoid(real - false)


def still_alone(
    singles: Signs, tracklets: Sequence[Tracklets], associations: Sequence[Association]
) -> Bool[Tensor, " n"]:
    """True for the signs of single journeys of whose detections less than half show a sign of the map."""
    alone = torch.ones(len(singles), dtype=torch.bool, device=singles.shape.device)
    for number in singles.journey.unique().tolist():
        label, count = tracklets[number].label, tracklets[number].count
        shown = group_count(label.masked_fill(associations[number].sign < 0, -1), count)
        rows = torch.nonzero(singles.journey == number)[:, 0]
        own = singles.tracklet[rows]
        alone[rows] = 2 * shown[own] < group_count(label, count)[own]
    return alone


def passing_journeys(
    crowd: CrowdSigns, label: Int[Tensor, " n"], count: int, config: ExistenceConfig
) -> Int[Tensor, " c"]:
    """How many journeys came by the place that the members of each cluster were seen from, heading the same way."""
    if not count or not len(crowd.path_journey):
        return torch.zeros(count, dtype=torch.int64, device=label.device)
    position = group_median(crowd.view_position, label, count).cpu().numpy()
    direction = group_sum(crowd.view_direction, label, count)
    direction = torch.nn.functional.normalize(direction, dim=1)
    tree = KDTree(crowd.path_position[:, :2].cpu().numpy())
    near = tree.query_ball_point(position[:, :2], config.passing_m)
    rows = torch.from_numpy(np.concatenate([np.asarray(r, dtype=np.int64) for r in near]))
    size = torch.tensor([len(r) for r in near])
    owner = torch.repeat_interleave(torch.arange(count), size)
    rows, owner = rows.to(label.device), owner.to(label.device)
    same_way = (crowd.path_direction[rows] * direction[owner]).sum(1) > 0.5
    clusters, _, _ = distinct_pairs(owner[same_way], crowd.path_journey[rows][same_way])
    return group_count(clusters, count)


def has_company(crowd: CrowdSigns, config: ExistenceConfig) -> Bool[Tensor, " n"]:
    """True for signs at places where at least two other journeys drove the same way, so that somebody could tell."""
    if not len(crowd.path_journey) or not len(crowd.signs):
        return torch.zeros(len(crowd.signs), dtype=torch.bool, device=crowd.station.device)
    path = _cell(crowd.path_position, crowd.path_direction, config)
    view = _cell(crowd.view_position, crowd.view_direction, config)
    low = torch.minimum(path.amin(0), view.amin(0)) - 1
    span = torch.maximum(path.amax(0), view.amax(0)) + 2 - low
    steps = torch.arange(-1, 2, device=path.device)
    around = torch.cartesian_prod(steps, steps, steps)

    def key(cell: Int[Tensor, "*batch 3"]) -> Int[Tensor, " *batch"]:
        x, y = (cell[..., :2] - low[:2]).unbind(-1)
        return (x * span[1] + y) * _DIRECTIONS + cell[..., 2] % _DIRECTIONS

    journeys = crowd.journeys
    first = torch.unique(key(path) * journeys + crowd.path_journey, return_inverse=True)[1]
    row = torch.zeros(int(first.max()) + 1, dtype=torch.int64, device=path.device)
    row[first] = torch.arange(len(path), device=path.device)  # one sample a journey and cell
    near = key(path[row][:, None] + around) * journeys + crowd.path_journey[row][:, None]
    cells, drives = torch.unique(torch.unique(near) // journeys, return_counts=True)
    at = torch.searchsorted(cells, key(view)).clamp_max(len(cells) - 1)
    # The journey that saw the sign is one of them.
    return (cells[at] == key(view)) & (drives[at] >= 3)


_DIRECTIONS = 8


def _cell(
    position: Float[Tensor, "q 3"], direction: Float[Tensor, "q 3"], config: ExistenceConfig
) -> Int[Tensor, "q 3"]:
    """East and north cell, and the eighth of the compass it heads for."""
    angle = torch.atan2(direction[:, 1], direction[:, 0]) * (_DIRECTIONS / (2 * torch.pi))
    place = position[:, :2] / config.cell_m
    return torch.cat((place, angle[:, None]), dim=1).floor().long()
