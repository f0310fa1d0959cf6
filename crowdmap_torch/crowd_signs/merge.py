"""V-A.1, unlike the paper: which clusters are one sign, by what the journeys that passed saw beside each other."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import cheapest, distinct_pairs, rows_of_ranges
from crowdmap_torch.clustering.neighbours import near_pairs
from crowdmap_torch.crowd_signs.distance import SimilarityConfig, appearance_distance, sign_distance
from crowdmap_torch.ranges import Cost, Count, Degrees, Factor, Length, Settings, Share, Sigma
from crowdmap_torch.tables import Signs


@dataclass(frozen=True)
class SignMergeConfig(Settings):
    """When two clusters are one sign; costs are squared standard deviations."""

    merge_cost: Cost = 9.0
    """Clusters closer than this are one, unless journeys saw both in one frame."""
    alone_m: Length = 1.5
    """Signs closer than this would be seen together [m]: clusters that nobody saw both of in one frame are one."""
    alone_journeys: Factor = 2.5
    """So many journeys should have seen both for that, were there two."""
    alone_cost: Cost = 12.0
    """Most that such clusters may differ in appearance."""
    told_apart: Share = 0.3
    """Share of the journeys of the smaller cluster that must have seen both in one frame for clusters to be two."""
    overlap: Share = 0.35
    """Clusters closer than this share of the smaller side are one plate detected twice."""
    weak: Share = 0.3
    """A cluster with fewer journeys than this share of a similar neighbour's, not told apart from it, is dissolved."""
    weak_cost: Cost = 16.0
    """Up to this cost, shifts taken to be uncertain by `weak_sigma_m`."""
    weak_sigma_m: Sigma = 0.5
    """Uncertainty of the places of weak clusters [m]."""
    pass_m: Length = 80.0
    """Signs that a journey saw within this distance it saw in one pass [m]."""
    pass_share: Share = 0.5
    """Share of a cluster's journeys that must have seen it and its neighbour in one pass, yet never both at once."""
    pass_limit_deg: Degrees = 130.0
    """Such clusters are one sign up to this angle between them: from afar, the side a plate is turned to is a guess."""
    max_distance_m: Length = 3.0
    """Clusters further apart are never one."""
    candidates: Count = 8
    """Clusters that a cluster is compared with, the nearest."""
    similarity: SimilarityConfig = field(default_factory=SimilarityConfig)
    """What differences of appearance cost."""


def merge_heads(
    signs: Signs,
    label: Int[Tensor, " n"],
    heads: Signs,
    seen_together: Int[Tensor, "p 2"],
    config: SignMergeConfig,
    *,
    shift_sigma: Float[Tensor, " 3"],
) -> Int[Tensor, " n"]:
    """Labels with clusters joined that are one sign: close, alike, and not told apart by the journeys.

    A few journeys may tell apart what is one, by signs that are in the wrong cluster; matching sorts those out. Where
    two clusters lie so close that their plates would overlap, they are one whoever saw both: a sign detected twice.
    Each cluster is joined with at most one other.
    """
    pair = near_pairs(heads.center_world, radius=config.max_distance_m, count=config.candidates)
    if not len(pair):
        return label
    a, b = pair.T
    cost = sign_distance(heads, heads, pair, config.similarity, shift_sigma)
    size = torch.minimum(heads.size[a].amin(1), heads.size[b].amin(1))
    distance = (heads.center_world[a] - heads.center_world[b]).norm(dim=1)
    overlaps = (distance < config.overlap * size) & cost.isfinite()
    expected, smaller = _expected_witnesses(signs, label, pair, len(heads))
    witnesses = _witnesses(signs, label, seen_together, pair, len(heads))
    told_apart = witnesses > config.told_apart * smaller
    look = appearance_distance(heads[a], heads[b], config.similarity)
    alone = (distance < config.alone_m) & (look < config.alone_cost)
    alone &= expected >= config.alone_journeys
    merge = overlaps | (~told_apart & ((cost < config.merge_cost) | alone))
    target = mutual_partners(pair[merge], cost[merge], len(heads))
    return torch.where(label < 0, label, target[label.clamp_min(0)])


def mutual_partners(
    pair: Int[Tensor, "p 2"], cost: Float[Tensor, " p"], count: int
) -> Int[Tensor, " n"]:
    """Of `count` rows the smaller of each two that are one another's cheapest partner, of the others themselves."""
    a, b = pair.T
    rows = torch.cat((a, b))
    best, partner = cheapest(rows, torch.cat((b, a)), torch.cat((cost, cost)), count)
    own = torch.arange(count, device=pair.device)
    mutual = best.isfinite() & (partner[partner.clamp_min(0)] == own)
    return torch.where(mutual, torch.minimum(partner, own), own)


