"""IV-B: sign tracklets of one journey -> signs in the world, and why the other tracklets were pruned."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_mode, group_sum
from crowdmap_torch.drift_course import DrivePath, drive_path
from crowdmap_torch.geometry import camera, polygon, se3
from crowdmap_torch.pose_drift import closest_view
from crowdmap_torch.sign_fit import (
    SignFit,
    SignFitConfig,
    SignStart,
    SignViews,
    distance_away,
    fit_signs,
    fit_signs_alone,
    fit_signs_coarsely,
    robust_noise_scale,
)
from crowdmap_torch.sign_habit import against_the_drive
from crowdmap_torch.sign_rejoin import RejoinConfig, rejoin, relabelled
from crowdmap_torch.sign_start import centre_points, starts
from crowdmap_torch.tables import Journey, Signs, Tracklets, concatenate

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


@dataclass(frozen=True)
class SignTriangulationConfig:
    """How tracklets become signs, and which do not (IV-B)."""

    method: str = "joint"
    """`joint`: all signs and the drift of the poses as one problem, several starts, fragments rejoined. `paper2017`: each
    sign by itself from its best plane, poses taken as they are."""
    min_frames: int = 3
    """Tracklets with fewer detections of the tracklet's shape are pruned."""
    min_parallax_deg: float = 0.7
    """`joint`: tracklets whose rays differ by less are pruned."""
    min_parallax_alone_deg: float = 10.0
    """`paper2017`: the same of signs fitted one by one, which what drifts between the views moves the further the less their
    rays differ."""
    max_distance_m: float = 80.0
    """Tracklets whose closest view is further away are pruned."""
    max_noise_scale: float = 3.9
    """`joint`: tracklets whose views are noisier, as a multiple of the noise expected, are pruned."""
    min_inlier_share: float = 0.5
    """Tracklets of whose views fewer agree with the sign are pruned."""
    max_sigma_m: float = 1.5
    """Tracklets whose centre has a larger standard deviation in any direction are pruned."""
    doubtful_frames: int = 10
    """Tracklets with fewer views in agreement must be better placed than others: false detections come in short runs."""
    max_doubtful_sigma_m: float = 0.5
    """Largest standard deviation of those."""
    size_m: tuple[float, float] = (0.1, 8.0)
    """Smallest and largest plausible width and height."""
    min_side_m: float = 0.25
    """Smallest plausible larger side: false detections that slide through the image of a creeping car look like tiny
    plates before the lens."""
    confident_frames: float = 4.0
    """Views in agreement, weighted by their scores, at which the confidence reaches 1 - 1/e."""
    start_yaw_deg: tuple[float, ...] = (-30.0, 30.0)
    """`joint`: angles from the line of sight to start from, beside the best plane."""
    start_views: int = 16
    """`joint`: views of each sign that the starts are compared on."""
    rejoin: RejoinConfig = field(default_factory=RejoinConfig)
    """`joint`: when tracklets are put together again after a gap."""
    fit: SignFitConfig = field(default_factory=SignFitConfig)
    """The minimisation."""

    def __post_init__(self) -> None:
        """Refuses an unknown method."""
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

    @property
    def pruned(self) -> dict[str, int]:
        """How many tracklets met each fate, those kept included."""
        counts = torch.bincount(self.reason, minlength=len(REASONS)).tolist()
        return dict(zip(REASONS, counts, strict=True))


@torch.no_grad()
def triangulate_signs(
    journey: Journey, tracklets: Tracklets, config: SignTriangulationConfig
) -> tuple[Signs, SignReport]:
    """The signs that a journey's tracklets show (the paper's O1), and what was pruned.

    Unlike the paper, the minimisation knows the poses' noise and drift (`sign_fit`), starts from several planes, and
    tracklets of one sign are put together again where geometry agrees.
    """
    shape = _shape_by_vote(journey, tracklets)
    rows = _usable_rows(journey, tracklets, shape)
    frames = torch.bincount(tracklets.label[rows], minlength=tracklets.count)
    reason = torch.where(frames < config.min_frames, FEW_FRAMES, KEPT)
    rows = rows[reason[tracklets.label[rows]] == KEPT]
    if not len(rows):
        return _no_signs(journey), SignReport(reason, tracklets, _per_detection(journey))
    fit_method = _fit_alone if config.method == "paper2017" else _fit_jointly
    fitted = fit_method(journey, tracklets, shape, rows, config)
    label, views, fit = fitted.label, fitted.views, fitted.fit
    reason[fitted.rejoined] = REJOINED
    fate = _fates(views, fit, fitted.noise_scale, config)
    reason[label] = fate
    kept = fate == KEPT
    signs, turn = _signs(journey, fitted.rows, views, fit, shape[label], label, config)
    error_sq = _per_detection(journey).index_put((fitted.rows,), fit.error_sq)
    tracklets = _turned(journey, fitted.tracklets, shape, label, turn)
    return signs[kept], SignReport(reason, tracklets, error_sq)


