"""V-A.1, unlike the paper: each journey's signs against the cluster heads one to one, with hard rules."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import distinct_pairs, group_count
from crowdmap_torch.clustering.matching import match_slots
from crowdmap_torch.clustering.neighbours import cross_pairs, near_pairs
from crowdmap_torch.clustering.spectral import renumber
from crowdmap_torch.similarity import SimilarityConfig, appearance_distance, place_distance
from crowdmap_torch.tables import Signs


@dataclass(frozen=True)
class SignMatchConfig:
    """When a triangulated sign belongs to a cluster; costs are squared standard deviations."""

    unmatched_cost: float = 25.0
    """Cost of leaving a sign without a cluster: no pair dearer than this is matched."""
    fragment_cost: float = 16.0
    """A second sign of a journey joins a cluster up to this cost, if never seen in one frame with the first."""
    merge_cost: float = 9.0
    """Clusters closer than this are one, unless journeys saw both in one frame."""
    alone_m: float = 1.5
    """Signs closer than this would be seen together [m]: clusters that nobody saw both of in one frame are one."""
    alone_journeys: float = 2.5
    """So many journeys should have seen both for that, were there two."""
    alone_cost: float = 12.0
    """Most that such clusters may differ in appearance."""
    told_apart: float = 0.3
    """Share of the journeys of the smaller cluster that must have seen both in one frame for clusters to be two."""
    overlap: float = 0.35
    """Clusters closer than this share of the smaller side are one plate detected twice."""
    weak: float = 0.3
    """A cluster with fewer journeys than this share of a similar neighbour's, not told apart from it, is dissolved."""
    harvest_sigma_m: float = 0.5
    """Uncertainty of the shift of signs left over when they are offered to the finished clusters [m]."""
    max_distance_m: float = 3.0
    """No sign is further from its cluster's head, however uncertain it is."""
    candidates: int = 8
    """Heads that a sign is compared with, the nearest."""
    similarity: SimilarityConfig = field(default_factory=SimilarityConfig)
    """What differences of appearance cost."""


@dataclass(frozen=True)
class SignMatches:
    """The cluster of each sign."""

    label: Int[Tensor, " n"]
    """Row of the heads; -1 for none."""
    certainty: Float[Tensor, " n"]
    """0 to 1: how far the sign prefers its cluster to any other, taken or not; 0 for none."""


def match_signs(
    signs: Signs,
    heads: Signs,
    seen_together: Int[Tensor, "p 2"],
    config: SignMatchConfig,
    *,
    shift_sigma: Float[Tensor, " 3"],
) -> SignMatches:
    """The cluster of each sign: of one journey each cluster takes one sign, at the least total cost.

    `seen_together` lists pairs of signs of one journey that were seen in one same frame: never the same sign. A sign that
    is left over may be another fragment of one that was matched: it joins where it overlaps closely and no frame forbids.
    """
    n, count = len(signs), len(heads)
    pair = cross_pairs(
        signs.center_world,
        heads.center_world,
        radius=config.max_distance_m,
        count=config.candidates,
    )
    row, head = pair.T
    cost = _distance(signs, heads, pair, config, shift_sigma)
    slot = signs.journey[row] * count + head
    chosen = match_slots(row, slot, cost, rows=n, unmatched_cost=config.unmatched_cost)
    label = torch.where(chosen < 0, chosen, chosen % max(count, 1))

    # Fragments: the nearest head of those left over, unless a frame shows that they are two.
    best_cost, target = _nearest(row, head, cost, n)
    target = target.masked_fill(best_cost > config.fragment_cost, -1)
    label = _joined(label, target, best_cost, seen_together)

    own = head == label[row]
    own_cost, _ = _nearest(row[own], head[own], cost[own], n)
    other_cost, _ = _nearest(row[~own], head[~own], cost[~own], n)
    preference = torch.tanh((other_cost - own_cost) / 4).clamp_min(0)
    return SignMatches(label=label, certainty=torch.where(label < 0, 0.0, preference))