def dissolve_weak(
    signs: Signs,
    label: Int[Tensor, " n"],
    heads: Signs,
    seen_together: Int[Tensor, "p 2"],
    config: SignMergeConfig,
) -> Int[Tensor, " n"]:
    """Labels in which the members of weak clusters beside strong ones that look alike have none.

    Two signs do not stand so close without anybody seeing both: such clusters are badly placed copies.
    """
    near = near_pairs(heads.center_world, radius=config.max_distance_m, count=config.candidates)
    pair = torch.cat((near, near.flip(1)))  # the second would dissolve the first
    number = heads.n_journeys[pair]
    pair = pair[number[:, 0] < config.weak * number[:, 1]]
    sigma = signs.size.new_full((3,), config.weak_sigma_m)
    cost = sign_distance(heads, heads, pair, config.similarity, sigma)
    witnesses = _witnesses(signs, label, seen_together, pair, len(heads))
    told_apart = witnesses > config.told_apart * heads.n_journeys[pair[:, 0]]
    dissolved = pair[(cost < config.weak_cost) & ~told_apart, 0]
    return label.masked_fill(torch.isin(label, dissolved), -1)


def join_passes(
    signs: Signs,
    label: Int[Tensor, " n"],
    heads: Signs,
    station: Float[Tensor, " n"],
    seen_together: Int[Tensor, "p 2"],
    config: SignMergeConfig,
) -> Int[Tensor, " n"]:
    """Labels with clusters joined that the same journeys saw in one pass, one after the other, but never both at once.

    They are a sign seen from afar, when the direction it faces is ambiguous, and from nearby.
    """
    pair = near_pairs(heads.center_world, radius=config.alone_m, count=config.candidates)
    if not len(pair):
        return label
    number = heads.n_journeys[pair]
    pair = torch.where((number[:, 0] > number[:, 1])[:, None], pair.flip(1), pair)  # weaker first
    a, b = pair.T
    cosine = (heads.normal_world[a] * heads.normal_world[b]).sum(1)
    limit = torch.cos(torch.deg2rad(cosine.new_tensor(config.pass_limit_deg)))
    pair = pair[cosine > limit]
    # Journeys a kilometre apart: only signs of one journey are near each other.
    apart = torch.cat((signs.center_world, 1000.0 * signs.journey[:, None]), dim=1)
    one_pass = near_pairs(apart, radius=config.max_distance_m, count=config.candidates)
    i, k = one_pass.T
    one_pass = one_pass[(station[i] - station[k]).abs() < config.pass_m]
    passes = _witnesses(signs, label, one_pass, pair, len(heads))
    witnesses = _witnesses(signs, label, seen_together, pair, len(heads))
    weaker = heads.n_journeys[pair[:, 0]]
    one = (passes >= 2) & (passes >= config.pass_share * weaker)
    one &= witnesses <= config.told_apart * weaker
    # Of several stronger neighbours the one that most journeys passed with; chains are joined in further calls.
    pair, passes = pair[one], passes[one]
    _, target = cheapest(pair[:, 0], pair[:, 1], -passes.to(cosine), len(heads))
    own = torch.arange(len(heads), device=label.device)
    target = torch.where((target >= 0) & (target[target.clamp_min(0)] < 0), target, own)
    return torch.where(label < 0, label, target[label.clamp_min(0)])


def _witnesses(
    signs: Signs,
    label: Int[Tensor, " n"],
    seen_together: Int[Tensor, "q 2"],
    pair: Int[Tensor, "p 2"],
    count: int,
) -> Int[Tensor, " p"]:
    """How many journeys saw a sign of each of two clusters in one frame."""
    labels = label[seen_together]
    crossing = (labels >= 0).all(1) & (labels[:, 0] != labels[:, 1])
    labels = labels[crossing]
    journey = signs.journey[seen_together[crossing, 0]]
    key = labels.amin(1) * count + labels.amax(1)
    once, _, _ = distinct_pairs(key, journey)
    keys, number = torch.unique(once, return_counts=True)
    wanted = pair.amin(1) * count + pair.amax(1)
    if not len(keys):
        return torch.zeros_like(wanted)
    at = torch.searchsorted(keys, wanted).clamp_max(len(keys) - 1)
    return torch.where(keys[at] == wanted, number[at], 0)


def _expected_witnesses(
    signs: Signs, label: Int[Tensor, " n"], pair: Int[Tensor, "p 2"], count: int
) -> tuple[Float[Tensor, " p"], Int[Tensor, " p"]]:
    """How many journeys would see both clusters of a pair if they were two signs; and the journeys of the smaller.

    Each is seen by a share of the journeys at the place, independently of the other.
    """
    used = label >= 0
    journeys = int(signs.journey.max()) + 1
    key = torch.unique(label[used] * journeys + signs.journey[used])
    owner, journey = key // journeys, key % journeys
    size = torch.bincount(owner, minlength=count)
    start = size.cumsum(0) - size
    a, b = pair.T
    index, row = rows_of_ranges(start[a], size[a])
    present = torch.isin(b[index] * journeys + journey[row], key)
    both = torch.zeros(len(pair), dtype=torch.int64, device=pair.device)
    both = both.index_add(0, index, present.long())
    union = (size[a] + size[b] - both).clamp_min(1)
    return size[a] * size[b] / union, torch.minimum(size[a], size[b])
