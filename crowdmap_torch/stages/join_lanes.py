"""V-A.2 (sec:mj-cluster-lanes): the lane pieces of many journeys joined along the road into continuous markers.

Unlike the paper, nothing is decided about whole pieces: samples of all pieces make up ridges, ridges are strung
together, and a piece supports every marker that it runs along. The slow offsets of the journeys against the common
courses are taken off before the ridges are traced a second time, sharper.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering import chain
from crowdmap_torch.clustering.chain import Chains
from crowdmap_torch.clustering.groups import group_mode, group_sum
from crowdmap_torch.clustering.lines import LineSamples, owners_around
from crowdmap_torch.clustering.ridge import RidgeConfig
from crowdmap_torch.courses.curves import (
    Curves,
    Match,
    curves_of,
    curves_through,
    fit_curves,
    knot_spacing,
    match,
    select_curves,
)
from crowdmap_torch.courses.drift import DriftConfig, journey_offsets
from crowdmap_torch.courses.duplicates import covered_twice, crosses_longer, nearest_row
from crowdmap_torch.courses.grow import drawn_out, supported_rows
from crowdmap_torch.courses.samples import LaneSamples, merged, sample_lanes, stray_samples
from crowdmap_torch.courses.support import lanes_table
from crowdmap_torch.courses.trace import (
    TraceConfig,
    bridged,
    cut_by_type,
    trace,
    without_short,
)
from crowdmap_torch.geometry import spline
from crowdmap_torch.tables import LANE_TYPES, Lanes

_RING_GAP = 1.0
"""A long curve whose ends are nearer to each other than this is a ring [m]."""


@dataclass(frozen=True)
class LaneJoinConfig:
    """How lane pieces become the markers of the map."""

    sample_spacing_m: float = 2.0
    """Pieces are sampled this densely."""
    few_observations: float = 10.0
    """Pieces made from fewer detections (or a quarter of the usual number, if that is less) are hardly believed."""
    bandwidths_m: tuple[float, ...] = (0.6, 0.2)
    """Sigma of the sideways kernel of each round; journeys' offsets are estimated between rounds."""
    gates_m: tuple[float, ...] = (1.2, 0.7)
    """Samples this far beside a course still belong to it, by round."""
    knot_spacing_m: tuple[float, float] = (4.0, 10.0)
    """Distance of control points in the sharpest bends and on straight roads."""
    stray_m: tuple[float, float] = (0.8, 3.8)
    """Two pieces of one tracklet that run this far beside each other cannot both be right: one is left out."""
    grow_m: float = 8.0
    """How far courses are drawn out at their ends, if samples go on."""
    twice_within_m: float = 0.45
    """Of two courses nearer to each other the lesser is dropped, unless ..."""
    seen_together: float = 0.3
    """... this share of its journeys saw both at once."""
    trace: TraceConfig = field(default_factory=TraceConfig)
    """What makes a course."""
    drift: DriftConfig = field(default_factory=DriftConfig)
    """How journeys' offsets may change."""

    def __post_init__(self) -> None:
        """Refuses rounds without a gate."""
        if len(self.gates_m) != len(self.bandwidths_m) or not self.bandwidths_m:
            raise ValueError(
                f"gates_m: expected one gate for each of the {len(self.bandwidths_m)} (at least one) "
                f"bandwidths_m, found {len(self.gates_m)}"
            )


@dataclass(frozen=True)
class LaneJoinReport:
    """What joining saw, for the report."""

    samples: int
    stray_samples: int
    """Samples left out because their tracklet runs beside them."""
    unused_samples: int
    """Other samples on no lane of the map."""
    bridged_gaps: int
    duplicates_m: float
    """Length of courses dropped because another one covers them [m]."""
    rms_before_m: float
    """Lateral scatter of the samples about the lanes as they came."""
    rms_after_m: float
    """The same without the journeys' offsets."""


@dataclass(frozen=True)
class JoinedLanes:
    """The lanes of the map, and which pieces they are made of."""

    lanes: Lanes
    piece_lane: Int[Tensor, " n"]
    """Lane on which the most of each input piece lies; -1 for none."""
    report: LaneJoinReport


