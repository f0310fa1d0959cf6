"""IV-B: sign tracklets of one journey -> signs in the world, and why the other tracklets were pruned."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_argmin, group_mode, group_sum
from crowdmap_torch.geometry import camera, polygon, se3
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.noise.white_noise import with_white_noise
from crowdmap_torch.optim.robust import usual
from crowdmap_torch.ranges import (
    Count,
    Degrees,
    Deviations,
    Factor,
    Length,
    Settings,
    Share,
    Sigma,
    Span,
)
from crowdmap_torch.residuals.sign_prior import against_the_drive
from crowdmap_torch.road.nonholonomic import DrivePath, drive_path
from crowdmap_torch.signs.fit import SignFitConfig, fit_signs
from crowdmap_torch.signs.fit_alone import center_axis_size, fit_signs_alone, mid_points
from crowdmap_torch.signs.initialize import (
    SignStartConfig,
    choose_starts_again,
    choose_starts_of_drive,
)
from crowdmap_torch.signs.merge_tracks import RejoinConfig, rejoin, relabelled
from crowdmap_torch.signs.views import SignFit, SignStart, SignViews, distance_away
from crowdmap_torch.tables import Journey, Signs, Tracklets

METHODS = ("joint", "paper2017")
REASONS = (
    "kept",
    "too few frames",
    "too little parallax",
    "too far away",
    "behind the camera",
    "residual too large",
    "position too uncertain",
    "implausible size",
    "rejoined with another tracklet",
)
"""What becomes of a tracklet, by code."""
KEPT, FEW_FRAMES, NO_PARALLAX, TOO_FAR, BEHIND, RESIDUAL, UNCERTAIN, SIZE, REJOINED = range(9)
_VIEWS_BESIDE = 20.0
"""Views in long tracklets that count beside those of a drive: a few short runs may be all that a drive without signs has."""


@dataclass(frozen=True)
class SignTriangulationConfig(Settings):
    """How tracklets become signs, and which do not (IV-B)."""

    method: str = "joint"
    """`joint`: all signs and the drift of the poses as one problem, several starts, fragments rejoined. `paper2017`: each
    sign by itself (`signs.fit_alone`), kept where its views see it from different enough angles."""
    min_frames: Count = 3
    """Tracklets with fewer detections of the tracklet's shape are pruned."""
    min_parallax_alone_deg: Degrees = 10.0
    """`paper2017`: tracklets whose rays differ by less are pruned; what drifts between the views moves signs fitted one by
    one the further the less they differ."""
    min_parallax_deg: Degrees = 0.7
    """`joint`, as all that follows: tracklets whose rays differ by less are pruned."""
    max_distance_m: Length = 80.0
    """Tracklets whose closest view is further away are pruned."""
    max_noise_scale: Deviations = 3.9
    """Tracklets whose views are noisier, as a multiple of the noise expected, or of that of the drive, are pruned."""
    min_inlier_share: Share = 0.5
    """Tracklets of whose views fewer agree with the sign are pruned."""
    max_sigma_m: Sigma = 1.5
    """Tracklets whose centre has a larger standard deviation in any direction are pruned."""
    doubtful_frames: Count = 10
    """Tracklets with fewer views in agreement must be better placed than others, unless a drive's signs are seen hardly any
    longer: false detections come in short runs."""
    max_doubtful_sigma_m: Sigma = 0.5
    """Largest standard deviation of those; others are none of this journey's, and of the map where two journeys show one."""
    size_m: Span = (0.1, 16.5)
    """Of both methods: smallest and largest plausible width and height. A board above four lanes of 3.75 m is 15 m wide, and
    what is found of it may be a tenth more."""
    min_side_m: Length = 0.25
    """Smallest plausible larger side: false detections that slide through the image of a creeping car look like tiny
    plates before the lens."""
    confident_frames: Factor = 4.0
    """Views in agreement, weighted by their scores, at which the confidence reaches 1 - 1/e."""
    start: SignStartConfig = field(default_factory=SignStartConfig)
    """Where the fits begin."""
    rejoin: RejoinConfig = field(default_factory=RejoinConfig)
    """When tracklets are put together again after a gap."""
    fit: SignFitConfig = field(default_factory=SignFitConfig)
    """The minimisation."""

    def __post_init__(self) -> None:
        """Refuses an unknown method."""
        super().__post_init__()
        if self.method not in METHODS:
            raise ValueError(f"method: expected one of {METHODS}, found {self.method!r}")


