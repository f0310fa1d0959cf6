"""IV-D: lane tracklets of one journey -> overlapping pieces of markers as natural cubic splines, and what was pruned.

`paper2017` maps every point to the plane under the car in its frame, and fits a spline to the most
recent points again and again. Unlike the paper, `surface` lays the points on the road as the car
drove it, weighs them by how far away they were seen, and cuts a marker into pieces of equal length.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.geometry import spline
from crowdmap_torch.lane_fit import (
    LaneFit,
    LanePieces,
    cut_by_length,
    cut_by_number,
    fit_pieces,
)
from crowdmap_torch.road.placing import (
    PlacedPoints,
    lateral_sigma,
    place_on_planes,
    place_on_surface,
)
from crowdmap_torch.tables import (
    LANE_TYPES,
    ControlPoints,
    Journey,
    Lanes,
    RoadEstimate,
    Tracklets,
)

METHODS = ("surface", "paper2017")
REASONS = ("kept", "too few frames", "no points near enough", "too short", "too uncertain")
"""What becomes of a tracklet, by code."""
KEPT, FEW_FRAMES, NO_POINTS, SHORT, UNCERTAIN = range(len(REASONS))


@dataclass(frozen=True)
class PaperPieces:
    """The pieces of the paper (IV-D)."""

    recent_points: int = 200
    """Points of a piece; a new piece begins after half of them."""
    range_m: tuple[float, float] = (2.0, 45.0)
    """Depth of the points that are used."""


@dataclass(frozen=True)
class LaneConfig:
    """How lane tracklets become splines (IV-D)."""

    method: str = "surface"
    """`surface`: points on the road that the car drove; `paper2017`: points on one plane a frame,
    most recent points."""
    min_frames: int = 4
    """Tracklets with fewer detections are pruned."""
    min_length_m: float = 4.0
    """Pieces that are shorter are pruned."""
    min_points: int = 12
    """Pieces with fewer points are pruned."""
    max_sigma_m: float = 1.0
    """Pieces whose control points are less sure, in the mean, are pruned."""
    range_m: tuple[float, float] = (2.0, 25.0)
    """Depth of the points that are used; method `surface`."""
    piece_m: float = 40.0
    """Length of a piece."""
    overlap: float = 0.5
    """Share of a piece that the next one covers too."""
    control_points: int = 6
    """Of a whole piece; shorter ones have fewer, at the same spacing."""
    max_gap_m: float = 12.0
    """A marker without points over a longer way ends, and begins again behind it: dashes are bridged,
    intersections are not."""
    noise_px: float = 1.0
    """1-sigma of lane points."""
    normal_sigma: float = 1.5e-3
    """1-sigma of the normal's error that changes from frame to frame [rad]."""
    drift: float = 0.01
    """Drift of the car's reckoned way over one metre [m]; with the square root of the way."""
    sigma_m: float = 0.04
    """1-sigma of a piece's lateral error that its points share."""
    height_sigma: float = 0.015
    """1-sigma of the camera height, as a share of it: offsets are off by the same share."""
    smoothing: float = 1e-4
    """Price of bending, in units of a piece's whole weight."""
    scales: tuple[float, ...] = (8.0, 4.0, 2.0, 1.0)
    """Factors on the noise in iterated least squares (Tukey), coarse to fine."""
    confident_frames: float = 4.0
    """Detections that a piece needs for its confidence to reach 1 - 1/e."""
    paper: PaperPieces = field(default_factory=PaperPieces)
    """Method `paper2017`."""

    def __post_init__(self) -> None:
        """Refuses unknown methods and pieces that do not overlap as they should."""
        if self.method not in METHODS:
            raise ValueError(f"method: expected one of {', '.join(METHODS)}, found {self.method!r}")
        if not 0 <= self.overlap < 0.9:
            raise ValueError(f"overlap: expected a share from 0 to below 0.9, found {self.overlap}")
        if self.control_points < 2:
            raise ValueError(f"control_points: expected two or more, found {self.control_points}")


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
    reason = torch.where(frames < config.min_frames, FEW_FRAMES, NO_POINTS)
    is_long = torch.cat((reason == NO_POINTS, torch.zeros_like(reason[:1], dtype=torch.bool)))
    if not len(reason):
        is_long = torch.zeros(1, dtype=torch.bool, device=label.device)
    is_paper = config.method == "paper2017"
    placed = (place_on_planes if is_paper else place_on_surface)(journey, road)
    near, far = config.paper.range_m if is_paper else config.range_m
    detection = journey.lane_points.detection
    used = is_long[label[detection]] & placed.is_placed
    rows = (used & (placed.depth > near) & (placed.depth < far)).nonzero()[:, 0]
    placed, detection = placed[rows], detection[rows]
    frame, marker = journey.lanes.frame[detection], label[detection]
    pieces, fit = (_paper_fit if is_paper else _surface_fit)(
        journey, placed, frame, marker, road, config
    )
    return _table(journey, tracklets, placed, detection, pieces, fit, reason, config)


