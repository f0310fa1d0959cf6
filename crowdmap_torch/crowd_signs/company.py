"""V-B, unlike the paper: which signs of single drives are one, by adjusted poses.

What one drive passes others may see from afar alone, from a side street or before they turn off: where it stands along
their sight they leave open by metres, and no cluster takes it. Once poses are adjusted all drives agree to tenths of a metre
across their sight, and signs of which the bias of one drive was not known when clusters were made stand in one place.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.assignment import match_slots
from crowdmap_torch.clustering.groups import cheapest, group_count
from crowdmap_torch.clustering.neighbours import cross_pairs, near_pairs
from crowdmap_torch.clustering.spectral import singles_behind
from crowdmap_torch.crowd_signs.distance import SimilarityConfig, sign_distance
from crowdmap_torch.crowd_signs.gather import with_covariance
from crowdmap_torch.geometry import se3
from crowdmap_torch.ranges import Cost, Count, Degrees, Length, Settings, Sigma
from crowdmap_torch.tables import Journey, Signs


@dataclass(frozen=True)
class CompanyConfig(Settings):
    """When signs of single drives are one in an adjusted map; costs are squared standard deviations."""

    most_cost: Cost = 16.0
    """Signs of one shape are one at no more than this, in place and looks, ..."""
    reach_m: Length = 15.0
    """... no further apart than this, ..."""
    candidates: Count = 48
    """... of the nearest so many, and nearer in that than any sign of the map."""
    shift_sigma_m: Sigma = 0.3
    """1-sigma of where each drive's adjusted poses are beside what its signs' covariances tell [m]."""
    turn_sigma_deg: Degrees = 0.15
    """1-sigma of how they are turned: signs that are seen from afar lie aside by so much of their distance [deg]."""
    similarity: SimilarityConfig = field(default_factory=SimilarityConfig)
    """What differences of appearance cost."""


@dataclass(frozen=True)
class Placed:
    """Where signs of single drives are by adjusted poses."""

    T_world_sign: Float[Tensor, "n 4 4"]
    view_position: Float[Tensor, "n 3"]
    """The camera where each sign was closest."""


def frame_number(journeys: Sequence[Journey], own: Signs) -> Int[Tensor, " n"]:
    """The frame where each sign was closest to its journey's camera, counted over all journeys."""
    frames = own.frame.new_tensor([journey.frame_count for journey in journeys])
    return (frames.cumsum(0) - frames)[own.journey] + own.frame


def placed_by(
    own: Signs, journeys: Sequence[Journey], poses: Sequence[Float[Tensor, "_ 4 4"]]
) -> Placed:
    """Where the journeys' `own` signs, measured from given poses, are by other `poses` of the same frames."""
    T, view = own.T_world_sign.clone(), own.center_world.clone()
    for number, (journey, pose) in enumerate(zip(journeys, poses, strict=True)):
        mine = torch.nonzero(own.journey == number)[:, 0]
        now, given = (every[own.frame[mine]] for every in (pose, journey.T_world_camera))
        T[mine] = now @ se3.inverse(given) @ T[mine]
        view[mine] = now[:, :3, 3]
    return Placed(T, view)


def passing_of(
    signs: Signs, members: Signs, label: Int[Tensor, " m"], n_passing: Int[Tensor, " c"]
) -> Int[Tensor, " n"]:
    """How many journeys passed where each of `signs`, which are among the `members` of a crowd, was seen.

    `n_passing` has them by cluster, and behind the clusters by each member without one.
    """
    span = int(torch.cat((members.tracklet, signs.tracklet)).max()) + 1 if len(signs) else 1
    key, order = (members.journey * span + members.tracklet).sort()
    return n_passing[
        singles_behind(label)[order[torch.searchsorted(key, signs.journey * span + signs.tracklet)]]
    ]


def in_company(
    alone: Signs,
    view_position: Float[Tensor, "n 3"],
    heads: Signs,
    min_journeys: int,
    config: CompanyConfig,
) -> Int[Tensor, " n"]:
    """Of each sign that a drive has alone the one that it is, itself among them, where `min_journeys` see that; else -1.

    Places are by adjusted poses, seen nearest from `view_position`. What others are taken for is better placed than they and
    has some confidence. Of each drive one sign at most is another one, at the least total cost; what is nearer to one of the
    `heads` is none of them.
    """
    n, is_certain = len(alone), alone.confidence > 0
    placed = _as_seen(alone, view_position, config)
    pair = near_pairs(placed.center_world, radius=config.reach_m, count=config.candidates)
    sigma = torch.linalg.eigvalsh(placed.covariance)[:, -1]
    # The better placed one comes first; of equals the one before.
    better = torch.where((sigma[pair[:, 1]] < sigma[pair[:, 0]])[:, None], pair.flip(1), pair)
    seed, row = better.T
    possible = is_certain[seed] & (alone.journey[seed] != alone.journey[row])
    seed, row = better[possible & (alone.shape[seed] == alone.shape[row])].T
    no_shift = placed.size.new_zeros(3)
    cost = sign_distance(placed, placed, torch.stack((row, seed), 1), config.similarity, no_shift)
    of_head = _least_cost_of_heads(placed, heads, config)
    fits = (cost < config.most_cost) & (cost < of_head[row])
    seed, row, cost = seed[fits], row[fits], cost[fits]
    target = torch.full_like(alone.journey, -1)
    for _ in range(2):
        # What is another one itself is taken for none by others, the second time.
        free = target[seed] < 0
        slot = alone.journey[row[free]] * n + seed[free]
        chosen = match_slots(row[free], slot, cost[free], rows=n, unmatched_cost=config.most_cost)
        target = torch.where(chosen < 0, chosen, chosen % max(n, 1))
    taken = (target >= 0) & (target[target.clamp_min(0)] >= 0)
    target = target.masked_fill(taken, -1)
    seen_by = 1 + group_count(target, n)
    is_seed = (target < 0) & is_certain & (seen_by >= min_journeys)
    own = torch.arange(n, device=target.device).masked_fill(~is_seed, -1)
    return torch.where(target >= 0, own[target.clamp_min(0)], own)


def _as_seen(signs: Signs, view_position: Float[Tensor, "n 3"], config: CompanyConfig) -> Signs:
    """The signs with covariances that know how far adjusted poses are off and turned."""
    sight = signs.center_world - view_position
    away = sight.norm(dim=1, keepdim=True)
    ray = sight / away.clamp_min(1e-6)
    eye = torch.eye(3).to(sight)
    across = eye - ray[:, :, None] * ray[:, None]
    turned = (math.radians(config.turn_sigma_deg) * away).square()[:, :, None] * across
    return with_covariance(signs, config.shift_sigma_m**2 * eye + turned)


def _least_cost_of_heads(placed: Signs, heads: Signs, config: CompanyConfig) -> Float[Tensor, " n"]:
    near = {"radius": config.reach_m, "count": config.candidates}
    pair = cross_pairs(placed.center_world, heads.center_world, **near)
    shift = placed.size.new_full((3,), config.shift_sigma_m)
    cost = sign_distance(placed, heads, pair, config.similarity, shift)
    return cheapest(pair[:, 0], pair[:, 1], cost, len(placed))[0]