def join_lanes(lanes: Lanes, config: LaneJoinConfig) -> JoinedLanes:
    """The markers of the map, each covered once, from the lane pieces of many journeys (V-A.2).

    Pieces must be roughly free of their journeys' biases already (a third of the distance between markers). Returned
    lanes run in the direction of travel, or either way where journeys run both ways.
    """
    all_samples = sample_lanes(
        lanes, config.sample_spacing_m, few_observations=config.few_observations
    )
    if not len(all_samples):
        return _nothing(lanes, all_samples)
    stray = stray_samples(all_samples, beside=config.stray_m)
    samples, merged_as = merged(all_samples[~stray], config.sample_spacing_m)
    offset = torch.zeros_like(samples.line.point)
    chains = Chains(lanes.journey[:0], lanes.journey[:0], 0)
    point, direction = samples.line.point[:0], samples.line.direction[:0]
    for bandwidth, gate in zip(config.bandwidths_m, config.gates_m, strict=True):
        moved = samples.moved(-offset)
        traced = trace(moved.line, RidgeConfig(bandwidth=bandwidth), config.trace)
        chains, point, direction = traced.chains, traced.node.point, traced.node.direction
        curves = _through(chains, point, config)
        matched = match(moved.line, curves, gate=gate)
        curves = _refit(moved.line, matched, curves, config)
        matched = match(moved.line, curves, gate=gate)
        offset = journey_offsets(samples, _without(matched, -offset), config.drift)
    gate = config.gates_m[-1]
    moved = samples.moved(-offset)
    joined = bridged(chains, point, direction, moved.line, config.trace)
    gaps = chains.count - joined.count
    curves = _through(joined, point, config)
    for _ in range(2):
        matched = match(moved.line, curves, gate=gate)
        curves = _refit(moved.line, matched, curves, config)
        offset = journey_offsets(samples, _without(matched, -offset), config.drift)
        moved = samples.moved(-offset)
    curves = _grown(curves, moved.line, gate, config)
    curves, duplicates = _once(curves, moved.line, gate, config)
    curves = _by_type(curves, moved.line, gate, config)
    matched = match(moved.line, curves, gate=gate)
    curves = _supported(curves, moved.line, matched, config)
    matched = match(moved.line, curves, gate=gate)
    curves = _along_travel(curves, moved.line, matched)
    kept = all_samples[~stray]
    offset = offset[merged_as]
    matched = match(kept.moved(-offset).line, curves, gate=gate)
    table = lanes_table(curves, lanes, kept, matched, drift_sigma=config.drift.sigma_m)
    used = matched.curve >= 0
    before = _without(matched, -offset).lateral[used]
    return JoinedLanes(
        lanes=table,
        piece_lane=group_mode(matched.curve, kept.line.weight, kept.piece, len(lanes)),
        report=LaneJoinReport(
            samples=len(all_samples),
            stray_samples=int(stray.sum()),
            unused_samples=int((~used).sum()),
            bridged_gaps=gaps,
            duplicates_m=duplicates,
            rms_before_m=_rms(before),
            rms_after_m=_rms(matched.lateral[used]),
        ),
    )


def _through(chains: Chains, point: Float[Tensor, "n 3"], config: LaneJoinConfig) -> Curves:
    kind = torch.full((chains.count,), -1, dtype=torch.int64, device=point.device)
    spacing = point.new_full((chains.count,), config.knot_spacing_m[0])
    return curves_through(point[chains.node], chains.chain, kind, spacing)


def _refit(samples: LineSamples, matched: Match, curves: Curves, config: LaneJoinConfig) -> Curves:
    shortest, longest = config.knot_spacing_m
    spacing = knot_spacing(curves, shortest=shortest, longest=longest)
    return fit_curves(samples, matched, curves, spacing)


def _without(matched: Match, offset: Float[Tensor, "s 3"]) -> Match:
    """The match of samples that are moved back by an offset."""
    return replace(
        matched,
        lateral=matched.lateral - (matched.normal * offset[:, :2]).sum(1),
        height=matched.height - offset[:, 2],
    )


def _grown(curves: Curves, samples: LineSamples, gate: float, config: LaneJoinConfig) -> Curves:
    """The curves with their ends where the samples of enough journeys end."""
    point, curve = drawn_out(curves, config.grow_m)
    rows = torch.arange(len(curve), device=curve.device)
    longer = _through(Chains(rows, curve, len(curves)), point, config)
    for _ in range(2):
        matched = match(samples, longer, gate=gate)
        needed = min(config.trace.min_journeys, len(torch.unique(samples.owner)))
        seen = supported_rows(longer, samples, matched, needed)
        rows = torch.arange(len(seen), device=seen.device)
        kept = chain.keep_rows(Chains(rows, longer.curve, len(longer)), seen)
        kept = without_short(kept, longer.point, 0.5 * config.trace.min_length_m)
        longer = _through(kept, longer.point, config)
        matched = match(samples, longer, gate=gate)
        longer = _refit(samples, matched, longer, config)
    return longer


