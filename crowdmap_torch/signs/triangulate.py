"""IV-B: sign tracklets of one journey -> signs in the world, and why the other tracklets were pruned."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_mode, group_sum
from crowdmap_torch.geometry import camera, polygon
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.noise.white_noise import with_white_noise
from crowdmap_torch.residuals.sign_prior import against_the_drive
from crowdmap_torch.road.nonholonomic import DrivePath, drive_path
from crowdmap_torch.signs.fit import fit_signs
from crowdmap_torch.signs.fit_alone import center_axis_size, fit_signs_alone, mid_points
from crowdmap_torch.signs.initialize import choose_starts_again, choose_starts_of_drive
from crowdmap_torch.signs.merge_tracks import rejoin, relabelled
from crowdmap_torch.signs.pruning import (
    FEW_FRAMES,
    KEPT,
    REASONS,
    REJOINED,
    SignTriangulationConfig,
    fates,
    fates_alone,
)
from crowdmap_torch.signs.views import SignFit, SignStart, SignViews, distance_away
from crowdmap_torch.tables import Journey, Signs, Tracklets


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
    from_afar: Signs
    """Those pruned for their distance or place alone: rays to a sign, if another journey has one there."""

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
        return none, SignReport(reason, tracklets, _per_detection(journey), none, none)
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
        of = fates_alone(views, fit, config)
    else:
        of = fates(views, fit, fitted.noise_scale, config)
    reason[label] = of.reason
    signs, turn = _signs(journey, seen.rows, views, fit, shape[label], label, config)
    error_sq = _per_detection(journey).index_put((seen.rows,), fit.error_sq)
    tracklets = _turned(journey, seen.tracklets, shape, label, turn)
    pruned = signs[of.doubtful], signs[of.from_afar]
    return signs[of.reason == KEPT], SignReport(reason, tracklets, error_sq, *pruned)


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
