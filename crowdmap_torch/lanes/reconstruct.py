"""IV-D: lane tracklets of one journey -> overlapping pieces of markers as natural cubic splines, and what was pruned.

`paper2017` maps every point to the plane under the car in its frame, and fits a spline to the most
recent points again and again. Unlike the paper, `surface` lays the points on the road as the car
drove it, weighs them by how far away they were seen, and cuts a marker into pieces of equal length.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import distinct_pairs, group_mode, group_range, group_sum
from crowdmap_torch.geometry import spline_basis, spline_length
from crowdmap_torch.lanes.existence import expected_by_chance
from crowdmap_torch.lanes.pieces import (
    LaneFit,
    LanePieces,
    cut_by_length,
    cut_by_number,
    dash_gap,
    fit_pieces,
    runs_in_plane,
    thin_gap,
    well_seen,
    with_enough_points,
)
from crowdmap_torch.ranges import (
    FILLED,
    Count,
    Factor,
    Length,
    Pixels,
    Range,
    Settings,
    Share,
    Sigma,
    Spacing,
    Span,
)
from crowdmap_torch.road.ground_projection import (
    GroundPoints,
    lateral_sigma,
    project_to_planes,
    project_to_surface,
)
from crowdmap_torch.tables import ControlPoints, Journey, Lanes, RoadEstimate, Tracklets

METHODS = ("surface", "paper2017")
REASONS = (
    "kept",
    "too few frames",
    "no points near enough",
    "too short",
    "too uncertain",
    "no better than chance",
    "too few points",
)
"""What becomes of a tracklet, by code."""
KEPT, FEW_FRAMES, NO_POINTS, SHORT, UNCERTAIN, CHANCE, FEW_POINTS = range(len(REASONS))


@dataclass(frozen=True)
class PaperPieces(Settings):
    """The pieces of the paper (IV-D), and what it leaves open of them."""

    min_frames: Count = 4
    """Tracklets with fewer detections are pruned."""
    recent_points: Count = 200
    """Points of a piece; a new piece begins after half of them."""
    control_points: Annotated[int, Range(2, 1000, "a spline has two ends")] = 5
    """Of every piece; fewer points than that make no piece."""
    range_m: Span = (2.0, 45.0)
    """Depth of the points that are used."""
    sigma_m: Sigma = 0.2
    """1-sigma of a point across its marker: for the covariances, all points weigh alike."""


@dataclass(frozen=True)
class LaneConfig(Settings):
    """How lane tracklets become splines (IV-D)."""

    method: str = "surface"
    """`surface`: points on the road that the car drove; `paper2017`: points on one plane a frame,
    most recent points."""
    paper: PaperPieces = field(default_factory=PaperPieces)
    """Method `paper2017`."""
    confident_frames: Factor = 4.0
    """Detections that a piece needs for its confidence to reach 1 - 1/e, ..."""
    usual_misses: Factor = 2.0
    """... if all its points are no further from it than so many times what is usual of the drive, by what is expected of
    each: points of a marker agree where it is, those of lines that nobody painted lie anywhere beside one."""
    sigma_m: Sigma = 0.04
    """1-sigma of a piece's lateral error that its points share."""
    height_sigma: Sigma = 0.015
    """1-sigma of the camera height, as a share of it: offsets are off by the same share."""
    min_frames: Count = 4
    """Tracklets with fewer detections are pruned; method `surface`, as all that follows."""
    min_seen: Share = 0.15
    """Stretches of a marker seen from a smaller share of as many places as its usual one are left out."""
    min_length_m: Length = 4.0
    """Pieces that are shorter are pruned."""
    min_points: Count = 12
    """Pieces with fewer points are pruned, ..."""
    usual_points: Share = 0.25
    """... or with less than this share of a drive's usual number, where that is fewer: of a marker that is detected in few
    points, many drives tell where it is."""
    least_points: Count = 4
    """However few are usual, so many points make a piece."""
    max_sigma_m: Sigma = 1.0
    """Pieces whose control points are less sure, in the mean, are pruned."""
    band_m: Length = 1.2
    """Detections that run along a piece so near to it say whether it exists (`lanes.existence`): ..."""
    near_m: Length = 0.25
    """... those of a marker are this near to it in the mean, those of chance anywhere in the band."""
    by_chance: Factor = 1.0
    """Pieces are pruned of which chance would make as many in a drive."""
    range_m: Span = (2.0, 25.0)
    """Depth of the points that are used."""
    piece_m: Spacing = 40.0
    """Length of a piece."""
    overlap: Annotated[float, Range(0, 0.89, "a share: with more, pieces hardly move on")] = 0.5
    """Share of a piece that the next one covers too."""
    control_points: Annotated[int, Range(2, 1000, "a spline has two ends")] = 6
    """Of a whole piece; shorter ones have fewer, at the same spacing."""
    points_of_control: Count = 2
    """Pieces have a control point for so many points, three at least: with more, a few points of another marker bend
    them."""
    max_gap_m: Length = 12.0
    """A marker without points over a longer way ends, and begins again behind it: dashes are bridged,
    intersections are not."""
    max_dash_gap_m: Length = 20.0
    """Dashes further apart are bridged up to this length, where a marker's gaps are usually as long; and so are gaps that
    chance leaves between few points."""
    noise_px: Pixels = 1.0
    """1-sigma of lane points."""
    normal_sigma: Sigma = 1.5e-3
    """1-sigma of the normal's error that changes from frame to frame [rad]."""
    drift: Sigma = 0.01
    """Drift of the car's reckoned way over one metre [m]; with the square root of the way."""
    smoothing: Factor = 1e-4
    """Price of bending, in units of a piece's whole weight."""
    scales: Annotated[tuple[Factor, ...], FILLED] = (8.0, 4.0, 2.0, 1.0)
    """Factors on the noise in iterated least squares (Tukey), coarse to fine."""

    def __post_init__(self) -> None:
        """Refuses unknown methods."""
        super().__post_init__()
        if self.method not in METHODS:
            raise ValueError(f"method: expected one of {', '.join(METHODS)}, found {self.method!r}")
        if not self.near_m < self.band_m:
            raise ValueError(
                f"near_m: expected less than band_m ({self.band_m:g} m), found {self.near_m:g}"
            )


