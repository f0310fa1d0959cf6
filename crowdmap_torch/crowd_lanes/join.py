"""V-A.2 (sec:mj-cluster-lanes): the lane pieces of many journeys joined along the road into continuous markers.

Unlike the paper, nothing is decided about whole pieces: samples of all pieces make up density ridges, points on these are
linked to polylines, and a piece supports every marker that it runs along. The slow offsets of the journeys against the
common curves are taken off before the ridges are traced a second time, sharper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_mode, group_sum
from crowdmap_torch.crowd_lanes.density_ridge import RidgeConfig
from crowdmap_torch.crowd_lanes.duplicates import covered_twice, crosses_longer
from crowdmap_torch.crowd_lanes.extend_ends import extended, supported_rows
from crowdmap_torch.crowd_lanes.how_often import how_often, metres_seen
from crowdmap_torch.crowd_lanes.lateral_offsets import LateralOffsetConfig, journey_offsets
from crowdmap_torch.crowd_lanes.line_samples import LineSamples, owners_around
from crowdmap_torch.crowd_lanes.polyline_linking import Polylines, keep_rows
from crowdmap_torch.crowd_lanes.samples import (
    LaneSamples,
    merge_overlapping,
    sample_lanes,
    stray_samples,
)
from crowdmap_torch.crowd_lanes.splines import (
    Curves,
    Match,
    curves_of,
    curves_through,
    fit_curves,
    knot_spacing,
    match,
    nearest_row,
    select_curves,
)
from crowdmap_torch.crowd_lanes.table import LaneSupport, lanes_table
from crowdmap_torch.crowd_lanes.tie_groups import GroupTieConfig
from crowdmap_torch.crowd_lanes.trace import (
    TraceConfig,
    Traced,
    bridged,
    cut_by_type,
    trace,
    without_short,
)
from crowdmap_torch.geometry import spline_basis
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.ranges import FILLED, Factor, Length, Settings, Share, Sigma, Spacing, Span
from crowdmap_torch.tables import LANE_TYPES, Lanes, concatenate_lanes

_RING_GAP = 1.0
"""A long curve whose ends are nearer to each other than this is a ring [m]."""


@dataclass(frozen=True)
class LaneJoinConfig(Settings):
    """How lane pieces become the markers of the map."""

    sample_spacing_m: Spacing = 2.0
    """Pieces are sampled this densely."""
    few_observations: Factor = 10.0
    """Pieces made from fewer detections (or a quarter of the usual number, if that is less) are hardly believed."""
    bandwidths_m: Annotated[tuple[Sigma, ...], FILLED] = (0.6, 0.2)
    """Sigma of the sideways kernel of each round; journeys' offsets are estimated between rounds."""
    gates_m: Annotated[tuple[Length, ...], FILLED] = (1.2, 0.7)
    """Samples this far beside a curve still belong to it, by round."""
    knot_spacing_m: Span = (4.0, 10.0)
    """Distance of control points in the sharpest bends and on straight roads."""
    stray_m: Span = (0.8, 3.8)
    """Two pieces of one tracklet that run this far beside each other cannot both be right: one is left out."""
    extend_m: Length = 8.0
    """How far curves are extended at their ends, if samples go on."""
    twice_within_m: Length = 0.45
    """Of two curves nearer to each other the lesser is dropped, unless ..."""
    seen_together: Share = 0.3
    """... this share of its journeys saw both at once."""
    least_often: Share = 0.25
    """Markers are detected at least this often, as a share of what is usual where the same drives see markers."""
    doubt_m: Length = 0.25
    """Where pieces lie further beside their markers than this [m, RMS], these may be others': they are joined where signs
    alone place the drives, unless markers fall apart there."""
    anew_from: Share = 0.02
    """Where so much of an adjusted map's lanes is there twice, pieces are joined anew by adjusted poses, unless half of that
    would stay, and the adjustment begins again (`duplicate_signs: {rounds: ...}` times at most)."""
    trace: TraceConfig = field(default_factory=TraceConfig)
    """What makes a marker."""
    lateral_offset: LateralOffsetConfig = field(default_factory=LateralOffsetConfig)
    """How journeys' offsets may change."""
    tie_groups: GroupTieConfig = field(default_factory=GroupTieConfig)
    """How drives that no sign ties to others are placed first."""

    def __post_init__(self) -> None:
        """Refuses rounds without a gate."""
        super().__post_init__()
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
    """Length of curves dropped because another one covers them [m]."""
    seldom_m: float
    """Length of curves dropped because they are detected too seldom [m]."""
    rms_before_m: float
    """Lateral scatter of the samples about the lanes as they came."""
    rms_after_m: float
    """The same without the journeys' offsets."""
    length_m: float
    """Length of the lanes [m]."""

    @property
    def samples_per_m(self) -> float:
        """Samples of pieces on a metre of the lanes; few where pieces of one marker are on several."""
        used = self.samples - self.stray_samples - self.unused_samples
        return used / self.length_m if self.length_m else 0.0


