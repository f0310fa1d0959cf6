"""V-B, unlike the paper: stretches of a drive on which its positions leave the road that the others drove, and come back.

A tunnel, a street between towers: for a few hundred metres positions are off by metres, and no sigma says so. The drive's
signs there stand beside those of all others and look like them. The stretch has no say in the map; the drive keeps its.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import cheapest, distinct_pairs
from crowdmap_torch.clustering.neighbours import cross_pairs
from crowdmap_torch.crowd_signs.distance import SimilarityConfig, appearance_distance
from crowdmap_torch.ranges import Cost, Count, Deviations, Factor, Length, Settings
from crowdmap_torch.tables import Signs


@dataclass(frozen=True)
class OutageConfig(Settings):
    """When a sign of a drive is taken for one of the others', displaced by an outage of positioning."""

    reach_m: Length = 8.0
    """A sign that is further from one which the others saw is not that sign."""
    min_miss_m: Length = 0.8
    """Least displacement that is taken for an outage; of less the drift is told as ever."""
    sure: Deviations = 3.0
    """Least displacement in standard deviations of where the drive by itself has the sign: who turns off before a sign
    has seen it from afar alone, and hardly knows how far it was."""
    anchor_m: Length = 0.5
    """Signs that are this near to the others' show that the positions are right again."""
    looks_cost: Cost = 9.0
    """Most that looks may differ, in squared standard deviations."""
    min_journeys: Count = 3
    """Least number of other journeys that saw the sign at its place."""
    more: Factor = 3.0
    """They are at least this many times as many as saw it where this drive did."""
    views_m: Length = 20.0
    """A sign tells of the positions over this way before it was closest."""
    beyond_m: Length = 100.0
    """Where no sign tells that positions are right, the stretch ends this far from the last displaced one."""


@dataclass(frozen=True)
class Outage:
    """A stretch of a journey without a say."""

    journey: int
    from_m: float
    """Distance driven where it begins."""
    to_m: float
    away_m: float
    """Largest displacement of a sign [m]."""


def displaced_by(
    unbiased: Signs,
    label: Int[Tensor, " n"],
    heads: Signs,
    trusted: Bool[Tensor, " n"],
    similarity: SimilarityConfig,
    config: OutageConfig,
) -> Float[Tensor, " n"]:
    """How far each sign of a journey is beside the one that the others saw [m]; 0: it is not.

    `unbiased` are the journeys' signs with their biases and drifts taken off, `label` the rows of `heads` that they
    belong to, -1 for none. A journey that has the others' sign too did see two. Nothing is asked of signs that are not
    `trusted` anyhow.
    """
    n, journey = len(label), unbiased.journey
    away = torch.zeros_like(unbiased.confidence)
    if not n or not len(heads):
        return away
    pair = cross_pairs(unbiased.center_world, heads.center_world, radius=config.reach_m, count=16)
    row, head = pair.T
    owner, drive, _ = distinct_pairs(label[label >= 0], journey[label >= 0])
    journeys = int(journey.max()) + 1
    seen = torch.zeros(len(heads) * journeys, dtype=torch.bool, device=label.device)
    seen[owner * journeys + drive] = True
    count = seen.view(-1, journeys).sum(1)
    own = torch.where(label >= 0, count[label.clamp_min(0)], 1)[row]
    most = (config.more * own).clamp_min(config.min_journeys)
    likely = ~seen[head * journeys + journey[row]] & (count[head] >= most)
    likely &= appearance_distance(unbiased[row], heads[head], similarity) <= config.looks_cost
    off = unbiased.center_world[row] - heads.center_world[head]
    distance = off.norm(dim=1)
    along = off / distance.clamp_min(1e-9)[:, None]
    variance = ((along[:, None] @ unbiased.covariance[row])[:, 0] * along).sum(1)
    likely &= (distance >= config.min_miss_m) & (distance >= config.sure * variance.sqrt())
    best, of = cheapest(row[likely], head[likely], distance[likely], n)
    return torch.where((of >= 0) & trusted, best, away)


def find_outages(
    unbiased: Signs,
    station: Float[Tensor, " n"],
    label: Int[Tensor, " n"],
    heads: Signs,
    away: Float[Tensor, " n"],
    config: OutageConfig,
) -> tuple[Outage, ...]:
    """The stretches around signs that are displaced by `away` [m], in the order of journeys and of the way."""
    own = heads.center_world[label.clamp_min(0)] if len(heads) else unbiased.center_world
    miss = (unbiased.center_world - own).norm(dim=1)
    is_right = (label >= 0) & (away == 0) & (miss <= config.anchor_m)
    found: list[Outage] = []
    for journey in torch.unique(unbiased.journey[away > 0]).tolist():
        mine = unbiased.journey == journey
        right = station[mine & is_right].sort().values
        rows = torch.nonzero(mine & (away > 0))[:, 0]
        for row in rows[station[rows].argsort(stable=True)].tolist():
            begin, end = _around(float(station[row]), right, config)
            far = float(away[row])
            last = found[-1] if found else None
            if last is not None and last.journey == journey and begin <= last.to_m:
                found.pop()
                begin, far = last.from_m, max(far, last.away_m)
                end = max(end, last.to_m)
            found.append(Outage(journey, begin, end, far))
    return tuple(found)


def outside_outages(
    station: Float[Tensor, " f"], journey: int, outages: Sequence[Outage]
) -> Bool[Tensor, " f"]:
    """True for the frames of a journey, by distance driven [m], that are on none of its stretches."""
    outside = torch.ones_like(station, dtype=torch.bool)
    for outage in outages:
        if outage.journey == journey:
            outside &= (station < outage.from_m) | (station > outage.to_m)
    return outside


def _around(at: float, right: Float[Tensor, " a"], config: OutageConfig) -> tuple[float, float]:
    """From the last sign before `at` that shows right positions to where the next one behind it does."""
    before, after = right[right < at], right[right > at]
    far, views = config.beyond_m, config.views_m
    begin = max(float(before[-1]) if len(before) else at - far, at - far)
    end = min(float(after[0]) - views if len(after) else at + far, at + far)
    # The displaced sign's own views are always in it.
    return min(begin, at - views), max(end, at)