@dataclass(frozen=True)
class SignReport:
    """What became of the tracklets of one journey."""

    reason: Int[Tensor, " count"]
    """Index into `REASONS` of every tracklet."""
    tracklets: Tracklets
    """As given, but rejoined tracklets share the label of one of them, and the shifts are those to the signs' corners."""
    error_sq: Float[Tensor, " d"]
    """Mean square whitened error of every detection that was used; NaN for the others."""
    doubtful: Signs
    """Those pruned for few views and no better place: they count where other journeys show them too."""

    @property
    def pruned(self) -> dict[str, int]:
        """How many tracklets met each fate, those kept included."""
        counts = torch.bincount(self.reason, minlength=len(REASONS)).tolist()
        return dict(zip(REASONS, counts, strict=True))


@torch.no_grad()
def triangulate_signs(
    journey: Journey,
    tracklets: Tracklets,
    positioning: PositioningNoise,
    config: SignTriangulationConfig,
) -> tuple[Signs, SignReport]:
    """The signs that a journey's tracklets show (the paper's O1), and what was pruned.

    Unlike the paper, the minimisation knows the poses' noise and drift (`signs.fit`), starts from several planes, and
    tracklets of one sign are put together again where geometry agrees.
    """
    shape = shape_by_vote(journey, tracklets)
    rows = usable_rows(journey, tracklets, shape)
    frames = torch.bincount(tracklets.label[rows], minlength=tracklets.count)
    reason = torch.where(frames < config.min_frames, FEW_FRAMES, KEPT)
    rows = rows[reason[tracklets.label[rows]] == KEPT]
    if not len(rows):
        none = _no_signs(journey)
        return none, SignReport(reason, tracklets, _per_detection(journey), none)
    positioning = with_white_noise(positioning, journey)
    label, sign = tracklets.label[rows].unique(return_inverse=True)
    seen = _Seen(tracklets, label, rows, views_of(journey, tracklets, rows, sign))
    drive = drive_path(journey, positioning, config.fit.nonholonomic, config.fit.drift)
    is_alone = config.method == "paper2017"
    fit_method = _fit_alone if is_alone else _fit_jointly
    fitted = fit_method(journey, seen, shape, drive, positioning, config)
    seen, fit, label, views = fitted.seen, fitted.fit, fitted.seen.label, fitted.seen.views
    reason[fitted.rejoined] = REJOINED
    if is_alone:
        fate, doubtful = _fates_alone(views, fit, config), torch.zeros_like(label, dtype=torch.bool)
    else:
        fate, doubtful = _fates(views, fit, fitted.noise_scale, config)
    reason[label] = fate
    signs, turn = _signs(journey, seen.rows, views, fit, shape[label], label, config)
    error_sq = _per_detection(journey).index_put((seen.rows,), fit.error_sq)
    tracklets = _turned(journey, seen.tracklets, shape, label, turn)
    return signs[fate == KEPT], SignReport(reason, tracklets, error_sq, signs[doubtful])


@dataclass(frozen=True)
class _Seen:
    """Tracklets, and the views of the sign that each of them shows."""

    tracklets: Tracklets
    label: Int[Tensor, " n"]
    """Tracklet of each sign."""
    rows: Int[Tensor, " m"]
    """Detection of each view."""
    views: SignViews


@dataclass(frozen=True)
class _Fitted:
    """Signs fitted to what was seen of them."""

    seen: _Seen
    """As given, or with some tracklets put together."""
    rejoined: Int[Tensor, " k"]
    """Labels that were given up for those of others."""
    fit: SignFit
    noise_scale: Float[Tensor, " n"]
    """By how much the noise of each sign's views exceeds what is usual."""