def merge_heads(
    signs: Signs,
    label: Int[Tensor, " n"],
    heads: Signs,
    seen_together: Int[Tensor, "p 2"],
    config: SignMatchConfig,
    *,
    shift_sigma: Float[Tensor, " 3"],
) -> Int[Tensor, " n"]:
    """Labels with clusters joined that are one sign: close, alike, and not told apart by the journeys.

    A few journeys may tell apart what is one, by signs that are in the wrong cluster; matching sorts those out. Where
    two clusters lie so close that their plates would overlap, they are one whoever saw both: a sign detected twice. Each
    cluster is joined with at most one other.
    """
    pair = near_pairs(heads.center_world, radius=config.max_distance_m, count=config.candidates)
    if not len(pair):
        return label
    a, b = pair.T
    cost = _distance(heads, heads, pair, config, shift_sigma)
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
    cost = cost.masked_fill(~merge, torch.inf)
    rows = torch.cat((a, b))
    best, partner = _nearest(rows, torch.cat((b, a)), torch.cat((cost, cost)), len(heads))
    own = torch.arange(len(heads), device=label.device)
    mutual = best.isfinite() & (partner[partner.clamp_min(0)] == own)
    target = torch.where(mutual, torch.minimum(partner, own), own)
    return torch.where(label < 0, label, target[label.clamp_min(0)])


def harvest_signs(
    signs: Signs,
    label: Int[Tensor, " n"],
    heads: Signs,
    seen_together: Int[Tensor, "p 2"],
    config: SignMatchConfig,
) -> Int[Tensor, " n"]:
    """Labels with what was left over brought back where it can only be a sign that is there already, badly triangulated.

    Two signs that look alike do not stand so close without anybody seeing both: a weak cluster beside a strong one is
    dissolved, and signs in no cluster join the nearest one, unless they were seen in one frame with a member.
    """
    sigma = signs.size.new_full((3,), config.harvest_sigma_m)
    near = near_pairs(heads.center_world, radius=config.max_distance_m, count=config.candidates)
    pair = torch.cat((near, near.flip(1)))  # the second would dissolve the first
    weaker = heads.n_journeys[pair[:, 0]] < config.weak * heads.n_journeys[pair[:, 1]]
    pair = pair[weaker]
    cost = _distance(heads, heads, pair, config, sigma)
    witnesses = _witnesses(signs, label, seen_together, pair, len(heads))
    told_apart = witnesses > config.told_apart * heads.n_journeys[pair[:, 0]]
    dissolved = pair[(cost < config.fragment_cost) & ~told_apart, 0]
    label = label.masked_fill(torch.isin(label, dissolved), -1)

    rest = torch.nonzero(label < 0)[:, 0]
    standing = torch.nonzero(~torch.isin(torch.arange(len(heads)).to(label), dissolved))[:, 0]
    found = cross_pairs(
        signs.center_world[rest],
        heads.center_world[standing],
        radius=config.max_distance_m,
        count=config.candidates,
    )
    found = torch.stack((rest[found[:, 0]], standing[found[:, 1]]), dim=1)
    cost = _distance(signs, heads, found, config, sigma)
    best_cost, target = _nearest(found[:, 0], found[:, 1], cost, len(signs))
    target = target.masked_fill(best_cost > config.fragment_cost, -1)
    return _joined(label, target, best_cost, seen_together)