def _surface_fit(
    journey: Journey,
    placed: PlacedPoints,
    frame: Int[Tensor, " p"],
    marker: Int[Tensor, " p"],
    road: RoadEstimate,
    config: LaneConfig,
) -> tuple[LanePieces, LaneFit]:
    pieces = cut_by_length(
        marker,
        _along(placed, marker),
        max_gap=config.max_gap_m,
        length=config.piece_m,
        overlap=config.overlap,
        control_points=config.control_points,
    )
    pieces = pieces.select(torch.bincount(pieces.piece, minlength=len(pieces)) >= config.min_points)
    sigma = lateral_sigma(
        placed,
        frame,
        road,
        sigma_ideal=config.noise_px / _focal(journey),
        normal_sigma=config.normal_sigma,
        drift=config.drift,
    )
    fit = fit_pieces(
        pieces, placed.point_world, sigma, smoothing=config.smoothing, scales=config.scales
    )
    return pieces, fit


def _paper_fit(
    journey: Journey,
    placed: PlacedPoints,
    frame: Int[Tensor, " p"],
    marker: Int[Tensor, " p"],
    road: RoadEstimate,
    config: LaneConfig,
) -> tuple[LanePieces, LaneFit]:
    pieces = cut_by_number(
        marker,
        frame,
        placed.point_world,
        number=config.paper.recent_points,
        control_points=config.control_points,
    )
    pieces = pieces.select(torch.bincount(pieces.piece, minlength=len(pieces)) >= config.min_points)
    sigma = torch.full_like(placed.depth, 0.2)
    fit = fit_pieces(
        pieces,
        placed.point_world,
        sigma,
        smoothing=config.smoothing,
        scales=config.scales,
        refine=True,
    )
    return pieces, fit


def _along(placed: PlacedPoints, marker: Int[Tensor, " p"]) -> Float[Tensor, " p"]:
    """Where points are along their marker [m]: the car's way, or across it for markers that cross the road."""
    if not len(marker):
        return placed.station
    count = int(marker.max()) + 1
    number = torch.bincount(marker, minlength=count).clamp_min(1)

    def spread(value: Tensor) -> Tensor:
        mean = value.new_zeros(count).index_add(0, marker, value) / number
        return value.new_zeros(count).index_add(0, marker, (value - mean[marker]).square())

    crosses = spread(placed.offset) > spread(placed.station)
    return torch.where(crosses[marker], placed.offset, placed.station)