@dataclass(frozen=True)
class LaneReport:
    """What became of the lane tracklets of one journey."""

    reason: Int[Tensor, " count"]
    """Index into `REASONS` of every tracklet."""
    points: int
    """Points of the pieces kept; those in two pieces count twice."""
    outliers: int
    """Those of them that the splines left out."""
    rms_m: float
    """Of the lateral misses of the others."""

    @property
    def pruned(self) -> dict[str, int]:
        """Tracklets by reason, those kept included."""
        counts = torch.bincount(self.reason, minlength=len(REASONS)).tolist()
        return dict(zip(REASONS, counts, strict=True))


@torch.no_grad()
def reconstruct_lanes(
    journey: Journey, tracklets: Tracklets, road: RoadEstimate, config: LaneConfig
) -> tuple[Lanes, LaneReport]:
    """The lane pieces that a journey's tracklets show (the paper's O2), and what was pruned."""
    label = tracklets.label
    frames = torch.bincount(label[label >= 0], minlength=tracklets.count)
    is_paper = config.method == "paper2017"
    min_frames = config.paper.min_frames if is_paper else config.min_frames
    reason = torch.where(frames < min_frames, FEW_FRAMES, NO_POINTS)
    is_long = torch.nn.functional.pad(reason == NO_POINTS, (0, 1))  # the last one for no tracklet
    ground = (project_to_planes if is_paper else project_to_surface)(journey, road)
    near, far = config.paper.range_m if is_paper else config.range_m
    detection = journey.lane_points.detection
    used = is_long[label[detection]]
    in_range = ground.is_on_ground & (ground.depth > near) & (ground.depth < far)
    everything = ground.point_world[in_range, :2], detection[in_range]
    rows = (used & in_range).nonzero()[:, 0]
    ground, detection = ground[rows], detection[rows]
    frame, marker = journey.lanes.frame[detection], label[detection]
    reason = reason.index_fill(0, marker, FEW_POINTS)
    if is_paper:
        pieces, fit = _papers_pieces(ground, frame, marker, config.paper)
    else:
        kept = well_seen(
            marker, _along(ground, marker), ground.station - ground.depth, config.min_seen
        )
        ground, detection = ground[kept], detection[kept]
        frame, marker = frame[kept], marker[kept]
        pieces, fit = _pieces(journey, ground, frame, marker, road, config)
    sigma = _control_sigma(ground, pieces, fit, config)
    if is_paper:
        # The paper's rule is the length of tracklets, which was looked at above.
        reason = reason.index_fill(0, pieces.marker, KEPT)
        kept = torch.ones_like(pieces.marker, dtype=torch.bool)
    else:
        chance = expected_by_chance(
            fit.control, pieces.control_count, *everything, band=config.band_m, near=config.near_m
        )
        reason, kept = _judged(pieces, fit, sigma, chance, reason, config)
    lanes = _table(journey, detection, pieces, fit, sigma, kept, config)
    miss = fit.miss[kept[pieces.piece] & (fit.weight > 0.1)]
    points = int(kept[pieces.piece].sum())
    report = LaneReport(
        reason=reason,
        points=points,
        outliers=points - len(miss),
        rms_m=float(miss.square().mean().sqrt()) if len(miss) else 0.0,
    )
    return lanes.select(kept.nonzero()[:, 0]), report


