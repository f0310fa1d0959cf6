"""Courses traced along the ridges of all journeys' lane samples: found, strung together, cut where they end."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering import chain, ridge
from crowdmap_torch.clustering.chain import BridgeConfig, Chains, LinkConfig
from crowdmap_torch.clustering.groups import group_sum
from crowdmap_torch.clustering.lines import LineSamples, RidgePoints, owners_around
from crowdmap_torch.clustering.ridge import RidgeConfig
from crowdmap_torch.clustering.thinning import thin
from crowdmap_torch.courses.curves import stations
from crowdmap_torch.tables import LANE_TYPES


@dataclass(frozen=True)
class TraceConfig:
    """What makes a course."""

    min_journeys: int = 2
    """A place of a marker must be seen by as many, or by all there are; 1 admits single-journey markers."""
    min_share: float = 0.1
    """Of the journeys that saw any marker nearby, at least this share must support a place."""
    short_m: float = 40.0
    """Shorter courses must be supported by more, as strayed pieces may happen to agree over a short way: ..."""
    short_share: float = 0.8
    """... by this share of the journeys nearby at no length, falling to `min_share`."""
    nearby_m: float = 8.0
    """How near is nearby."""
    max_gap_m: float = 40.0
    """A stretch with too little support is bridged up to this length, if some journey saw the marker there."""
    max_blind_gap_m: float = 10.0
    """A stretch that nobody saw is bridged up to this length if its ends fit."""
    min_length_m: float = 8.0
    """Shorter courses are dropped."""
    type_window_m: float = 15.0
    """Votes on the type are counted this far ahead and behind."""
    type_majority: float = 0.65
    """A type changes where another one has this share of the votes."""
    type_run_m: float = 20.0
    """A type lasts at least this long."""
    link: LinkConfig = field(default_factory=LinkConfig)
    """Who may follow whom."""


@dataclass(frozen=True)
class Traced:
    """Ridge points strung together."""

    node: RidgePoints
    chains: Chains


def trace(samples: LineSamples, ridge_config: RidgeConfig, config: TraceConfig) -> Traced:
    """Courses as chains of ridge points; both ends of each have enough support."""
    owners = len(torch.unique(samples.owner))
    rough, fine = ridge_config.iterations
    points = ridge.seeds(samples, ridge_config, len(LANE_TYPES))
    points = ridge.shift_to_ridges(points, samples, ridge_config, iterations=rough)
    points = _thinned(points, ridge_config, along=0.7)
    points = ridge.shift_to_ridges(points, samples, ridge_config, iterations=fine)
    points = _thinned(points, ridge_config, along=1.0)
    around = owners_around(points.point, samples, config.nearby_m)
    enough = (config.min_share * around).clamp_min(min(config.min_journeys, owners))
    is_strong = points.owners >= enough
    chains = chain.link(points.point, points.direction, is_strong, config.link)
    chains = without_weak(chains, points.point, is_strong, config.max_gap_m)
    return Traced(points, without_short(chains, points.point, config.min_length_m / 2))


def _thinned(points: RidgePoints, config: RidgeConfig, *, along: float) -> RidgePoints:
    points = points[points.density > 0.2]
    kept = thin(
        points,
        along=along,
        sideways=1.3 * config.bandwidth,
        beside_stronger=max(0.9, 2 * config.bandwidth),
        height_gate=config.height_gate,
    )
    return points[kept]


def without_weak(
    chains: Chains, point: Float[Tensor, "n 3"], is_strong: Bool[Tensor, " n"], max_gap: float
) -> Chains:
    """Chains without weakly supported stretches, but for those up to `max_gap` [m] between well supported ones."""
    s, _ = stations(point[chains.node], chains.chain, chains.count)
    strong = is_strong[chains.node]
    row = torch.arange(len(s), device=s.device)
    before = torch.where(strong, row, -1).cummax(0).values
    after = torch.where(strong, row, len(s)).flip(0).cummin(0).values.flip(0)
    inside = (before >= 0) & (after < len(s))
    before, after = before.clamp_min(0), after.clamp_max(max(len(s) - 1, 0))
    inside &= (chains.chain[before] == chains.chain) & (chains.chain[after] == chains.chain)
    keep = strong | (inside & (s[after] - s[before] <= max_gap))
    return chain.keep_rows(chains, keep)


def without_short(chains: Chains, point: Float[Tensor, "n 3"], min_length: float) -> Chains:
    """Chains of at least `min_length` [m]."""
    _, length = stations(point[chains.node], chains.chain, chains.count)
    return chain.select(chains, length >= min_length)


def bridged(
    chains: Chains,
    point: Float[Tensor, "n 3"],
    direction: Float[Tensor, "n 2"],
    samples: LineSamples,
    config: TraceConfig,
) -> Chains:
    """Chains joined across gaps that some journey saw the marker in, or that are short and straight on."""
    bridge_config = BridgeConfig(
        max_gap=config.max_blind_gap_m, max_gap_seen=max(config.max_gap_m, config.max_blind_gap_m)
    )
    return chain.bridge(chains, point, direction, samples.point, bridge_config)


def cut_by_type(
    chains: Chains,
    point: Float[Tensor, "n 3"],
    votes: Float[Tensor, "n kinds"],
    config: TraceConfig,
) -> tuple[Chains, Int[Tensor, " count"], Int[Tensor, "j 2"]]:
    """Chains cut where the type changes by a clear vote, their types (-1 unknown), and which chain goes on in which.

    The chains on both sides of a cut share the point there.
    """
    s, _ = stations(point[chains.node], chains.chain, chains.count)
    kind = _smooth_kinds(s, chains.chain, chains.count, votes[chains.node], config)
    breaks = torch.zeros_like(kind, dtype=torch.bool)
    breaks[1:] = (kind[1:] != kind[:-1]) & (chains.chain[1:] == chains.chain[:-1])
    label = chains.chain + breaks.long().cumsum(0)
    kind_of = torch.full((chains.count + int(breaks.sum()),), -1).to(kind)
    kind_of[label] = kind
    after = label[breaks]
    # The row of a cut stands twice: last of the chain before, first of its own.
    twice = torch.repeat_interleave(1 + breaks.long())
    is_copy = torch.zeros_like(twice, dtype=torch.bool)
    is_copy[:-1] = twice[1:] == twice[:-1]
    result = Chains(chains.node[twice], label[twice] - is_copy.long(), len(kind_of))
    return result, kind_of, torch.stack((after - 1, after), dim=1)


def _smooth_kinds(
    s: Float[Tensor, " k"],
    chain_of: Int[Tensor, " k"],
    count: int,
    votes: Float[Tensor, "k kinds"],
    config: TraceConfig,
) -> Int[Tensor, " k"]:
    """Type at each place: the majority about it where clear and lasting, elsewhere that of the nearest such place."""
    whole = group_sum(votes, chain_of, count)
    overall = torch.where(whole.sum(1) > 0, whole.argmax(1), -1)
    # One axis for all chains, with gaps wider than the window between them.
    far = float(s.max()) + 4 * config.type_window_m if len(s) else 0.0
    x = s + chain_of * far
    total = torch.cat((votes.new_zeros(1, votes.shape[1]), votes.cumsum(0)))
    low = torch.searchsorted(x, x - config.type_window_m)
    high = torch.searchsorted(x, x + config.type_window_m, right=True)
    around = total[high] - total[low]
    share = around.max(1).values / around.sum(1).clamp_min(1e-12)
    kind = torch.where(share >= config.type_majority, around.argmax(1), -1)
    # Runs of one type that are too short say nothing.
    change = torch.ones_like(kind, dtype=torch.bool)
    change[1:] = (kind[1:] != kind[:-1]) | (chain_of[1:] != chain_of[:-1])
    run = change.long().cumsum(0) - 1
    runs = int(run[-1]) + 1 if len(run) else 0
    first = torch.full((runs,), torch.inf).to(s).scatter_reduce(0, run, s, "amin")
    last = torch.full((runs,), -torch.inf).to(s).scatter_reduce(0, run, s, "amax")
    kind = torch.where((last - first)[run] < config.type_run_m, -1, kind)
    # Filled from the nearer of what is known before and behind, with the chain's own majority where nothing is.
    row = torch.arange(len(kind), device=kind.device)
    known = kind >= 0
    before = torch.where(known, row, -1).cummax(0).values.clamp_min(0)
    behind = torch.where(known, row, len(row)).flip(0).cummin(0).values.flip(0)
    behind = behind.clamp_max(max(len(row) - 1, 0))
    distance = [
        torch.where(known[at] & (chain_of[at] == chain_of), (s[at] - s).abs(), torch.inf)
        for at in (before, behind)
    ]
    nearest = torch.where(distance[0] <= distance[1], before, behind)
    is_filled = torch.minimum(*distance).isfinite()
    return torch.where(is_filled, kind[nearest], overall[chain_of])
