"""Robust fits of signs to their detections in posed frames (IV-B), all signs at once.

The poses of a journey are not exact, and their error hits all corners of a detection alike: it moves the sign in the
image and leaves its outline. So one detection is one observation, whitened by its covariance: pixel noise of the
corners, and the white noise of the pose that all of them share. What drifts slowly along the drive is estimated along
with the signs (`noise.positioning`): all signs of a journey are one problem. Each sign is placed relative to the pose at its
closest approach; its size and depth rest on the outlines, which no pose error spoils.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_argmin
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.noise.pixels import DetectionNoise, PixelNoiseConfig, detection_noise
from crowdmap_torch.noise.positioning import (
    DriftPathConfig,
    PathPlaces,
    PositioningNoise,
    drift_terms,
    knot_count,
    left_between_knots,
    places_on_path,
)
from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.linearize import CHUNK_ROWS
from crowdmap_torch.optim.linearize import residuals as rows_of_term
from crowdmap_torch.optim.problem import (
    CostTerm,
    Problem,
    Variable,
    euclidean,
    positive,
    pull_euclidean,
    pull_positive,
)
from crowdmap_torch.optim.robust import Tukey
from crowdmap_torch.optim.solvers.banded_schur import BandBackend, BandNormalEquations
from crowdmap_torch.optim.solvers.normal_equations import LinearFunctions, NormalEquations
from crowdmap_torch.processes.amounts import at_once
from crowdmap_torch.ranges import Deviations, RoundsOrNone, Settings, Share
from crowdmap_torch.residuals.reprojection import (
    corner_errors_jacobian,
    drifting_sign_view,
    drifting_sign_view_jacobian,
    sign_view,
    sign_view_jacobian,
)
from crowdmap_torch.residuals.sign_prior import SignHabit, habit_term
from crowdmap_torch.road.nonholonomic import DrivePath, NonholonomicConfig
from crowdmap_torch.signs.views import (
    CoarseFit,
    SignFit,
    SignStart,
    SignViews,
    closest_approach,
    distance_away,
    held_covariance,
)


@dataclass(frozen=True)
class SignFitConfig(Settings):
    """Noise of detections, what signs are like, and the minimisation."""

    pixels: PixelNoiseConfig = field(default_factory=PixelNoiseConfig)
    """Noise of the corners."""
    max_noise_scale: Deviations = 4.0
    """The noise of each sign's corners is estimated from its own residuals, up to this multiple of the above, or of that of
    the drive where its signs show more."""
    white_share: Share = 0.8
    """Share of the usual white noise of positions that is taken for one drive's: with all of it signs that a few frames
    place to half a metre are pruned."""
    drift: DriftPathConfig = field(default_factory=DriftPathConfig)
    """How the poses' drift is estimated along with the signs."""
    nonholonomic: NonholonomicConfig = field(default_factory=NonholonomicConfig)
    """How far the car holds that constraint on the drift."""
    tukey: Deviations = 2.8
    """Detections with a root mean square whitened error beyond this many standard deviations have no say."""
    tukey_alone: Deviations = 8.0
    """Corners with a pixel error beyond this many standard deviations of their sign's have no say; method `paper2017`."""
    habit: SignHabit = field(default_factory=SignHabit)
    """What signs are like before anything is seen of them."""
    rounds: RoundsOrNone = 2
    """How often the views' own pose errors are estimated and the fit is repeated."""
    lm: lm.LmConfig = field(
        default_factory=lambda: lm.LmConfig(max_iterations=30, cost_tolerance=1e-4)
    )
    """The minimisation."""
    coarse_lm: lm.LmConfig = field(
        default_factory=lambda: lm.LmConfig(max_iterations=12, cost_tolerance=1e-2)
    )
    """The minimisation from starts that are only to be compared."""