def _papers_pieces(
    ground: GroundPoints, frame: Int[Tensor, " p"], marker: Int[Tensor, " p"], config: PaperPieces
) -> tuple[LanePieces, LaneFit]:
    """Splines through the most recent points, by plain least squares."""
    point, count = ground.point_world, config.control_points
    pieces = cut_by_number(marker, frame, point, number=config.recent_points, control_points=count)
    pieces = pieces.select(torch.bincount(pieces.piece, minlength=len(pieces)) >= count)
    sigma = torch.full_like(ground.depth, config.sigma_m)
    return pieces, fit_pieces(pieces, point, sigma, smoothing=0.0, scales=())


def _pieces(
    journey: Journey,
    ground: GroundPoints,
    frame: Int[Tensor, " p"],
    marker: Int[Tensor, " p"],
    road: RoadEstimate,
    config: LaneConfig,
) -> tuple[LanePieces, LaneFit]:
    """Splines through pieces of equal length, points weighed by their noise, outliers left out."""
    along = _along(ground, marker)
    by_rhythm = dash_gap(marker, along, config.max_dash_gap_m)
    by_chance = thin_gap(marker, along, config.max_dash_gap_m)
    max_gap = torch.maximum(by_rhythm, by_chance).clamp_min(config.max_gap_m)
    pieces = cut_by_length(
        marker,
        runs_in_plane(marker, along, ground.point_world[:, :2], max_gap),
        along,
        length=config.piece_m,
        overlap=config.overlap,
        control_points=config.control_points,
    )
    sigma = lateral_sigma(
        ground,
        frame,
        road,
        sigma_ideal=config.noise_px / _focal(journey),
        normal_sigma=config.normal_sigma,
        drift=config.drift,
    )
    enough = with_enough_points(
        pieces, most=config.min_points, share=config.usual_points, least=config.least_points
    )
    pieces = pieces.select(enough).as_stiff_as_points(config.points_of_control)
    fit = fit_pieces(
        pieces, ground.point_world, sigma, smoothing=config.smoothing, scales=config.scales
    )
    return pieces, fit


def _along(ground: GroundPoints, marker: Int[Tensor, " p"]) -> Float[Tensor, " p"]:
    """Where points are along their marker [m]: the car's way, or across it for markers that cross the road."""
    if not len(marker):
        return ground.station
    count = int(marker.max()) + 1
    number = torch.bincount(marker, minlength=count).clamp_min(1)

    def spread(value: Tensor) -> Tensor:
        mean = value.new_zeros(count).index_add(0, marker, value) / number
        return value.new_zeros(count).index_add(0, marker, (value - mean[marker]).square())

    crosses = spread(ground.offset) > spread(ground.station)
    return torch.where(crosses[marker], ground.offset, ground.station)


def _control_sigma(
    ground: GroundPoints, pieces: LanePieces, fit: LaneFit, config: LaneConfig
) -> Float[Tensor, " c"]:
    """1-sigma of control points, with what all points of a piece share [m]."""
    offset = group_sum(ground.offset[pieces.point].abs(), pieces.piece, len(pieces))
    offset = offset / torch.bincount(pieces.piece, minlength=len(pieces)).clamp_min(1)
    of_piece = config.sigma_m**2 + (config.height_sigma * offset).square()
    return (fit.sigma.square() + of_piece[spline_basis.rows(pieces.control_count)[0]]).sqrt()