def _fit_jointly(
    journey: Journey,
    seen: _Seen,
    shape: Int[Tensor, " count"],
    drive: DrivePath,
    positioning: PositioningNoise,
    config: SignTriangulationConfig,
) -> _Fitted:
    label, rows, views = seen.label, seen.rows, seen.views
    limits = config.size_m
    start, scale, of_drive = choose_starts_of_drive(
        views, shape[label], positioning, config.start, config.fit, size_limits=limits
    )
    config = replace(config, fit=of_drive)
    fit = _fit(views, shape[label], start, scale, drive, positioning, config)

    t_s = (journey.t_ns - journey.t_ns[0]).to(fit.size) * 1e-9
    group = rejoin(views, t_s[views.frame], fit, shape[label], positioning, config.rejoin)
    joined = group != torch.arange(len(label), device=group.device)
    given_up = label[joined]
    if bool(joined.any()):
        tracklets = replace(seen.tracklets, label=relabelled(seen.tracklets, journey, label, group))
        # Second detections of a frame stay with the tracklet that is given up.
        still = tracklets.label[rows] == label[group][views.sign]
        rows, views = rows[still], views[still]
        label, new_row = label[~joined], (~joined).cumsum(0) - 1
        views = replace(views, sign=new_row[group][views.sign])
        again = torch.zeros_like(label, dtype=torch.bool).index_fill(
            0, new_row[group[joined]], True
        )
        before = SignStart(start.T_world_sign[~joined], start.size[~joined])
        start, scale = choose_starts_again(
            *(views, again, shape[label], before, scale[~joined]),
            *(positioning, config.start, config.fit),
            size_limits=limits,
        )
        fit = _fit(views, shape[label], start, scale, drive, positioning, config)
        seen = _Seen(tracklets, label, rows, views)
    return _Fitted(seen, given_up, fit, scale)


def _fit_alone(
    journey: Journey,
    seen: _Seen,
    shape: Int[Tensor, " count"],
    drive: DrivePath,
    positioning: PositioningNoise,
    config: SignTriangulationConfig,
) -> _Fitted:
    label, views = seen.label, seen.views
    start = center_axis_size(mid_points(views, len(label)), shape[label], views)
    fit = fit_signs_alone(views, shape[label], start, drive, config.fit)
    return _Fitted(seen, label[:0], fit, torch.ones_like(fit.size[:, 0]))


def shape_by_vote(journey: Journey, tracklets: Tracklets) -> Int[Tensor, " count"]:
    """The shape that most detections of each tracklet have."""
    ones = torch.ones_like(journey.signs.score)
    return group_mode(journey.signs.shape, ones, tracklets.label, tracklets.count)


def usable_rows(
    journey: Journey, tracklets: Tracklets, shape: Int[Tensor, " count"]
) -> Int[Tensor, " m"]:
    """Rows of the detections that have a tracklet and its shape."""
    if not tracklets.count:
        return tracklets.label[:0]
    label = tracklets.label
    good = (label >= 0) & (journey.signs.shape == shape[label.clamp_min(0)])
    return good.nonzero()[:, 0]


def views_of(
    journey: Journey, tracklets: Tracklets, rows: Int[Tensor, " m"], sign: Int[Tensor, " m"]
) -> SignViews:
    """The views that detections `rows` are of signs `sign`."""
    detections = journey.signs[rows]
    count = polygon.corner_count(detections.shape)
    assert tracklets.shift is not None, "sign tracklets come with corner shifts"
    shift = tracklets.shift[rows]
    px = polygon.roll(detections.corners_px, shift, count)
    ideal = polygon.roll(detections.corners_ideal, shift, count)
    return SignViews(
        sign=sign,
        frame=detections.frame,
        corners_px=px,
        corners_ideal=ideal,
        observation=camera.observation_matrix(journey.rig.camera, px, ideal),
        T_world_camera=journey.T_world_camera[detections.frame],
    )