def split_by_conflicts(
    journey: Int[Tensor, " n"], label: Int[Tensor, " n"], seen_together: Int[Tensor, "p 2"]
) -> Int[Tensor, " n"]:
    """Labels in which a cluster that holds signs seen in one frame falls apart into the signs that one journey saw.

    That journey is the one with most such signs in the cluster. Its signs become clusters of their own; the other members
    are labelled -1, to be matched against those.
    """
    i, j = seen_together.T
    inside = (label[i] >= 0) & (label[i] == label[j])
    rows = torch.unique(seen_together[inside])
    if not len(rows):
        return label
    journeys = int(journey.max()) + 1
    key, inverse, seen = torch.unique(
        label[rows] * journeys + journey[rows], return_inverse=True, return_counts=True
    )
    order = (-seen).argsort(stable=True)
    order = order[(key[order] // journeys).argsort(stable=True)]
    owner = key[order] // journeys
    first = torch.ones_like(owner, dtype=torch.bool)
    first[1:] = owner[1:] != owner[:-1]
    is_reference = torch.zeros_like(key, dtype=torch.bool)
    is_reference[order[first]] = True
    seeds = rows[is_reference[inverse]]
    result = label.masked_fill(torch.isin(label, owner), -1)
    result[seeds] = int(label.max()) + 1 + torch.arange(len(seeds), device=label.device)
    return renumber(result)


def without_small(
    journey: Int[Tensor, " n"],
    label: Int[Tensor, " n"],
    *,
    min_journeys: int,
    counts: Bool[Tensor, " n"] | None = None,
) -> Int[Tensor, " n"]:
    """Labels renumbered, with clusters of fewer than `min_journeys` journeys turned to -1.

    Rows where `counts` is false do not count, though they stay in clusters that are large enough.
    """
    counted = label >= 0 if counts is None else (label >= 0) & counts
    owner, _, _ = distinct_pairs(label[counted], journey[counted])
    journeys = group_count(owner, int(label.max()) + 1 if len(label) else 0)
    if not len(journeys):
        return label
    small = journeys[label.clamp_min(0)] < min_journeys
    return renumber(label.masked_fill(small, -1))


def _joined(
    label: Int[Tensor, " n"],
    target: Int[Tensor, " n"],
    cost: Float[Tensor, " n"],
    seen_together: Int[Tensor, "p 2"],
) -> Int[Tensor, " n"]:
    """Labels in which unlabelled rows join their target, unless seen in one frame with a member or a cheaper joiner."""
    target = target.masked_fill(label >= 0, -1)
    first, second = torch.cat((seen_together, seen_together.flip(1))).T
    wanted = target[first]
    rival = (target[second] == wanted) & (
        (cost[second] < cost[first]) | ((cost[second] == cost[first]) & (second < first))
    )
    forbidden = (wanted >= 0) & ((label[second] == wanted) | rival)
    target = target.index_fill(0, first[forbidden], -1)
    return torch.where(label < 0, target, label)


def _distance(
    a: Signs,
    b: Signs,
    pair: Int[Tensor, "p 2"],
    config: SignMatchConfig,
    sigma: Float[Tensor, " 3"],
) -> Float[Tensor, " p"]:
    first, second = a[pair[:, 0]], b[pair[:, 1]]
    place = place_distance(
        first.center_world, first.covariance, second.center_world, second.covariance, sigma
    )
    return place + appearance_distance(first, second, config.similarity)


def _nearest(
    row: Int[Tensor, " p"], other: Int[Tensor, " p"], cost: Float[Tensor, " p"], rows: int
) -> tuple[Float[Tensor, " n"], Int[Tensor, " n"]]:
    """The least cost of each row and the partner it comes with, the smaller of equals; infinity and -1 without one."""
    best = cost.new_full((rows,), torch.inf).scatter_reduce(0, row, cost, "amin")
    is_best = (cost == best[row]) & cost.isfinite()
    far = torch.iinfo(torch.int64).max
    partner = torch.full((rows,), far, dtype=torch.int64, device=row.device)
    partner = partner.scatter_reduce(0, row[is_best], other[is_best], "amin")
    return best, partner.masked_fill(partner == far, -1)


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
    index = torch.repeat_interleave(torch.arange(len(pair), device=pair.device), size[a])
    rank = torch.arange(len(index), device=pair.device)
    rank = rank - torch.repeat_interleave(size[a].cumsum(0) - size[a], size[a])
    present = torch.isin(b[index] * journeys + journey[start[a][index] + rank], key)
    both = torch.zeros(len(pair), dtype=torch.int64, device=pair.device)
    both = both.index_add(0, index, present.long())
    union = (size[a] + size[b] - both).clamp_min(1)
    return size[a] * size[b] / union, torch.minimum(size[a], size[b])