def fit_signs(
    views: SignViews,
    shape: Int[Tensor, " n"],
    start: SignStart,
    facing: Float[Tensor, "n 3"],
    noise_scale: Float[Tensor, " n"],
    drive: DrivePath,
    positioning: PositioningNoise,
    config: SignFitConfig,
) -> SignFit:
    """Pose and size of every sign that minimise the Tukey-weighted whitened reprojection error (IV-B).

    `facing` is the horizontal direction against the drive. Unlike the paper, the poses' white noise and drift are
    part of the model. The drift is one path for all signs, and how large it is the journey itself says. A view's own
    pose error is integrated out to first order around its estimate, which takes a second round: around zero instead,
    views that are off to the side would make the sign seem further away than it is.
    """
    window = _windowed(views, drive, start, config.drift)
    at_knots = start.size.new_zeros(knot_count(drive.station, config.drift), 8)
    pose_error = start.size.new_zeros(len(views), 6)
    scale, normal, whitened = 1.0, None, None
    for number in range(config.rounds):
        drifted = se3.retract(views.T_world_camera, window.places.drift(at_knots)[:, :6])
        position, rotation = left_between_knots(positioning, config.drift)
        extra = torch.stack(
            (
                window.beyond_m * positioning.walk_m**2 + position,
                window.beyond_m * positioning.walk_rad**2 + rotation,
            ),
            dim=-1,
        )
        noise = _noise(
            views,
            drifted,
            shape,
            start,
            pose_error,
            noise_scale,
            scale**2 * extra,
            positioning,
            config,
        )
        still, values = _problem(views, shape, start, noise, facing, config)
        problem = _with_drift(
            still, views, shape, window.places, len(at_knots), scale, drive, positioning, config
        )
        backend = BandBackend("drift")
        state = lm.solve(problem, {**values, "drift": at_knots}, config.lm, backend=backend)
        start = SignStart(state.values["sign"], state.values["size"])
        at_knots = state.values["drift"]
        whitened = _whitened(problem, state.values, shape, views)
        has_say = _mean_square(whitened, shape, views)[:, None] < config.tukey**2
        pose_error = torch.where(has_say, noise.likely_pose_error(whitened), 0.0)
        normal = backend.assemble(problem, state.values)
        if number == 0:
            scale = _likely_scale(problem, state.values, normal, positioning, config.drift)
        # Large beside what the next round makes of it.
        del noise, still, values, problem, state
    assert normal is not None and whitened is not None
    return _read(
        normal,
        views,
        start,
        at_knots,
        scale,
        drive,
        _mean_square(whitened, shape, views),
        positioning,
        config,
    )


def fit_signs_coarsely(
    views: SignViews,
    shape: Int[Tensor, " n"],
    start: SignStart,
    facing: Float[Tensor, "n 3"],
    positioning: PositioningNoise,
    config: SignFitConfig,
) -> CoarseFit:
    """Signs one by one, the drift counted as white noise: a cheap problem for starts that are still far off."""
    ones = torch.ones_like(start.size[:, 0])
    nothing = start.size.new_zeros(len(views), 6)
    p, away = views.p_world_camera, distance_away(views, start)
    way = (p - p[group_argmin(away, views.sign)][views.sign]).norm(dim=-1)
    variance = way.new_tensor((positioning.walk_m, positioning.walk_rad)).square()
    extra = way[:, None] * variance
    noise = _noise(
        views, views.T_world_camera, shape, start, nothing, ones, extra, positioning, config
    )
    problem, values = _problem(views, shape, start, noise, facing, config)
    state = lm.solve(problem, values, config.coarse_lm)
    whitened = _whitened(problem, state.values, shape, views)
    found = SignStart(state.values["sign"], state.values["size"])
    return CoarseFit(found, state.cost, _mean_square(whitened, shape, views))


def robust_noise_scale(
    error_sq: Float[Tensor, " m"], sign: Int[Tensor, " m"], count: int
) -> Float[Tensor, " count"]:
    """The noise of each sign's views as a multiple of what was assumed, at least 1: root of the median mean square."""
    order = torch.argsort(error_sq)
    order = order[torch.argsort(sign[order], stable=True)]
    number = torch.bincount(sign, minlength=count)
    middle = number.cumsum(0) - number + number.div(2, rounding_mode="floor")
    return error_sq[order][middle].sqrt().clamp_min(1.0)