@dataclass(frozen=True)
class JoinedLanes:
    """The lanes of the map, and which pieces they are made of."""

    lanes: Lanes
    piece_lane: Int[Tensor, " n"]
    """Lane on which the most of each input piece lies; -1 for none."""
    support: LaneSupport
    """Which lane each place of the pieces is of."""
    report: LaneJoinReport


def join_lanes(lanes: Lanes, positioning: PositioningNoise, config: LaneJoinConfig) -> JoinedLanes:
    """The markers of the map, each covered once, from the lane pieces of many journeys (V-A.2).

    Pieces must be roughly free of their journeys' biases already (a third of the distance between markers). Returned
    lanes run in the direction of travel, or either way where journeys run both ways.
    """
    all_samples = sample_lanes(
        lanes, config.sample_spacing_m, positioning, few_observations=config.few_observations
    )
    if not len(all_samples):
        return _nothing(lanes, all_samples)
    stray = stray_samples(all_samples, beside=config.stray_m)
    kept = all_samples[~stray]
    samples, merged_as = merge_overlapping(kept, config.sample_spacing_m)
    offset = torch.zeros_like(samples.line.point)
    bandwidth, gate = config.bandwidths_m[0], config.gates_m[0]
    traced, offset = _trace_round(samples, offset, bandwidth, gate, positioning, config)
    for bandwidth, gate in zip(config.bandwidths_m[1:], config.gates_m[1:], strict=True):
        traced, offset = _trace_round(samples, offset, bandwidth, gate, positioning, config)
    lines = bridged(traced, samples.moved(-offset).line, config.trace)
    curves = _through(lines, traced.point.point, config)
    curves, offset = _with_offsets(curves, samples, offset, gate, positioning, config)
    moved = samples.moved(-offset).line
    curves = _extended(curves, moved, gate, config)
    curves, duplicates = _once(curves, moved, gate, config)
    curves = _by_type(curves, moved, gate, config)
    curves = _supported(curves, moved, gate, config)
    curves = _along_travel(curves, moved, gate)
    offset = offset[merged_as]
    line = kept.moved(-offset).line
    curves, matched, seldom = _often_enough(curves, line, kept, lanes, gate, config)
    table = lanes_table(curves, lanes, kept, matched, offset_sigma=positioning.drift_sigma_m)
    used = matched.curve >= 0
    return JoinedLanes(
        lanes=table,
        piece_lane=group_mode(matched.curve, kept.line.weight, kept.piece, len(lanes)),
        support=LaneSupport(
            kept.line.point, kept.line.owner, lanes.tracklet[kept.piece], matched.curve
        ),
        report=LaneJoinReport(
            samples=len(all_samples),
            stray_samples=int(stray.sum()),
            unused_samples=int((~used).sum()),
            bridged_gaps=traced.polylines.count - lines.count,
            duplicates_m=duplicates,
            seldom_m=seldom,
            rms_before_m=_rms(matched.shifted(offset).lateral[used]),
            rms_after_m=_rms(matched.lateral[used]),
            length_m=float(curves.length.sum()),
        ),
    )


def unbiased_lanes(lanes: Lanes, drift: Float[Tensor, "f 6"]) -> Lanes:
    """The pieces of one journey, each moved as the pose of its middle frame is.

    `drift` holds the tangent from each given pose to the one without bias; a piece is not turned.
    """
    if not len(lanes):
        return lanes
    shift = drift[lanes.frame, :3]
    point = lanes.control.point_world + shift[lanes.piece_of_control]
    return replace(lanes, control=replace(lanes.control, point_world=point))