def _once(
    curves: Curves, samples: LineSamples, gate: float, config: LaneJoinConfig
) -> tuple[Curves, float]:
    """The curves without what better supported ones cover, and the length that was dropped [m]."""
    matched = match(samples, curves, gate=gate)
    twice = covered_twice(
        curves, samples, matched, gate=config.twice_within_m, min_seen_together=config.seen_together
    )
    if not bool(twice.any()):
        return curves, 0.0
    rows = torch.arange(len(twice), device=twice.device)
    kept = chain.keep_rows(Chains(rows, curves.curve, len(curves)), ~twice)
    kept = without_short(kept, curves.point, config.trace.min_length_m)
    rest = _through(kept, curves.point, config)
    matched = match(samples, rest, gate=gate)
    return _refit(samples, matched, rest, config), float(twice.sum())


def _by_type(curves: Curves, samples: LineSamples, gate: float, config: LaneJoinConfig) -> Curves:
    """The curves with their types, cut where the type changes; both sides of a cut end in one point, as do rings."""
    matched = match(samples, curves, gate=gate)
    used = (matched.curve >= 0) & (samples.kind >= 0)
    row, kinds = nearest_row(curves, matched)[used], len(LANE_TYPES)
    votes = group_sum(
        samples.weight[used], row * kinds + samples.kind[used], len(curves.point) * kinds
    )
    rows = torch.arange(len(curves.point), device=row.device)
    chains, kind, joints = cut_by_type(
        Chains(rows, curves.curve, len(curves)),
        curves.point,
        votes.reshape(-1, kinds),
        config.trace,
    )
    pieces = replace(_through(chains, curves.point, config), kind=kind)
    matched = match(samples, pieces, gate=gate)
    pieces = _refit(samples, matched, pieces, config)
    first = spline.starts(pieces.count)
    last = first + pieces.count - 1
    gap = (pieces.control[first] - pieces.control[last]).norm(dim=1)
    ring = ((gap < _RING_GAP) & (pieces.length > 50 * _RING_GAP)).nonzero()
    joints = torch.cat((joints, ring.expand(-1, 2)))
    control = pieces.control.clone()
    middle = 0.5 * (control[last[joints[:, 0]]] + control[first[joints[:, 1]]])
    control[last[joints[:, 0]]] = middle
    control[first[joints[:, 1]]] = middle
    return curves_of(control, pieces.count, pieces.kind)


def _supported(
    curves: Curves, samples: LineSamples, matched: Match, config: LaneJoinConfig
) -> Curves:
    """The curves that are long enough and seen by enough journeys, each over a fifth of it or 20 m."""
    used = (matched.curve >= 0) & samples.is_witness
    owners = int(samples.owner.max()) + 1
    key, group = torch.unique(
        matched.curve[used] * owners + samples.owner[used], return_inverse=True
    )
    # Stretches of four metres seen, not samples: pieces overlap.
    stretch = (matched.station[used] / 4.0).floor().long().clamp_min(0)
    stretches = int(stretch.max()) + 1 if len(stretch) else 1
    seen = torch.unique(group * stretches + stretch) // stretches
    covered = 4.0 * torch.bincount(seen, minlength=len(key))
    curve = key // owners
    enough = covered >= (0.2 * curves.length[curve]).clamp_max(20.0)
    journeys = torch.bincount(curve[enough], minlength=len(curves))
    rules = config.trace
    needed = min(rules.min_journeys, len(torch.unique(samples.owner)))
    around = owners_around(curves.point, samples, rules.nearby_m).to(samples.weight)
    number = torch.bincount(curves.curve, minlength=len(curves))
    around = group_sum(around, curves.curve, len(curves)) / number
    is_long = curves.length >= rules.short_m
    share = rules.short_share + (rules.min_share - rules.short_share) * (
        curves.length / rules.short_m
    )
    is_right = is_long | ((journeys >= share * around) & ~crosses_longer(curves))
    enough = (journeys >= needed) & is_right
    return select_curves(curves, enough & (curves.length >= rules.min_length_m))


def _along_travel(curves: Curves, samples: LineSamples, matched: Match) -> Curves:
    """The curves, turned round where most samples run against them."""
    used = matched.curve >= 0
    vote = group_sum(
        matched.along[used].sign() * samples.weight[used], matched.curve[used], len(curves)
    )
    curve, rank = spline.rows(curves.count)
    first = spline.starts(curves.count)
    turned = torch.where(vote[curve] < 0, curves.count[curve] - 1 - rank, rank)
    return curves_of(curves.control[first[curve] + turned], curves.count, curves.kind)


def _nothing(lanes: Lanes, samples: LaneSamples) -> JoinedLanes:
    """The result where there are no pieces."""
    row = lanes.journey[:0]
    return JoinedLanes(
        lanes=lanes.select(row),
        piece_lane=torch.full_like(lanes.journey, -1),
        report=LaneJoinReport(0, 0, 0, 0, 0.0, 0.0, 0.0),
    )


def _rms(value: Float[Tensor, " s"]) -> float:
    return float(value.square().mean().sqrt()) if len(value) else 0.0