def _problem(
    views: SignViews,
    shape: Int[Tensor, " n"],
    start: SignStart,
    noise: DetectionNoise,
    facing: Float[Tensor, "n 3"],
    config: SignFitConfig,
) -> tuple[Problem, dict[str, Tensor]]:
    """One independent problem per sign: its views, and what is usual."""
    own = torch.arange(len(shape), device=shape.device)
    variables = {
        "sign": Variable(6, se3.retract, group=own, pull=se3.pull),
        "size": Variable(2, positive, group=own, pull=pull_positive),
    }
    moved = se3.retract(views.T_world_camera, noise.pose_error)
    expected = (noise.by_pose @ noise.pose_error[..., None])[..., 0]
    templates = polygon.template(shape).to(start.size)
    terms = {}
    for name, rows, c in _by_corners(views, shape):
        at = views.sign[rows]
        terms[name] = CostTerm(
            sign_view,
            (("sign", at), ("size", at)),
            (
                *(moved[rows], templates[at, :c], views.observation[rows, :c]),
                *(expected[rows, : 2 * c], noise.whitening[rows, : 2 * c, : 2 * c]),
            ),
            loss=Tukey(config.tukey * (2 * c) ** 0.5),
            jacobian=sign_view_jacobian,
        )
    terms["habit"] = habit_term(facing, own, config.habit)
    values = {"sign": start.T_world_sign, "size": start.size}
    return Problem(variables, terms, group_count=len(own)), values


@dataclass(frozen=True)
class _Window:
    """Where views are on the path, no further from their sign's closest one than its window reaches."""

    places: PathPlaces
    beyond_m: Float[Tensor, " m"]
    """Way from the window to views outside of it."""


def _windowed(
    views: SignViews, drive: DrivePath, start: SignStart, config: DriftPathConfig
) -> _Window:
    station = drive.station[views.frame]
    middle = station[group_argmin(distance_away(views, start), views.sign)][views.sign]
    reach = config.max_window_m
    inside = torch.minimum(torch.maximum(station, middle - reach), middle + reach)
    return _Window(places_on_path(inside, config), (station - inside).abs())


def _with_drift(
    problem: Problem,
    views: SignViews,
    shape: Int[Tensor, " n"],
    places: PathPlaces,
    knots: int,
    scale: float,
    drive: DrivePath,
    positioning: PositioningNoise,
    config: SignFitConfig,
) -> Problem:
    """All signs as one problem, the drift that their views share as a further unknown."""
    terms = dict(problem.terms)
    for name, rows, _ in _by_corners(views, shape):
        still, before = terms[name], places.before[rows]
        terms[name] = CostTerm(
            drifting_sign_view,
            (*still.slots, ("drift", before), ("drift", before + 1)),
            (*still.constants, places.share[rows]),
            loss=still.loss,
            jacobian=drifting_sign_view_jacobian,
        )
    variables = {name: replace(kind, group=None) for name, kind in problem.variables.items()}
    return Problem(
        {**variables, "drift": Variable(8, euclidean, pull=pull_euclidean)},
        {
            **terms,
            "nonholonomic": drive.nonholonomic,
            **drift_terms(knots, scale, places.share, positioning, config.drift),
        },
    )


def _likely_scale(
    problem: Problem,
    values: Mapping[str, Tensor],
    whole: BandNormalEquations,
    positioning: PositioningNoise,
    config: DriftPathConfig,
) -> float:
    """The multiple of the usual drift under which the views are likeliest (marginal likelihood, to second order).

    `whole` are the normal equations at these values.
    """
    at_knots = values["drift"]
    chain = drift_terms(len(at_knots), 1.0, at_knots, positioning, config)
    alone = BandBackend("drift").assemble(replace(problem, terms=chain), values)
    evidence = []
    for scale in config.scales:
        # The chain of the poses' six components is in the whole once, with the scale of one.
        more = torch.zeros_like(at_knots[0])
        more[:6] = scale**-2 - 1
        minus_log = whole.plus(alone, more, at_knots).log_evidence()
        # The chain's own normalisation, and how usual such a scale is.
        unusual = (math.log(scale) / config.sigma_log_scale) ** 2 / 2
        evidence.append(float(minus_log) + 6 * len(at_knots) * math.log(scale) + unusual)
    return config.scales[min(range(len(evidence)), key=evidence.__getitem__)]


def _by_corners(views: SignViews, shape: Int[Tensor, " n"]) -> list[tuple[str, Tensor, int]]:
    """Name of the term, rows of the views and number of corners, for each number of corners that occurs."""
    count = polygon.corner_count(shape)[views.sign]
    return [(f"corners_{c}", (count == c).nonzero()[:, 0], c) for c in count.unique().tolist()]