def unbiased_pieces(
    made: Sequence[Lanes],
    drifts: Sequence[Float[Tensor, "_ 6"]],
    trusted: Sequence[Bool[Tensor, " _"]],
) -> Lanes:
    """The pieces of all journeys, moved as their poses are, of the frames that are trusted.

    Bad drives leave nothing behind: where they are off is not known well enough to move their pieces.
    """
    every = zip(made, drifts, trusted, strict=True)
    return concatenate_lanes(
        [
            unbiased_lanes(pieces.select(torch.nonzero(is_good[pieces.frame])[:, 0]), drift)
            for pieces, drift, is_good in every
        ]
    )


def _trace_round(
    samples: LaneSamples,
    offset: Float[Tensor, "s 3"],
    bandwidth: float,
    gate: float,
    positioning: PositioningNoise,
    config: LaneJoinConfig,
) -> tuple[Traced, Float[Tensor, "s 3"]]:
    """Markers traced along ridges of the samples without `offset`, and the samples' offsets against these."""
    moved = samples.moved(-offset).line
    traced = trace(moved, RidgeConfig(bandwidth=bandwidth), config.trace)
    curves = _refit(moved, _through(traced.polylines, traced.point.point, config), gate, config)
    matched = match(moved, curves, gate=gate)
    return traced, journey_offsets(
        samples, matched.shifted(offset), positioning, config.lateral_offset
    )


def _with_offsets(
    curves: Curves,
    samples: LaneSamples,
    offset: Float[Tensor, "s 3"],
    gate: float,
    positioning: PositioningNoise,
    config: LaneJoinConfig,
) -> tuple[Curves, Float[Tensor, "s 3"]]:
    """Curves and offsets of samples, fitted to each other in turns."""
    for _ in range(2):
        moved = samples.moved(-offset).line
        matched = match(moved, curves, gate=gate)
        curves = fit_curves(moved, matched, curves, knot_spacing(curves, config.knot_spacing_m))
        offset = journey_offsets(
            samples, matched.shifted(offset), positioning, config.lateral_offset
        )
    return curves, offset


def _through(lines: Polylines, point: Float[Tensor, "n 3"], config: LaneJoinConfig) -> Curves:
    """Curves through the points of polylines."""
    kind = torch.full((lines.count,), -1, dtype=torch.int64, device=point.device)
    spacing = point.new_full((lines.count,), config.knot_spacing_m[0])
    return curves_through(point[lines.node], lines.line, kind, spacing)


def _polylines(curve: Int[Tensor, " k"], curves: int) -> Polylines:
    """The points of curves as polylines."""
    return Polylines(torch.arange(len(curve), device=curve.device), curve, curves)


def _refit(samples: LineSamples, curves: Curves, gate: float, config: LaneJoinConfig) -> Curves:
    """The curves, fitted to the samples beside them."""
    matched = match(samples, curves, gate=gate)
    return fit_curves(samples, matched, curves, knot_spacing(curves, config.knot_spacing_m))


def _extended(curves: Curves, samples: LineSamples, gate: float, config: LaneJoinConfig) -> Curves:
    """The curves with their ends where the samples of enough journeys end."""
    point, curve = extended(curves, config.extend_m)
    longer = _through(_polylines(curve, len(curves)), point, config)
    for _ in range(2):
        matched = match(samples, longer, gate=gate)
        needed = min(config.trace.min_journeys, len(torch.unique(samples.owner)))
        seen = supported_rows(longer, samples, matched, needed)
        kept = keep_rows(_polylines(longer.curve, len(longer)), seen)
        kept = without_short(kept, longer.point, 0.5 * config.trace.min_length_m)
        longer = _refit(samples, _through(kept, longer.point, config), gate, config)
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
    kept = keep_rows(_polylines(curves.curve, len(curves)), ~twice)
    kept = without_short(kept, curves.point, config.trace.min_length_m)
    rest = _through(kept, curves.point, config)
    return _refit(samples, rest, gate, config), float(twice.sum())