def _fit(
    views: SignViews,
    shape: Int[Tensor, " n"],
    start: SignStart,
    scale: Float[Tensor, " n"],
    drive: DrivePath,
    positioning: PositioningNoise,
    config: SignTriangulationConfig,
) -> SignFit:
    facing = against_the_drive(views.T_world_camera, views.sign, len(shape))
    return fit_signs(views, shape, start, facing, scale, drive, positioning, config.fit)


def _fates(
    views: SignViews, fit: SignFit, scale: Float[Tensor, " n"], config: SignTriangulationConfig
) -> tuple[Int[Tensor, " n"], Bool[Tensor, " n"]]:
    """Whether each sign is kept, or why it is pruned, the first reason; and which are for having few views alone."""
    n = len(scale)
    away = distance_away(views, fit)
    agrees = (fit.error_sq < config.fit.tukey**2).to(scale)
    number = group_sum(torch.ones_like(agrees), views.sign, n)
    sigma = torch.linalg.eigvalsh(fit.covariance)[:, -1].clamp_min(0).sqrt()
    agreeing = group_sum(agrees, views.sign, n)
    low, high = config.size_m
    tests = (
        (BEHIND, _is_behind(views, fit)),
        (NO_PARALLAX, _parallax(views, fit, agrees > 0) < math.radians(config.min_parallax_deg)),
        (TOO_FAR, away[group_argmin(away, views.sign)] > config.max_distance_m),
        (SIZE, ((fit.size < low) | (fit.size > high)).any(-1)),
        (SIZE, fit.size.amax(-1) < config.min_side_m),
        (FEW_FRAMES, agreeing < config.min_frames),
        (RESIDUAL, agreeing < config.min_inlier_share * number),
        (RESIDUAL, scale > config.max_noise_scale),
        (UNCERTAIN, ~(sigma < config.max_sigma_m)),
    )
    fate = _first_reason(tests)
    few = agreeing < _least_views(agreeing[fate == KEPT], config.doubtful_frames)
    doubtful = (fate == KEPT) & few & ~(sigma < config.max_doubtful_sigma_m)
    return fate.masked_fill(doubtful, UNCERTAIN), doubtful


def _least_views(number: Float[Tensor, " n"], most: int) -> float:
    """So many views make a tracklet of a drive with such numbers no run of false detections, and `most` do anyway.

    Half of those that half of its views come with: a slow camera, or one of few pixels, shows each sign a few times.
    """
    return min(most, usual(number, number, assumed=2.0 * most, beside=_VIEWS_BESIDE) / 2)


def _fates_alone(
    views: SignViews, fit: SignFit, config: SignTriangulationConfig
) -> Int[Tensor, " n"]:
    """As `_fates`, by the angles that signs are seen at, and of what can be no sign."""
    every = torch.ones_like(views.sign, dtype=torch.bool)
    narrow = _parallax(views, fit, every) < math.radians(config.min_parallax_alone_deg)
    low, high = config.size_m
    no_sign = ((fit.size < low) | (fit.size > high)).any(-1)
    return _first_reason(((BEHIND, _is_behind(views, fit)), (NO_PARALLAX, narrow), (SIZE, no_sign)))


def _first_reason(tests: Sequence[tuple[int, Bool[Tensor, " n"]]]) -> Int[Tensor, " n"]:
    """The code of the first test that each sign fails."""
    fate = torch.full_like(tests[0][1], KEPT, dtype=torch.int64)
    for code, fails in tests:
        fate = torch.where((fate == KEPT) & fails, code, fate)
    return fate


def _is_behind(views: SignViews, fit: SignFit) -> Bool[Tensor, " n"]:
    """True for signs that are behind one of the cameras that saw them, or nowhere."""
    centre = fit.T_world_sign[views.sign, :3, 3]
    in_camera = se3.transform(se3.inverse(views.T_world_camera), centre)
    is_behind = ~(in_camera[:, 2] > 0)
    return group_sum(is_behind.to(fit.size), views.sign, len(fit.size)) > 0