@dataclass(frozen=True)
class _Fitted:
    """Tracklets with the signs fitted to them."""

    tracklets: Tracklets
    """As given, or with some of them put together."""
    rejoined: Int[Tensor, " k"]
    """Labels that were given up for those of others."""
    label: Int[Tensor, " n"]
    """Tracklet of each sign."""
    rows: Int[Tensor, " m"]
    """Detection of each view."""
    views: SignViews
    fit: SignFit
    noise_scale: Float[Tensor, " n"]
    """By how much the noise of each sign's views exceeds what is usual."""


def _fit_jointly(
    journey: Journey,
    tracklets: Tracklets,
    shape: Int[Tensor, " count"],
    rows: Int[Tensor, " m"],
    config: SignTriangulationConfig,
) -> _Fitted:
    label, sign = tracklets.label[rows].unique(return_inverse=True)
    views = _views(journey, tracklets, rows, sign)
    drive = drive_path(journey, config.fit.course, config.fit.drift)
    start, scale = _begin(views, shape[label], config)
    fit = _fit(views, shape[label], start, scale, drive, config)

    t_s = (journey.t_ns - journey.t_ns[0]).to(fit.size) * 1e-9
    group = rejoin(views, t_s[views.frame], fit, shape[label], config.rejoin)
    joined = group != torch.arange(len(label), device=group.device)
    given_up = label[joined]
    if bool(joined.any()):
        tracklets = replace(tracklets, label=relabelled(tracklets, journey, label, group))
        # Second detections of a frame stay with the tracklet that is given up.
        still = tracklets.label[rows] == label[group][views.sign]
        rows, views = rows[still], views[still]
        label, new_row = label[~joined], (~joined).cumsum(0) - 1
        views = replace(views, sign=new_row[group][views.sign])
        again = torch.zeros_like(label, dtype=torch.bool).index_fill(
            0, new_row[group[joined]], True
        )
        start, scale = _begin_again(views, again, shape[label], start, scale, ~joined, config)
        fit = _fit(views, shape[label], start, scale, drive, config)
    return _Fitted(tracklets, given_up, label, rows, views, fit, scale)


def _fit_alone(
    journey: Journey,
    tracklets: Tracklets,
    shape: Int[Tensor, " count"],
    rows: Int[Tensor, " m"],
    config: SignTriangulationConfig,
) -> _Fitted:
    label, sign = tracklets.label[rows].unique(return_inverse=True)
    views = _views(journey, tracklets, rows, sign)
    drive = drive_path(journey, config.fit.course, config.fit.drift)
    centre = centre_points(views, len(label), typical_height_m=config.fit.habit.typical_size_m)
    # The last is the best plane through the mid-points of the corners, or an upright sign where they have none.
    best = starts(views, shape[label], centre, yaws=(0.0,), size_limits=config.size_m)[-1]
    facing = against_the_drive(views.T_world_camera, views.sign, len(label))
    fit = fit_signs_alone(views, shape[label], best, facing, drive, config.fit)
    usual = torch.ones_like(fit.size[:, 0])
    return _Fitted(tracklets, label[:0], label, rows, views, fit, usual)


def _shape_by_vote(journey: Journey, tracklets: Tracklets) -> Int[Tensor, " count"]:
    """The shape that most detections of each tracklet have."""
    ones = torch.ones_like(journey.signs.score)
    return group_mode(journey.signs.shape, ones, tracklets.label, tracklets.count)


def _usable_rows(
    journey: Journey, tracklets: Tracklets, shape: Int[Tensor, " count"]
) -> Int[Tensor, " m"]:
    """Rows of the detections that have a tracklet and its shape."""
    if not tracklets.count:
        return tracklets.label[:0]
    label = tracklets.label
    good = (label >= 0) & (journey.signs.shape == shape[label.clamp_min(0)])
    return good.nonzero()[:, 0]


def _views(
    journey: Journey,
    tracklets: Tracklets,
    rows: Int[Tensor, " m"],
    sign: Int[Tensor, " m"],
) -> SignViews:
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


def _begin(
    views: SignViews, shape: Int[Tensor, " n"], config: SignTriangulationConfig
) -> tuple[SignStart, Float[Tensor, " n"]]:
    """Signs fitted one by one from several starts, of each the best; and their noise scales."""
    n = len(shape)
    few = views[_thinned(views, config.start_views)]
    m = len(few)
    centre = centre_points(few, n, typical_height_m=config.fit.habit.typical_size_m)
    facing = against_the_drive(few.T_world_camera, few.sign, n)
    yaws = tuple(math.radians(yaw) for yaw in config.start_yaw_deg)
    begin = starts(few, shape, centre, yaws=yaws, size_limits=config.size_m)
    k = len(begin)
    coarse = fit_signs_coarsely(
        concatenate([replace(few, sign=few.sign + i * n) for i in range(k)]),
        shape.repeat(k),
        SignStart(torch.cat([s.T_world_sign for s in begin]), torch.cat([s.size for s in begin])),
        facing.repeat(k, 1),
        config.fit,
    )
    cost = torch.where(coarse.cost.isfinite(), coarse.cost, torch.inf).reshape(k, n)
    choice = cost.argmin(0)
    best = choice * n + torch.arange(n, device=shape.device)
    view = choice[few.sign] * m + torch.arange(m, device=shape.device)
    most = config.fit.max_noise_scale
    scale = robust_noise_scale(coarse.error_sq[view], few.sign, n, most)
    return SignStart(coarse.start.T_world_sign[best], coarse.start.size[best]), scale


