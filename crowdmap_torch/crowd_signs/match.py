"""V-A.1, unlike the paper: each journey's signs against the cluster heads one to one, with hard rules."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.assignment import match_slots
from crowdmap_torch.clustering.groups import cheapest, distinct_pairs, group_argmin, group_count
from crowdmap_torch.clustering.neighbours import cross_pairs
from crowdmap_torch.clustering.spectral import renumber
from crowdmap_torch.crowd_signs.distance import SimilarityConfig, sign_distance
from crowdmap_torch.ranges import Cost, Count, Length, Settings, Sigma
from crowdmap_torch.tables import Signs


@dataclass(frozen=True)
class HeadMatchConfig(Settings):
    """When a triangulated sign belongs to a cluster; costs are squared standard deviations."""

    unmatched_cost: Cost = 25.0
    """Cost of leaving a sign without a cluster: no pair dearer than this is matched."""
    fragment_cost: Cost = 16.0
    """A sign left over joins a cluster up to this cost, if never seen in one frame with another member."""
    leftover_sigma_m: Sigma = 0.5
    """Uncertainty of the shift of signs left over when they are offered to the finished clusters [m]."""
    max_distance_m: Length = 3.0
    """No sign is further from its cluster's head, however uncertain it is."""
    candidates: Count = 8
    """Heads that a sign is compared with, the nearest."""
    similarity: SimilarityConfig = field(default_factory=SimilarityConfig)
    """What differences of appearance cost."""


@dataclass(frozen=True)
class HeadMatches:
    """The cluster of each sign."""

    label: Int[Tensor, " n"]
    """Row of the heads; -1 for none."""
    certainty: Float[Tensor, " n"]
    """0 to 1: how far the sign prefers its cluster to any other, taken or not; 0 for none."""


def match_heads(
    signs: Signs,
    heads: Signs,
    seen_together: Int[Tensor, "p 2"],
    config: HeadMatchConfig,
    *,
    shift_sigma: Float[Tensor, " 3"],
) -> HeadMatches:
    """The cluster of each sign: of one journey each cluster takes one sign, at the least total cost.

    `seen_together` lists pairs of signs of one journey that were seen in one same frame: never the same sign. A sign
    that is left over may be another fragment of one that was matched: it joins where it is close and no frame forbids.
    """
    n, count = len(signs), len(heads)
    pair = cross_pairs(
        signs.center_world,
        heads.center_world,
        radius=config.max_distance_m,
        count=config.candidates,
    )
    row, head = pair.T
    cost = sign_distance(signs, heads, pair, config.similarity, shift_sigma)
    slot = signs.journey[row] * count + head
    chosen = match_slots(row, slot, cost, rows=n, unmatched_cost=config.unmatched_cost)
    label = torch.where(chosen < 0, chosen, chosen % max(count, 1))

    # Fragments: the nearest head of those left over, unless a frame shows that they are two.
    best_cost, target = cheapest(row, head, cost, n)
    target = target.masked_fill(best_cost > config.fragment_cost, -1)
    label = _joined(label, target, best_cost, seen_together)

    own = head == label[row]
    own_cost, _ = cheapest(row[own], head[own], cost[own], n)
    other_cost, _ = cheapest(row[~own], head[~own], cost[~own], n)
    preference = torch.tanh((other_cost - own_cost) / 4).clamp_min(0)
    return HeadMatches(label=label, certainty=torch.where(label < 0, 0.0, preference))


def join_leftovers(
    signs: Signs,
    label: Int[Tensor, " n"],
    heads: Signs,
    seen_together: Int[Tensor, "p 2"],
    config: HeadMatchConfig,
) -> Int[Tensor, " n"]:
    """Labels with signs in no cluster brought back where they can only be a sign that is there already, badly placed.

    Two signs that look alike do not stand so close without anybody seeing both: what is left over joins the nearest
    cluster, unless it was seen in one frame with a member.
    """
    rest = torch.nonzero(label < 0)[:, 0]
    pair = cross_pairs(
        signs.center_world[rest],
        heads.center_world,
        radius=config.max_distance_m,
        count=config.candidates,
    )
    pair = torch.stack((rest[pair[:, 0]], pair[:, 1]), dim=1)
    sigma = signs.size.new_full((3,), config.leftover_sigma_m)
    cost = sign_distance(signs, heads, pair, config.similarity, sigma)
    best_cost, target = cheapest(pair[:, 0], pair[:, 1], cost, len(signs))
    target = target.masked_fill(best_cost > config.fragment_cost, -1)
    return _joined(label, target, best_cost, seen_together)


def split_by_conflicts(
    journey: Int[Tensor, " n"], label: Int[Tensor, " n"], seen_together: Int[Tensor, "p 2"]
) -> Int[Tensor, " n"]:
    """Labels in which a cluster that holds signs seen in one frame falls apart into the signs that one journey saw.

    That journey is the one with most such signs in the cluster. Its signs become clusters of their own; the other
    members are labelled -1, to be matched against those.
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
    owner, group = torch.unique(key // journeys, return_inverse=True)
    is_reference = torch.zeros_like(key, dtype=torch.bool)
    is_reference[group_argmin(-seen.double(), group)] = True
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