def _parallax(views: SignViews, fit: SignFit, counts: Bool[Tensor, " m"]) -> Float[Tensor, " n"]:
    """Largest angle between the closest view's ray to a sign and the rays of the views that count [rad]."""
    towards = views.p_world_camera - fit.T_world_sign[views.sign, :3, 3]
    ray = torch.nn.functional.normalize(towards, dim=-1)
    closest = group_argmin(towards.norm(dim=-1), views.sign)
    across = torch.linalg.cross(ray, ray[closest][views.sign]).norm(dim=-1)
    angle = torch.atan2(across, (ray * ray[closest][views.sign]).sum(-1))
    angle = torch.where(counts, angle, torch.zeros_like(angle))
    return torch.zeros_like(fit.size[:, 0]).scatter_reduce(0, views.sign, angle, "amax")


def _signs(
    journey: Journey,
    rows: Int[Tensor, " m"],
    views: SignViews,
    fit: SignFit,
    shape: Int[Tensor, " n"],
    label: Int[Tensor, " n"],
    config: SignTriangulationConfig,
) -> tuple[Signs, Int[Tensor, " n"]]:
    """The table of all fitted signs, and by how much their corners were turned to start at the top left."""
    n = len(shape)
    T, size, turn = polygon.canonical_with_shift(fit.T_world_sign, fit.size, shape)
    away = distance_away(views, fit)
    agrees = fit.error_sq < config.fit.tukey**2
    detections = journey.signs[rows]
    score = torch.where(detections.score.isnan(), torch.ones_like(away), detections.score)
    evidence = group_sum(score * agrees, views.sign, n)
    t_ns = journey.t_ns[views.frame]
    first = torch.full((n,), torch.iinfo(torch.int64).max, device=shape.device)
    last = torch.full((n,), torch.iinfo(torch.int64).min, device=shape.device)
    none = torch.full((n,), -1, device=shape.device)
    signs = Signs(
        shape=shape,
        type=group_mode(detections.type, torch.ones_like(score), views.sign, n),
        T_world_sign=T,
        size=size,
        covariance=fit.covariance,
        journey=none,
        tracklet=label,
        frame=fit.frame,
        n_journeys=torch.ones_like(label),
        n_observations=group_sum(agrees.long(), views.sign, n),
        first_seen_ns=first.scatter_reduce(0, views.sign, t_ns, "amin"),
        last_seen_ns=last.scatter_reduce(0, views.sign, t_ns, "amax"),
        confidence=1 - torch.exp(-evidence / config.confident_frames),
    )
    return signs, turn


def _turned(
    journey: Journey,
    tracklets: Tracklets,
    shape: Int[Tensor, " count"],
    label: Int[Tensor, " n"],
    turn: Int[Tensor, " n"],
) -> Tracklets:
    """The tracklets with shifts to the corners of the signs, which start at the top left."""
    turn_of = torch.zeros_like(shape).index_put((label,), turn)
    assert tracklets.shift is not None
    at = tracklets.label.clamp_min(0)
    same = (tracklets.label >= 0) & (journey.signs.shape == shape[at])
    count = polygon.corner_count(journey.signs.shape)
    shift = torch.where(same, (tracklets.shift + turn_of[at]) % count, tracklets.shift)
    return replace(tracklets, shift=shift)


def _per_detection(journey: Journey) -> Float[Tensor, " d"]:
    return torch.full_like(journey.signs.score, torch.nan)


def _no_signs(journey: Journey) -> Signs:
    none = journey.signs.row[:0]
    like = journey.T_world_camera
    return Signs(
        shape=none,
        type=none,
        T_world_sign=like[:0],
        size=like.new_zeros(0, 2),
        covariance=like.new_zeros(0, 3, 3),
        journey=none,
        tracklet=none,
        frame=none,
        n_journeys=none,
        n_observations=none,
        first_seen_ns=none,
        last_seen_ns=none,
        confidence=like.new_zeros(0),
    )