def _table(
    journey: Journey,
    tracklets: Tracklets,
    placed: PlacedPoints,
    detection: Int[Tensor, " p"],
    pieces: LanePieces,
    fit: LaneFit,
    reason: Int[Tensor, " count"],
    config: LaneConfig,
) -> tuple[Lanes, LaneReport]:
    n = len(pieces)
    count = pieces.control_count
    piece_of_control, _ = spline.rows(count)
    offset = _offset_of_control(placed, pieces, piece_of_control)
    shared = config.sigma_m**2 + (config.height_sigma * offset).square()
    sigma = (fit.sigma.square() + shared).sqrt()
    length = spline.arc_length_flat(fit.control, count)
    mean_sigma = sigma.new_zeros(n).index_add(0, piece_of_control, sigma) / count
    is_sure = mean_sigma < config.max_sigma_m
    kept = is_sure & (length >= config.min_length_m)
    for code, pieces_so in (
        (UNCERTAIN, ~is_sure),
        (SHORT, is_sure & (length < config.min_length_m)),
        (KEPT, kept),
    ):
        reason = reason.index_fill(0, pieces.marker[pieces_so], code)

    frame = journey.lanes.frame[detection[pieces.point]]
    first = _reduced(frame, pieces.piece, n, "amin")
    last = _reduced(frame, pieces.piece, n, "amax")
    sightings = torch.unique(pieces.piece * (len(journey.lanes) + 1) + detection[pieces.point])
    sighting_piece = sightings // (len(journey.lanes) + 1)
    sighting = sightings % (len(journey.lanes) + 1)
    observations = torch.bincount(sighting_piece, minlength=n)
    inliers = fit.weight.new_zeros(n).index_add(0, pieces.piece, (fit.weight > 0.1).to(fit.weight))
    share = inliers / torch.bincount(pieces.piece, minlength=n).clamp_min(1)
    one = torch.ones_like(first)
    table = Lanes(
        type=_voted(journey.lanes.type[sighting], sighting_piece, n),
        control_start=spline.starts(count),
        control_count=count,
        journey=torch.zeros_like(first),
        tracklet=pieces.marker,
        frame=(first + last) // 2,
        n_journeys=one,
        n_observations=observations,
        first_seen_ns=journey.t_ns[first],
        last_seen_ns=journey.t_ns[last],
        confidence=share * (1 - torch.exp(-observations / config.confident_frames)),
        control=ControlPoints(fit.control, sigma)[
            _forward(journey, fit.control, count, first, last)
        ],
    )
    miss = fit.miss[kept[pieces.piece] & (fit.weight > 0.1)]
    points = int(kept[pieces.piece].sum())
    report = LaneReport(
        reason=reason,
        points=points,
        outliers=points - len(miss),
        rms_m=float(miss.square().mean().sqrt()) if len(miss) else 0.0,
    )
    return table.select(kept.nonzero()[:, 0]), report


def _forward(
    journey: Journey,
    control: Float[Tensor, "c 3"],
    count: Int[Tensor, " n"],
    first: Int[Tensor, " n"],
    last: Int[Tensor, " n"],
) -> Int[Tensor, " c"]:
    """Order of the control points in which every piece runs as the car went."""
    start = spline.starts(count)
    way = control[start + count - 1] - control[start]
    ahead = journey.T_world_camera[first, :3, 2] + journey.T_world_camera[last, :3, 2]
    runs_back = (way * ahead).sum(-1) < 0
    piece, rank = spline.rows(count)
    return start[piece] + torch.where(runs_back[piece], count[piece] - 1 - rank, rank)


def _offset_of_control(
    placed: PlacedPoints, pieces: LanePieces, piece_of_control: Int[Tensor, " c"]
) -> Float[Tensor, " c"]:
    """Mean distance of the points of each control point's piece from the car's way [m]."""
    n = len(pieces)
    offset = placed.offset[pieces.point].abs()
    total = offset.new_zeros(n).index_add(0, pieces.piece, offset)
    return (total / torch.bincount(pieces.piece, minlength=n).clamp_min(1))[piece_of_control]


def _voted(kind: Int[Tensor, " v"], piece: Int[Tensor, " v"], n: int) -> Int[Tensor, " n"]:
    """The type that most of a piece's detections have; -1 where none has one."""
    kinds, known = len(LANE_TYPES), kind >= 0
    votes = torch.bincount(piece[known] * kinds + kind[known], minlength=n * kinds)
    votes = votes.reshape(n, kinds)
    return torch.where(votes.sum(-1) > 0, votes.argmax(-1), -1)


def _reduced(value: Int[Tensor, " r"], group: Int[Tensor, " r"], n: int, how: str) -> Tensor:
    return value.new_zeros(n).scatter_reduce(0, group, value, how, include_self=False)


def _focal(journey: Journey) -> float:
    K = journey.rig.camera.K
    return (K[0, 0] * K[1, 1]).sqrt().item()
