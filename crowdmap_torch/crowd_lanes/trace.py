"""Markers traced along the density ridges of all journeys' lane samples: linked, cut where they end, and by type."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_range, group_sum
from crowdmap_torch.crowd_lanes.density_ridge import (
    RidgeConfig,
    RidgePoints,
    seed_points,
    shift_to_ridges,
)
from crowdmap_torch.crowd_lanes.line_samples import LineSamples, owners_around, stations
from crowdmap_torch.crowd_lanes.non_maximum_suppression import local_maxima
from crowdmap_torch.crowd_lanes.polyline_linking import (
    BridgeConfig,
    LinkConfig,
    Polylines,
    bridge_gaps,
    keep_rows,
    link_points,
    select_polylines,
)
from crowdmap_torch.processes.sums import running_sum
from crowdmap_torch.ranges import Count, Length, Settings, Share
from crowdmap_torch.tables import LANE_TYPES


@dataclass(frozen=True)
class TraceConfig(Settings):
    """What makes a marker."""

    min_journeys: Count = 2
    """A place of a marker must be seen by as many, or by all there are; 1 admits single-journey markers."""
    min_share: Share = 0.1
    """Of the journeys that saw any marker nearby, at least this share must support a place."""
    short_m: Length = 40.0
    """Shorter markers must be supported by more, as strayed pieces may happen to agree over a short way: ..."""
    short_share: Share = 0.8
    """... by this share of the journeys nearby at no length, falling to `min_share`."""
    nearby_m: Length = 8.0
    """How near is nearby."""
    max_gap_m: Length = 40.0
    """A stretch with too little support is bridged up to this length, if some journey saw the marker there."""
    max_blind_gap_m: Length = 10.0
    """A stretch that nobody saw is bridged up to this length if its ends fit."""
    min_length_m: Length = 8.0
    """Shorter markers are dropped."""
    type_window_m: Length = 15.0
    """Votes on the type are counted this far ahead and behind."""
    type_majority: Share = 0.65
    """A type changes where another one has this share of the votes."""
    type_run_m: Length = 20.0
    """A type lasts at least this long."""
    link: LinkConfig = field(default_factory=LinkConfig)
    """Who may follow whom."""


@dataclass(frozen=True)
class Traced:
    """Points on ridges, linked."""

    point: RidgePoints
    polylines: Polylines


def trace(samples: LineSamples, ridge_config: RidgeConfig, config: TraceConfig) -> Traced:
    """Markers as polylines of ridge points; both ends of each have enough support."""
    owners = len(torch.unique(samples.owner))
    rough, fine = ridge_config.iterations
    points = seed_points(samples, ridge_config, len(LANE_TYPES))
    points = shift_to_ridges(points, samples, ridge_config, iterations=rough)
    points = _thinned(points, ridge_config, along=0.7)
    points = shift_to_ridges(points, samples, ridge_config, iterations=fine)
    points = _thinned(points, ridge_config, along=1.0)
    around = owners_around(points.point, samples, config.nearby_m)
    enough = (config.min_share * around).clamp_min(min(config.min_journeys, owners))
    is_strong = points.owners >= enough
    lines = link_points(points.point, points.direction, is_strong, config.link)
    lines = without_weak(lines, points.point, is_strong, config.max_gap_m)
    return Traced(points, without_short(lines, points.point, config.min_length_m / 2))


def _thinned(points: RidgePoints, config: RidgeConfig, *, along: float) -> RidgePoints:
    """The local maxima of the points that anything supports."""
    points = points[points.density > 0.2]
    kept = local_maxima(
        points,
        along=along,
        sideways=1.3 * config.bandwidth,
        beside_stronger=max(0.9, 2 * config.bandwidth),
        height_gate=config.height_gate,
    )
    return points[kept]


def without_weak(
    lines: Polylines, point: Float[Tensor, "n 3"], is_strong: Bool[Tensor, " n"], max_gap: float
) -> Polylines:
    """Polylines without weakly supported stretches, but for those up to `max_gap` [m] between well supported ones."""
    s, _ = stations(point[lines.node], lines.line, lines.count)
    strong = is_strong[lines.node]
    before, after, inside = _nearest_set(strong)
    inside &= (lines.line[before] == lines.line) & (lines.line[after] == lines.line)
    keep = strong | (inside & (s[after] - s[before] <= max_gap))
    return keep_rows(lines, keep)


def _nearest_set(
    flag: Bool[Tensor, " k"],
) -> tuple[Int[Tensor, " k"], Int[Tensor, " k"], Bool[Tensor, " k"]]:
    """The last row at or before each one that is set, the first at or behind it, and whether there are both."""
    row, end = torch.arange(len(flag), device=flag.device), len(flag)
    before = torch.where(flag, row, -1).cummax(0).values
    behind = torch.where(flag, row, end).flip(0).cummin(0).values.flip(0)
    is_between = (before >= 0) & (behind < end)
    return before.clamp_min(0), behind.clamp_max(max(end - 1, 0)), is_between


def without_short(lines: Polylines, point: Float[Tensor, "n 3"], min_length: float) -> Polylines:
    """Polylines of at least `min_length` [m]."""
    _, length = stations(point[lines.node], lines.line, lines.count)
    return select_polylines(lines, length >= min_length)


def bridged(traced: Traced, samples: LineSamples, config: TraceConfig) -> Polylines:
    """Polylines joined across gaps that some journey saw the marker in, or that are short and straight on."""
    bridge_config = BridgeConfig(
        max_gap=config.max_blind_gap_m, max_gap_seen=max(config.max_gap_m, config.max_blind_gap_m)
    )
    points = traced.point
    return bridge_gaps(
        traced.polylines, points.point, points.direction, samples.point, bridge_config
    )


def cut_by_type(
    lines: Polylines,
    point: Float[Tensor, "n 3"],
    votes: Float[Tensor, "n kinds"],
    config: TraceConfig,
) -> tuple[Polylines, Int[Tensor, " count"], Int[Tensor, "j 2"]]:
    """Polylines cut where the type changes by a clear vote, their types (-1 unknown), and which goes on in which.

    The polylines on both sides of a cut share the point there.
    """
    s, _ = stations(point[lines.node], lines.line, lines.count)
    kind = _smooth_kinds(s, lines, votes[lines.node], config)
    breaks = torch.zeros_like(kind, dtype=torch.bool)
    breaks[1:] = (kind[1:] != kind[:-1]) & (lines.line[1:] == lines.line[:-1])
    label = lines.line + breaks.long().cumsum(0)
    kind_of = torch.full((lines.count + int(breaks.sum()),), -1).to(kind)
    kind_of[label] = kind
    after = label[breaks]
    # The row of a cut stands twice: last of the polyline before, first of its own.
    twice = torch.repeat_interleave(1 + breaks.long())
    is_copy = torch.zeros_like(twice, dtype=torch.bool)
    is_copy[:-1] = twice[1:] == twice[:-1]
    result = Polylines(lines.node[twice], label[twice] - is_copy.long(), len(kind_of))
    return result, kind_of, torch.stack((after - 1, after), dim=1)


def _smooth_kinds(
    s: Float[Tensor, " k"], lines: Polylines, votes: Float[Tensor, "k kinds"], config: TraceConfig
) -> Int[Tensor, " k"]:
    """Type at each place: the majority about it where clear and lasting, elsewhere that of the nearest such place."""
    line = lines.line
    whole = group_sum(votes, line, lines.count)
    overall = torch.where(whole.sum(1) > 0, whole.argmax(1), -1)
    # One axis for all polylines, with gaps wider than the window between them.
    far = float(s.max()) + 4 * config.type_window_m if len(s) else 0.0
    x = s + line * far
    total = torch.cat((votes.new_zeros(1, votes.shape[1]), running_sum(votes)))
    low = torch.searchsorted(x, x - config.type_window_m)
    high = torch.searchsorted(x, x + config.type_window_m, right=True)
    around = total[high] - total[low]
    share = around.max(1).values / around.sum(1).clamp_min(1e-12)
    kind = torch.where(share >= config.type_majority, around.argmax(1), -1)
    # Runs of one type that are too short say nothing.
    change = torch.ones_like(kind, dtype=torch.bool)
    change[1:] = (kind[1:] != kind[:-1]) | (line[1:] != line[:-1])
    run = change.long().cumsum(0) - 1
    runs = int(run[-1]) + 1 if len(run) else 0
    first, last = group_range(s, run, runs)
    kind = torch.where((last - first)[run] < config.type_run_m, -1, kind)
    # Filled from the nearer of what is known before and behind, with the polyline's own majority where nothing is.
    known = kind >= 0
    before, behind, _ = _nearest_set(known)
    distance = [
        torch.where(known[at] & (line[at] == line), (s[at] - s).abs(), torch.inf)
        for at in (before, behind)
    ]
    nearest = torch.where(distance[0] <= distance[1], before, behind)
    is_filled = torch.minimum(*distance).isfinite()
    return torch.where(is_filled, kind[nearest], overall[line])