def _judged(
    pieces: LanePieces,
    fit: LaneFit,
    sigma: Float[Tensor, " c"],
    chance: Float[Tensor, " n"],
    reason: Int[Tensor, " count"],
    config: LaneConfig,
) -> tuple[Int[Tensor, " count"], Bool[Tensor, " n"]]:
    """What becomes of every tracklet, and which pieces are kept."""
    count = pieces.control_count
    length = spline_length.arc_length_flat(fit.control, count)
    is_sure = (
        group_sum(sigma, spline_basis.rows(count)[0], len(pieces)) / count < config.max_sigma_m
    )
    is_long = length >= config.min_length_m
    exists = chance < config.by_chance
    kept = is_sure & is_long & exists
    for code, pieces_so in (
        (UNCERTAIN, ~is_sure),
        (CHANCE, is_sure & ~exists),
        (SHORT, is_sure & exists & ~is_long),
        (KEPT, kept),
    ):
        reason = reason.index_fill(0, pieces.marker[pieces_so], code)
    return reason, kept


def _table(
    journey: Journey,
    detection: Int[Tensor, " p"],
    pieces: LanePieces,
    fit: LaneFit,
    sigma: Float[Tensor, " c"],
    kept: Bool[Tensor, " n"],
    config: LaneConfig,
) -> Lanes:
    """The pieces as lanes, with what is known of them; `detection` is that of each point."""
    n, count = len(pieces), pieces.control_count
    frame = journey.lanes.frame[detection[pieces.point]]
    first, last = group_range(frame, pieces.piece, n)
    of_piece, sighting, _ = distinct_pairs(pieces.piece, detection[pieces.point])
    observations = torch.bincount(of_piece, minlength=n)
    share = _agreeing(pieces, fit, kept, config.usual_misses)
    kind = journey.lanes.type[sighting]
    order = _forward(journey, fit.control, count, first, last)
    return Lanes(
        type=group_mode(kind, fit.weight.new_ones(len(kind)), of_piece, n),
        control_start=spline_basis.starts(count),
        control_count=count,
        journey=torch.zeros_like(first),
        tracklet=pieces.marker,
        frame=(first + last) // 2,
        n_journeys=torch.ones_like(first),
        n_observations=observations,
        first_seen_ns=journey.t_ns[first],
        last_seen_ns=journey.t_ns[last],
        confidence=share * (1 - torch.exp(-observations / config.confident_frames)),
        control=ControlPoints(fit.control, sigma)[order],
    )


def _agreeing(
    pieces: LanePieces, fit: LaneFit, kept: Bool[Tensor, " n"], most: float
) -> Float[Tensor, " n"]:
    """Share of each piece's points that miss it by at most so many times what points of the drive's `kept` pieces do."""
    miss = (fit.miss / fit.expected).abs()
    of_kept = miss[kept[pieces.piece]]
    agrees = miss <= most * (of_kept.median() if len(of_kept) else torch.inf)
    number = torch.bincount(pieces.piece, minlength=len(pieces)).clamp_min(1)
    return group_sum(agrees.to(miss), pieces.piece, len(pieces)) / number


def _forward(
    journey: Journey,
    control: Float[Tensor, "c 3"],
    count: Int[Tensor, " n"],
    first: Int[Tensor, " n"],
    last: Int[Tensor, " n"],
) -> Int[Tensor, " c"]:
    """Order of the control points in which every piece runs as the car went."""
    start = spline_basis.starts(count)
    way = control[start + count - 1] - control[start]
    ahead = journey.T_world_camera[first, :3, 2] + journey.T_world_camera[last, :3, 2]
    runs_back = (way * ahead).sum(-1) < 0
    piece, rank = spline_basis.rows(count)
    return start[piece] + torch.where(runs_back[piece], count[piece] - 1 - rank, rank)


def _focal(journey: Journey) -> float:
    K = journey.rig.camera.K
    return (K[0, 0] * K[1, 1]).sqrt().item()