def _noise(
    views: SignViews,
    T_world_camera: Float[Tensor, "m 4 4"],
    shape: Int[Tensor, " n"],
    start: SignStart,
    pose_error: Float[Tensor, "m 6"],
    noise_scale: Float[Tensor, " n"],
    extra_variance: Float[Tensor, "m 2"],
    positioning: PositioningNoise,
    config: SignFitConfig,
) -> DetectionNoise:
    """Covariances of the views of signs at `start`, seen from drifted poses with their own errors on top.

    `extra_variance` is that of positions and of rotations beyond their white noise.
    """
    template = polygon.template(shape).to(start.size)
    moved = se3.retract(T_world_camera, pose_error)
    by_pose = moved.new_empty(len(views), 2 * polygon.MAX_CORNERS, 6)
    # In lots: beside these there are the derivatives by all else.
    lot = at_once(CHUNK_ROWS, moved.device)
    for first in range(0, len(views), lot):
        here = slice(first, first + lot)
        at = views.sign[here]
        placed = moved[here], start.T_world_sign[at], start.size[at], template[at]
        rows_last = (x.movedim(0, -1) for x in (*placed, views.observation[here]))
        _, (by_pose_here, _, _) = corner_errors_jacobian(*rows_last)
        by_pose[here] = by_pose_here.permute(2, 0, 1)
    sigma_m = config.white_share * positioning.white_sigma_m
    white = extra_variance.new_tensor((sigma_m, positioning.white_sigma_rad))
    variance = (white.square() + extra_variance).repeat_interleave(3, dim=-1)
    return detection_noise(
        views.corners_px,
        shape[views.sign],
        noise_scale[views.sign],
        by_pose,
        variance,
        pose_error,
        config.pixels,
    )


def _mean_square(
    whitened: Float[Tensor, "m 16"], shape: Int[Tensor, " n"], views: SignViews
) -> Float[Tensor, " m"]:
    return whitened.square().sum(-1) / (2 * polygon.corner_count(shape)[views.sign])


def _whitened(
    problem: Problem, values: Mapping[str, Tensor], shape: Int[Tensor, " n"], views: SignViews
) -> Float[Tensor, "m 16"]:
    """Whitened errors of every view; zero past its shape's corners."""
    result = values["size"].new_zeros(len(views), 2 * polygon.MAX_CORNERS)
    for name, rows, c in _by_corners(views, shape):
        result[rows, : 2 * c] = rows_of_term(problem.terms[name], values)
    return result


def _read(
    normal: NormalEquations,
    views: SignViews,
    start: SignStart,
    at_knots: Float[Tensor, "k 8"],
    scale: float,
    drive: DrivePath,
    error_sq: Float[Tensor, " m"],
    positioning: PositioningNoise,
    config: SignFitConfig,
) -> SignFit:
    """The signs relative to the given poses at their closest approach, and the covariance of that."""
    frame = closest_approach(views, start, drive)
    places = places_on_path(drive.station[frame], config.drift)
    given = drive.T_world_camera[frame]
    true = se3.retract(given, places.drift(at_knots)[:, :6])
    T_world_sign = given @ se3.inverse(true) @ start.T_world_sign
    in_camera = se3.transform(se3.inverse(given), T_world_sign[:, :3, 3])
    turned = given[:, :3, :3] @ se3.skew(in_camera)
    eye = torch.eye(3, dtype=given.dtype, device=given.device).expand_as(turned)
    every = torch.arange(len(frame), device=frame.device)
    by_drift = torch.cat((-eye, turned, torch.zeros_like(eye[..., :2])), dim=-1)
    share = places.share[:, None, None]
    centre = LinearFunctions(
        (("sign", every), ("drift", places.before), ("drift", places.before + 1)),
        (torch.cat((eye, torch.zeros_like(eye)), dim=-1), (1 - share) * by_drift, share * by_drift),
    )
    covariance = held_covariance(normal.covariance().of(centre))
    # The one pose has noise of its own, which no path knows.
    sigma_m, sigma_rad = config.white_share * positioning.white_sigma_m, positioning.white_sigma_rad
    own = sigma_m**2 * eye + sigma_rad**2 * turned @ turned.mT
    return SignFit(T_world_sign, start.size, frame, covariance + own, error_sq, scale)