def _begin_again(
    views: SignViews,
    again: Bool[Tensor, " n"],
    shape: Int[Tensor, " n"],
    start: SignStart,
    scale: Float[Tensor, " before"],
    kept: Bool[Tensor, " before"],
    config: SignTriangulationConfig,
) -> tuple[SignStart, Float[Tensor, " n"]]:
    """The beginnings of the signs `kept`, those of the signs `again` anew."""
    mine = views[again[views.sign]]
    sign, compact = mine.sign.unique(return_inverse=True)
    new, new_scale = _begin(replace(mine, sign=compact), shape[sign], config)
    T, size = start.T_world_sign[kept], start.size[kept]
    merged = SignStart(T.index_put((sign,), new.T_world_sign), size.index_put((sign,), new.size))
    return merged, scale[kept].index_put((sign,), new_scale)


def _fit(
    views: SignViews,
    shape: Int[Tensor, " n"],
    start: SignStart,
    scale: Float[Tensor, " n"],
    drive: DrivePath,
    config: SignTriangulationConfig,
) -> SignFit:
    facing = against_the_drive(views.T_world_camera, views.sign, len(shape))
    return fit_signs(views, shape, start, facing, scale, drive, config.fit)


def _thinned(views: SignViews, most: int) -> Bool[Tensor, " m"]:
    """About `most` views of each sign, spread evenly over its frames, the last one among them."""
    order = torch.argsort(views.frame, stable=True)
    order = order[torch.argsort(views.sign[order], stable=True)]
    count = torch.bincount(views.sign)
    first = (count.cumsum(0) - count)[views.sign[order]]
    rank = torch.arange(len(order), device=order.device) - first
    share = rank * most // count[views.sign[order]].clamp_min(most)
    last = torch.ones_like(share, dtype=torch.bool)
    last[:-1] = (share[1:] != share[:-1]) | (rank[1:] == 0)
    return torch.zeros_like(last).index_put((order,), last)


def _fates(
    views: SignViews,
    fit: SignFit,
    scale: Float[Tensor, " n"],
    config: SignTriangulationConfig,
) -> Int[Tensor, " n"]:
    """Whether each sign is kept, or why it is pruned; the first reason counts."""
    n = len(scale)
    away = distance_away(views, fit)
    in_camera = se3.transform(
        se3.inverse(views.T_world_camera), fit.T_world_sign[views.sign, :3, 3]
    )
    is_behind = (in_camera[:, 2] <= 0).to(scale)
    agrees = (fit.error_sq < config.fit.tukey**2).to(scale)
    number = group_sum(torch.ones_like(agrees), views.sign, n)
    sigma = torch.linalg.eigvalsh(fit.covariance)[:, -1].clamp_min(0).sqrt()
    agreeing = group_sum(agrees, views.sign, n)
    is_doubtful = agreeing < config.doubtful_frames
    doubtful = min(config.max_doubtful_sigma_m, config.max_sigma_m)
    is_alone = config.method == "paper2017"
    parallax_deg = config.min_parallax_alone_deg if is_alone else config.min_parallax_deg
    low, high = config.size_m
    tests = (
        (BEHIND, group_sum(is_behind, views.sign, n) > 0),
        (NO_PARALLAX, _parallax(views, fit, agrees > 0) < math.radians(parallax_deg)),
        (TOO_FAR, away[closest_view(away, views.sign)] > config.max_distance_m),
        (SIZE, ((fit.size < low) | (fit.size > high)).any(-1)),
        (SIZE, fit.size.amax(-1) < config.min_side_m),
        (FEW_FRAMES, agreeing < config.min_frames),
        (RESIDUAL, agreeing < config.min_inlier_share * number),
        (RESIDUAL, scale > config.max_noise_scale),
        (UNCERTAIN, ~(sigma < torch.where(is_doubtful, doubtful, config.max_sigma_m))),
    )
    fate = torch.full_like(views.sign[:1].expand(n), KEPT).clone()
    for code, fails in tests:
        fate = torch.where((fate == KEPT) & fails, code, fate)
    return fate


def _parallax(views: SignViews, fit: SignFit, counts: Bool[Tensor, " m"]) -> Float[Tensor, " n"]:
    """Largest angle between the closest view's ray to a sign and the rays of the views that count [rad]."""
    towards = views.p_world_camera - fit.T_world_sign[views.sign, :3, 3]
    ray = torch.nn.functional.normalize(towards, dim=-1)
    closest = closest_view(towards.norm(dim=-1), views.sign)
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