def _by_type(curves: Curves, samples: LineSamples, gate: float, config: LaneJoinConfig) -> Curves:
    """The curves with their types, cut where the type changes; both sides of a cut end in one point, as do rings."""
    matched = match(samples, curves, gate=gate)
    used = (matched.curve >= 0) & (samples.kind >= 0)
    row, kinds = nearest_row(curves, matched)[used], len(LANE_TYPES)
    votes = group_sum(
        samples.weight[used], row * kinds + samples.kind[used], len(curves.point) * kinds
    )
    lines, kind, joints = cut_by_type(
        _polylines(curves.curve, len(curves)), curves.point, votes.reshape(-1, kinds), config.trace
    )
    pieces = replace(_through(lines, curves.point, config), kind=kind)
    pieces = _refit(samples, pieces, gate, config)
    first = spline_basis.starts(pieces.count)
    last = first + pieces.count - 1
    gap = (pieces.control[first] - pieces.control[last]).norm(dim=1)
    ring = ((gap < _RING_GAP) & (pieces.length > 50 * _RING_GAP)).nonzero()
    joints = torch.cat((joints, ring.expand(-1, 2)))
    control = pieces.control.clone()
    middle = 0.5 * (control[last[joints[:, 0]]] + control[first[joints[:, 1]]])
    control[last[joints[:, 0]]] = middle
    control[first[joints[:, 1]]] = middle
    return curves_of(control, pieces.count, pieces.kind)


def _supported(curves: Curves, samples: LineSamples, gate: float, config: LaneJoinConfig) -> Curves:
    """The curves that are long enough and seen by enough journeys, each over a fifth of it or 20 m."""
    matched = match(samples, curves, gate=gate)
    used = (matched.curve >= 0) & samples.is_witness
    owners = int(samples.owner.max()) + 1
    key, group = torch.unique(
        matched.curve[used] * owners + samples.owner[used], return_inverse=True
    )
    covered = metres_seen(group, matched.station[used], len(key))
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


def _often_enough(
    curves: Curves,
    line: LineSamples,
    samples: LaneSamples,
    lanes: Lanes,
    gate: float,
    config: LaneJoinConfig,
) -> tuple[Curves, Match, float]:
    """The curves that are detected often enough, the samples on them, and the length of the others [m].

    A piece's detections count as far as they agree where it is. What was taken for one of these curves may lie on another.
    """
    matched = match(line, curves, gate=gate)
    detections = lanes.n_observations * lanes.confidence
    of_piece = detections / torch.bincount(samples.piece, minlength=len(lanes))
    on = matched.curve >= 0
    share = how_often(
        *(matched.curve[on], matched.station[on], line.owner[on]),
        of_piece[samples.piece[on]].to(line.weight),
        len(curves),
    )
    often = share >= config.least_often
    if bool(often.all()):
        return curves, matched, 0.0
    dropped = float(curves.length[~often].sum())
    curves = select_curves(curves, often)
    return curves, match(line, curves, gate=gate), dropped


def _along_travel(curves: Curves, samples: LineSamples, gate: float) -> Curves:
    """The curves, turned round where most samples run against them."""
    matched = match(samples, curves, gate=gate)
    used = matched.curve >= 0
    vote = group_sum(
        matched.along[used].sign() * samples.weight[used], matched.curve[used], len(curves)
    )
    curve, rank = spline_basis.rows(curves.count)
    first = spline_basis.starts(curves.count)
    turned = torch.where(vote[curve] < 0, curves.count[curve] - 1 - rank, rank)
    return curves_of(curves.control[first[curve] + turned], curves.count, curves.kind)


def _nothing(lanes: Lanes, samples: LaneSamples) -> JoinedLanes:
    """The result where there are no pieces."""
    row = lanes.journey[:0]
    return JoinedLanes(
        lanes=lanes.select(row),
        piece_lane=torch.full_like(lanes.journey, -1),
        support=LaneSupport(samples.line.point[:0], row, row, row),
        report=LaneJoinReport(0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0),
    )


def _rms(value: Float[Tensor, " s"]) -> float:
    return float(value.square().mean().sqrt()) if len(value) else 0.0
