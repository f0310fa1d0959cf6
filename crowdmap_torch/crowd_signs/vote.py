"""V-B, unlike the paper: first biases, found by a vote over pairs of signs; they may be as large as signs are apart."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.linalg import cg
from torch import Tensor

from crowdmap_torch.clustering.groups import rows_of_ranges
from crowdmap_torch.clustering.voting import densest
from crowdmap_torch.crowd_signs.distance import SimilarityConfig, appearance_distance
from crowdmap_torch.ranges import Count, Length, Settings, Spacing
from crowdmap_torch.tables import Signs

_SWEEPS = 24
"""Reweightings: in the first half every shift keeps a say, in the second half wrong ones lose it."""
_LOOKUPS = 1 << 21
"""Neighbour cells looked up at once."""


@dataclass(frozen=True)
class VoteConfig(Settings):
    """How the shifts between journeys are first found."""

    radius_m: Length = 6.0
    """Largest shift between two journeys, east or north [m]."""
    height_m: Length = 8.0
    """Largest shift upwards [m]."""
    width_m: Length = 0.4
    """Kernel of the vote: what slow drift and triangulation leave between two journeys [m]."""
    partners: Count = 10
    """Journeys that each journey is compared with, chosen at random among those that share its roads."""
    cell_m: Spacing = 50.0
    """Journeys share a road where both saw a sign within a cell of this size [m]."""
    votes: Count = 200
    """Most pairs of signs compared between two journeys, chosen at random."""
    outlier_m: Length = 1.2
    """Shifts between two journeys that miss by more than this are taken for wrong votes [m]."""
    similarity: SimilarityConfig = field(default_factory=SimilarityConfig)
    """What differences of appearance cost a vote."""


def vote_biases(
    signs: Signs,
    config: VoteConfig,
    *,
    journeys: int,
    bias_sigma: Float[Tensor, "j 3"],
    generator: torch.Generator | None = None,
    follows: Int[Tensor, " f"] | None = None,
    steps: Float[Tensor, " f"] | None = None,
) -> Float[Tensor, "j 3"]:
    """First translation biases [m] of `journeys` journeys from the pattern of the signs around.

    Every pair of similar signs of two journeys votes for the shift between the two; signs one post apart vote for wrong
    shifts, but only the right one is the same at every post. The biases are the robust solution of all shifts; their
    mean, weighted by the priors, is zero where journeys are connected. Journeys that `follows` names are not far off the
    next one's bias, by `steps` [m], 1-sigma.
    """
    pair = _partners(signs, config, journeys, generator)
    edge, i, k = _candidates(signs, pair, config, journeys, generator)
    offset = signs.center_world[i] - signs.center_world[k]
    cost = appearance_distance(signs[i], signs[k], config.similarity)
    keep = cost < 20
    edge, offset, cost = edge[keep], offset[keep], cost[keep]
    pair_sigma = (bias_sigma[pair[:, 0]].square() + bias_sigma[pair[:, 1]].square()).sqrt()
    prior = -0.5 * (offset / pair_sigma[edge]).square().sum(1)
    found = densest(
        offset, torch.exp(-0.5 * cost), prior, edge, groups=len(pair), width=config.width_m
    )
    clear = (1 - found.runner_up / found.support.clamp_min(1e-12)).clamp(0.05, 1)
    weight = clear * found.support / (1 + found.support)
    weight = torch.where(found.support > 0.3, weight, 0.0)
    if follows is None or steps is None:
        follows, steps = pair.new_zeros(0), bias_sigma.new_zeros(0)
    held = (config.width_m / steps).square()
    pair = torch.cat((pair, torch.stack((follows, follows + 1), dim=1)))
    shift = torch.cat((found.vector, held.new_zeros(len(held), 3)))
    votes = torch.arange(len(pair), device=pair.device) < len(weight)
    return _synchronise(pair, shift, torch.cat((weight, held)), votes, bias_sigma, config)


def _partners(
    signs: Signs, config: VoteConfig, journeys: int, generator: torch.Generator | None
) -> Int[Tensor, "e 2"]:
    """Pairs of journeys to compare: for each, some of those with signs in the same cells."""
    cell = (signs.center_world[:, :2] / config.cell_m).floor().long()
    _, cell = torch.unique(cell, dim=0, return_inverse=True)
    journey = signs.journey.cpu().numpy()
    present = sparse.csr_matrix(
        (np.ones(len(journey)), (journey, cell.cpu().numpy())),
        shape=(journeys, int(cell.max()) + 1 if len(cell) else 1),
    )
    present.data[:] = 1
    present.sum_duplicates()
    present.data[:] = 1
    overlap = sparse.coo_matrix(present @ present.T)
    i, j = (torch.from_numpy(t.astype(np.int64)) for t in (overlap.row, overlap.col))
    shared = torch.from_numpy(overlap.data)
    upper = i < j
    i, j, shared = i[upper], j[upper], shared[upper]
    # One draw for a pair of journeys, whichever of the two is asked.
    chance = torch.rand(len(i), generator=generator, dtype=torch.float64)
    score = torch.cat((shared * (0.25 + chance),) * 2)
    asking, pair = torch.cat((i, j)), torch.arange(len(i)).repeat(2)
    order = (-score).argsort(stable=True)
    order = order[asking[order].argsort(stable=True)]
    size = torch.bincount(asking, minlength=journeys)
    rank = torch.arange(len(order)) - torch.repeat_interleave(size.cumsum(0) - size, size)
    chosen = torch.unique(pair[order[rank < config.partners]])
    return torch.stack((i[chosen], j[chosen]), dim=1).to(signs.journey.device)


def _candidates(
    signs: Signs,
    pair: Int[Tensor, "e 2"],
    config: VoteConfig,
    journeys: int,
    generator: torch.Generator | None,
) -> tuple[Int[Tensor, " v"], Int[Tensor, " v"], Int[Tensor, " v"]]:
    """Pair of journeys, sign of the first, sign of the second, for signs within reach of each other."""
    place = signs.center_world
    cell = (place[:, :2] / config.radius_m).floor().long()
    cell = cell - cell.amin(0) + 1 if len(cell) else cell
    span = cell.amax(0) + 2 if len(cell) else cell.new_ones(2)
    cells = int(span.prod())
    key = signs.journey * cells + cell[:, 0] * span[1] + cell[:, 1]
    order = key.argsort(stable=True)
    ranked = key[order]
    by_journey = signs.journey.argsort(stable=True)
    size = torch.bincount(signs.journey, minlength=journeys)
    start = size.cumsum(0) - size
    around = torch.cartesian_prod(torch.arange(-1, 2), torch.arange(-1, 2)).to(cell)
    around = around[:, 0] * span[1] + around[:, 1]
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    load = (9 * size[pair[:, 0]]).cumsum(0)
    for edge in torch.arange(len(pair), device=pair.device).split_with_sizes(_chunks(load)):
        first, second = pair[edge].T
        at, i = rows_of_ranges(start[first], size[first])
        e, other, i = edge[at], second[at], by_journey[i]
        wanted = (key[i] + (other - signs.journey[i]) * cells)[:, None] + around
        low = torch.searchsorted(ranked, wanted.reshape(-1))
        high = torch.searchsorted(ranked, wanted.reshape(-1), right=True)
        at, k = rows_of_ranges(low, high - low)
        e, i, k = e[at // 9], i[at // 9], order[k]
        offset = (place[i] - place[k]).abs()
        near = (offset[:, :2].norm(dim=1) < config.radius_m) & (offset[:, 2] < config.height_m)
        found.append((e[near], i[near], k[near]))
    if not found:
        none = torch.zeros(0, dtype=torch.int64, device=place.device)
        return none, none, none
    e, i, k = (torch.cat(column) for column in zip(*found, strict=True))
    return _thinned(e, i, k, len(pair), config.votes, generator)


def _thinned(
    e: Tensor, i: Tensor, k: Tensor, edges: int, limit: int, generator: torch.Generator | None
) -> tuple[Tensor, Tensor, Tensor]:
    """At most about `limit` rows of each edge, chosen at random."""
    share = limit / torch.bincount(e, minlength=edges).clamp_min(1)
    draw = torch.rand(len(e), generator=generator, dtype=torch.float64).to(e.device)
    kept = draw < share[e]
    return e[kept], i[kept], k[kept]


def _chunks(load: Int[Tensor, " e"]) -> list[int]:
    """Sizes of runs of edges with about `_LOOKUPS` lookups each."""
    _, sizes = torch.unique_consecutive(load // _LOOKUPS, return_counts=True)
    return sizes.tolist()


def _synchronise(
    pair: Int[Tensor, "e 2"],
    shift: Float[Tensor, "e 3"],
    weight: Float[Tensor, " e"],
    votes: Bool[Tensor, " e"],
    bias_sigma: Float[Tensor, "j 3"],
    config: VoteConfig,
) -> Float[Tensor, "j 3"]:
    """Biases whose differences are the shifts: least absolute deviations first, then wrong `votes` have no say."""
    J = len(bias_sigma)
    i, j = pair.cpu().numpy().T
    measured, trust = shift.detach().cpu().numpy(), weight.detach().cpu().numpy()
    is_vote = votes.cpu().numpy()
    ridge = bias_sigma.detach().cpu().numpy() ** -2.0
    bias = np.zeros((J, 3))
    robust = np.ones(len(i))
    for sweep in range(_SWEEPS):
        w = trust * robust / config.width_m**2
        pull = w[:, None] * measured
        right = np.zeros((J, 3))
        np.add.at(right, i, pull)
        np.add.at(right, j, -pull)
        degree = np.bincount(i, w, J) + np.bincount(j, w, J)
        for axis in range(3):
            rows = np.concatenate((np.arange(J), i, j))
            columns = np.concatenate((np.arange(J), j, i))
            values = np.concatenate((degree + ridge[:, axis], -w, -w))
            system = sparse.csr_matrix((values, (rows, columns)), shape=(J, J))
            inverse_diagonal = sparse.diags(1 / system.diagonal())
            bias[:, axis], _ = cg(
                system, right[:, axis], x0=bias[:, axis], rtol=1e-6, M=inverse_diagonal
            )
        miss = np.linalg.norm(bias[i] - bias[j] - measured, axis=1)
        if sweep < _SWEEPS // 2:
            robust = config.width_m / np.maximum(miss, config.width_m)
        else:
            robust = np.clip(1 - (miss / config.outlier_m) ** 2, 0, None) ** 2
        robust[~is_vote] = 1
    return torch.from_numpy(bias).to(bias_sigma)
