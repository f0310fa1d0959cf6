"""Robust fits of signs to their detections in posed frames (IV-B), all signs at once.

The poses of a journey are not exact, and their error hits all corners of a detection alike: it moves the sign in the
image and leaves its outline. So one detection is one observation, whitened by its covariance: pixel noise of the
corners, and the white noise of the pose that all of them share. What drifts slowly along the drive is estimated along
with the signs (`pose_drift`): all signs of a journey are one problem. Each sign is placed relative to the pose at its
closest approach; its size and depth rest on the outlines, which no pose error spoils.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.drift_course import CourseConfig, DrivePath
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.geometry.camera import project
from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.band import BandBackend, BandNormalEquations
from crowdmap_torch.optim.linear import DenseBackend
from crowdmap_torch.optim.linearize import residuals as rows_of_term
from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean, positive
from crowdmap_torch.optim.robust import Tukey
from crowdmap_torch.pose_drift import (
    DriftConfig,
    PathPlaces,
    closest_view,
    drift_terms,
    knot_count,
    places_on_path,
)
from crowdmap_torch.sign_habit import SignHabit, habit_term
from crowdmap_torch.sign_view import (
    corner_errors,
    drifting_sign_view,
    drifting_sign_view_jacobian,
    sign_view,
    sign_view_jacobian,
)
from crowdmap_torch.tables import Rows

APPROACH_FRAMES = 150
"""Frames after a sign's closest view among which its closest approach is looked for."""


@dataclass(frozen=True)
class SignFitConfig:
    """Noise of detections and poses, what signs are like, and the minimisation."""

    sigma_px: float = 0.6
    """Noise of each corner of a large detection, per axis [px]."""
    small_box_px: float = 12.0
    """Box at which that noise has grown by a factor of 1.41 [px]."""
    box_sigma: float = 0.5
    """Noise of width and height of detections that are axis-aligned boxes, as a share: boxes are drawn around a sign, wider
    than its outline where it is seen at an angle."""
    max_noise_scale: float = 4.0
    """The noise of each sign's corners is estimated from its own residuals, up to this multiple of the above."""
    pose_sigma_m: float = 0.016
    """White noise of positions from frame to frame."""
    pose_sigma_rad: float = 3.5e-4
    """White noise of rotations from frame to frame."""
    drift: DriftConfig = field(default_factory=DriftConfig)
    """What else the poses do between views."""
    course: CourseConfig = field(default_factory=CourseConfig)
    """What the car's course says of it."""
    tukey: float = 2.8
    """Detections with a root mean square whitened error beyond this many standard deviations have no say."""
    tukey_alone: float = 20.0
    """The same of signs fitted one by one, whose residuals hold the errors of the poses too: those move the nearest views
    most, which tell most."""
    habit: SignHabit = field(default_factory=SignHabit)
    """What signs are like before anything is seen of them."""
    rounds: int = 2
    """How often the views' own pose errors are estimated and the fit is repeated."""
    lm: lm.LmConfig = field(
        default_factory=lambda: lm.LmConfig(max_iterations=30, cost_tolerance=1e-4)
    )
    """The minimisation."""
    coarse_lm: lm.LmConfig = field(
        default_factory=lambda: lm.LmConfig(max_iterations=12, cost_tolerance=1e-2)
    )
    """The minimisation from starts that are only to be compared."""


@dataclass(frozen=True)
class SignViews(Rows):
    """Detections of signs, corners in the order of the sign's template."""

    sign: Int[Tensor, " m"]
    """Row of the sign that each detection shows."""
    frame: Int[Tensor, " m"]
    corners_px: Float[Tensor, "m 8 2"]
    corners_ideal: Float[Tensor, "m 8 2"]
    observation: Float[Tensor, "m 8 3 3"]
    T_world_camera: Float[Tensor, "m 4 4"]

    @property
    def p_world_camera(self) -> Float[Tensor, "m 3"]:
        """Where each view was taken from."""
        return self.T_world_camera[:, :3, 3]


@dataclass(frozen=True)
class SignStart:
    """Where a fit begins."""

    T_world_sign: Float[Tensor, "n 4 4"]
    size: Float[Tensor, "n 2"]


@dataclass(frozen=True)
class CoarseFit:
    """Signs fitted to views one by one, the drift counted as white noise."""

    start: SignStart
    cost: Float[Tensor, " n"]
    error_sq: Float[Tensor, " m"]
    """Mean square of each view's whitened error."""


@dataclass(frozen=True)
class SignFit:
    """Signs fitted to views, each relative to the given pose at its closest approach."""

    T_world_sign: Float[Tensor, "n 4 4"]
    size: Float[Tensor, "n 2"]
    frame: Int[Tensor, " n"]
    """Of the closest approach: the nearest frame that has the sign in its image, detected or not."""
    covariance: Float[Tensor, "n 3 3"]
    """Of the centre, relative to the pose at that frame [m^2]."""
    error_sq: Float[Tensor, " m"]
    """Mean square of each view's whitened error; views beyond `tukey` squared have no say."""
    drift_scale: float
    """By how much the poses drift, in multiples of what is usual."""


@dataclass(frozen=True)
class _Noise:
    """What is known of the noise of every view; of a shape with C corners the leading 2 C entries count."""

    whitening: Float[Tensor, "m 16 16"]
    """Inverse Cholesky factor of the covariance; being triangular, its leading part is a factor of its own."""
    by_pose: Float[Tensor, "m 16 6"]
    """Derivative of the pixel errors by the view's pose."""
    pose_variance: Float[Tensor, "m 6"]
    pose_error: Float[Tensor, "m 6"]
    """The view's own pose error as far as it is known; `by_pose` is taken there."""


def fit_signs(
    views: SignViews,
    shape: Int[Tensor, " n"],
    start: SignStart,
    facing: Float[Tensor, "n 3"],
    noise_scale: Float[Tensor, " n"],
    drive: DrivePath,
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
        position, rotation = config.drift.left_between
        extra = torch.stack(
            (
                window.beyond_m * config.drift.sigma_m**2 + position,
                window.beyond_m * config.drift.sigma_rad**2 + rotation,
            ),
            dim=-1,
        )
        noise = _noise(
            views, drifted, shape, start, pose_error, noise_scale, scale**2 * extra, config
        )
        still, values = _problem(views, shape, start, noise, facing, config)
        problem = _with_drift(
            still, views, shape, window.places, len(at_knots), scale, drive, config
        )
        backend = BandBackend("drift")
        state = lm.solve(problem, {**values, "drift": at_knots}, config.lm, backend=backend)
        start = SignStart(state.values["sign"], state.values["size"])
        at_knots = state.values["drift"]
        whitened = _whitened(problem, state.values, shape, views)
        pose_error = _pose_error(whitened, noise, shape, views, config)
        if number == 0:
            scale = _likely_scale(problem, state.values, len(at_knots), config.drift)
        normal = backend.assemble(problem, state.values)
    assert normal is not None and whitened is not None
    return _read(
        normal, views, start, at_knots, scale, drive, _mean_square(whitened, shape, views), config
    )


def fit_signs_alone(
    views: SignViews,
    shape: Int[Tensor, " n"],
    start: SignStart,
    facing: Float[Tensor, "n 3"],
    drive: DrivePath,
    config: SignFitConfig,
) -> SignFit:
    """Signs one by one, the poses taken as they are: the paper's minimisation (IV-B).

    What is wrong with the poses is in the residuals: the scale of Tukey's weights is that of each sign's own, from
    those of the start on.
    """
    exact = replace(config, pose_sigma_m=0.0, pose_sigma_rad=0.0, tukey=config.tukey_alone)
    nothing = start.size.new_zeros(len(views), 6)

    def at(found: SignStart, scale: Tensor) -> tuple[Problem, dict[str, Tensor]]:
        given = views.T_world_camera
        noise = _noise(views, given, shape, found, nothing, scale, nothing[:, :2], exact)
        return _problem(views, shape, found, noise, facing, exact)

    def spread(error_sq: Tensor) -> Tensor:
        return robust_noise_scale(error_sq, views.sign, len(shape), torch.inf)

    problem, values = at(start, torch.ones_like(start.size[:, 0]))
    error_sq = _mean_square(_whitened(problem, values, shape, views), shape, views)
    scale = spread(error_sq)
    for _ in range(config.rounds):
        problem, values = at(SignStart(values["sign"], values["size"]), scale)
        values = lm.solve(problem, values, config.lm).values
        error_sq = _mean_square(_whitened(problem, values, shape, views), shape, views)
        scale = torch.minimum(scale, spread(error_sq * scale[views.sign].square()))
    found = SignStart(values["sign"], values["size"])
    away = distance_away(views, found)
    frame = closest_approach(
        drive, found.T_world_sign[:, :3, 3], views.frame[closest_view(away, views.sign)]
    )
    covariance = DenseBackend().assemble(problem, values).covariance()[:, :3, :3]
    return SignFit(found.T_world_sign, found.size, frame, covariance, error_sq, 0.0)


def fit_signs_coarsely(
    views: SignViews,
    shape: Int[Tensor, " n"],
    start: SignStart,
    facing: Float[Tensor, "n 3"],
    config: SignFitConfig,
) -> CoarseFit:
    """Signs one by one, the drift counted as white noise: a cheap problem for starts that are still far off."""
    ones = torch.ones_like(start.size[:, 0])
    nothing = start.size.new_zeros(len(views), 6)
    p, away = views.p_world_camera, distance_away(views, start)
    way = (p - p[closest_view(away, views.sign)][views.sign]).norm(dim=-1)
    variance = way.new_tensor((config.drift.sigma_m, config.drift.sigma_rad)).square()
    extra = way[:, None] * variance
    noise = _noise(views, views.T_world_camera, shape, start, nothing, ones, extra, config)
    problem, values = _problem(views, shape, start, noise, facing, config)
    state = lm.solve(problem, values, config.coarse_lm)
    whitened = _whitened(problem, state.values, shape, views)
    found = SignStart(state.values["sign"], state.values["size"])
    return CoarseFit(found, state.cost, _mean_square(whitened, shape, views))


def distance_away(views: SignViews, fit: SignFit | SignStart) -> Float[Tensor, " m"]:
    """Distance of each view from its sign [m]."""
    return (views.p_world_camera - fit.T_world_sign[views.sign, :3, 3]).norm(dim=-1)


def robust_noise_scale(
    error_sq: Float[Tensor, " m"], sign: Int[Tensor, " m"], count: int, most: float
) -> Float[Tensor, " count"]:
    """By how much the noise of each sign's views exceeds what was assumed: root of the median mean square, 1 to `most`."""
    order = torch.argsort(error_sq)
    order = order[torch.argsort(sign[order], stable=True)]
    number = torch.bincount(sign, minlength=count)
    middle = number.cumsum(0) - number + number.div(2, rounding_mode="floor")
    return error_sq[order][middle].sqrt().clamp(1.0, most)


def _problem(
    views: SignViews,
    shape: Int[Tensor, " n"],
    start: SignStart,
    noise: _Noise,
    facing: Float[Tensor, "n 3"],
    config: SignFitConfig,
) -> tuple[Problem, dict[str, Tensor]]:
    """One independent problem per sign: its views, and what is usual."""
    own = torch.arange(len(shape), device=shape.device)
    variables = {
        "sign": Variable(6, se3.retract, group=own),
        "size": Variable(2, positive, group=own),
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


def _windowed(views: SignViews, drive: DrivePath, start: SignStart, config: DriftConfig) -> _Window:
    station = drive.station[views.frame]
    middle = station[closest_view(distance_away(views, start), views.sign)][views.sign]
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
        {**variables, "drift": Variable(8, euclidean)},
        {**terms, "course": drive.course, **drift_terms(knots, config.drift, scale, places.share)},
    )


def _likely_scale(
    problem: Problem, values: Mapping[str, Tensor], knots: int, config: DriftConfig
) -> float:
    """The multiple of the usual drift under which the views are likeliest (marginal likelihood, to second order)."""
    backend = BandBackend("drift")
    whole = backend.assemble(problem, values)
    chain = drift_terms(knots, config, 1.0, values["drift"])
    alone = backend.assemble(replace(problem, terms=chain), values)
    evidence = []
    for scale in config.scales:
        # The chain of the poses' six components is in the whole once, with the scale of one.
        more = torch.zeros_like(values["drift"][0])
        more[:6] = scale**-2 - 1
        minus_log = whole.plus(alone, more, values["drift"]).log_evidence()
        # The chain's own normalisation, and how usual such a scale is.
        unusual = (math.log(scale) / config.sigma_log_scale) ** 2 / 2
        evidence.append(float(minus_log) + 6 * knots * math.log(scale) + unusual)
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
    config: SignFitConfig,
) -> _Noise:
    """Covariances of the views of signs at `start`, seen from drifted poses with their own errors on top.

    `extra_variance` is that of positions and of rotations beyond their white noise.
    """
    at = views.sign
    template = polygon.template(shape).to(start.size)[at]
    _, (by_pose, _, _) = corner_errors(
        se3.retract(T_world_camera, pose_error),
        start.T_world_sign[at],
        start.size[at],
        template,
        views.observation,
    )
    white = extra_variance.new_tensor((config.pose_sigma_m, config.pose_sigma_rad)).square()
    variance = (white + extra_variance).repeat_interleave(3, dim=-1)
    box = (views.corners_px.amax(1) - views.corners_px.amin(1)).amax(-1)
    pixel = config.sigma_px**2 * (1 + (config.small_box_px / box).square())
    covariance = (by_pose * variance[:, None]) @ by_pose.mT
    covariance.diagonal(dim1=-2, dim2=-1).add_((pixel * noise_scale[at].square())[:, None])
    by_scale = _box_scales(views.corners_px) * config.box_sigma
    covariance = covariance + by_scale @ by_scale.mT
    factor = torch.linalg.cholesky(covariance)
    eye = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
    whitening = torch.linalg.solve_triangular(factor, eye.expand_as(factor), upper=False)
    return _Noise(whitening, by_pose, variance, pose_error)


def _box_scales(corners_px: Float[Tensor, "m 8 2"]) -> Float[Tensor, "m 16 2"]:
    """Derivatives of the corners by the logarithms of the box's width and height; zero for outlines that are no boxes."""
    low, high = corners_px.amin(1, keepdim=True), corners_px.amax(1, keepdim=True)
    offset = (corners_px - (low + high) / 2) * polygon.is_box(corners_px)[:, None, None]
    return torch.diag_embed(offset).flatten(1, 2)


def _pose_error(
    whitened: Float[Tensor, "m 16"],
    noise: _Noise,
    shape: Int[Tensor, " n"],
    views: SignViews,
    config: SignFitConfig,
) -> Float[Tensor, "m 6"]:
    """The most likely error of each view's pose, given what is left of its pixel errors; zero for views without a say."""
    by_pose = noise.whitening @ noise.by_pose
    posterior = noise.pose_variance * (by_pose.mT @ whitened[..., None])[..., 0]
    has_say = _mean_square(whitened, shape, views) < config.tukey**2
    # The error is predicted minus observed: a camera that is off by d makes it by_pose d larger, and is corrected by
    # -d.
    return torch.where(has_say[:, None], -posterior, torch.zeros_like(posterior))


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
    normal: BandNormalEquations,
    views: SignViews,
    start: SignStart,
    at_knots: Float[Tensor, "k 8"],
    scale: float,
    drive: DrivePath,
    error_sq: Float[Tensor, " m"],
    config: SignFitConfig,
) -> SignFit:
    """The signs relative to the given poses at their closest approach, and the covariance of that."""
    away = distance_away(views, start)
    frame = closest_approach(
        drive, start.T_world_sign[:, :3, 3], views.frame[closest_view(away, views.sign)]
    )
    places = places_on_path(drive.station[frame], config.drift)
    given = drive.T_world_camera[frame]
    true = se3.retract(given, places.drift(at_knots)[:, :6])
    T_world_sign = given @ se3.inverse(true) @ start.T_world_sign
    in_camera = se3.transform(se3.inverse(given), T_world_sign[:, :3, 3])
    turned = given[:, :3, :3] @ se3.skew(in_camera)
    eye = torch.eye(3, dtype=given.dtype, device=given.device).expand_as(turned)
    by_drift = torch.cat((-eye, turned, torch.zeros_like(eye[..., :2])), dim=-1)
    share = places.share[:, None, None]
    covariance = normal.covariance(
        torch.cat((eye, torch.zeros_like(eye), torch.zeros_like(eye[..., :2])), dim=-1),
        torch.stack(((1 - share) * by_drift, share * by_drift), dim=1),
        torch.stack((places.before, places.before + 1), dim=-1),
    )
    # The one pose has noise of its own, which no path knows.
    white = given.new_tensor((config.pose_sigma_m, config.pose_sigma_rad)).square()
    own = white[0] * eye + white[1] * turned @ turned.mT
    return SignFit(T_world_sign, start.size, frame, covariance + own, error_sq, scale)


def closest_approach(
    drive: DrivePath, centre: Float[Tensor, "n 3"], closest_view: Int[Tensor, " n"]
) -> Int[Tensor, " n"]:
    """The nearest of the frames from the closest view on that has each point in its image: few are detected at the last."""
    ahead = torch.arange(APPROACH_FRAMES, device=centre.device)
    frame = (closest_view[:, None] + ahead).clamp_max(len(drive.station) - 1)
    in_camera = se3.transform(se3.inverse(drive.T_world_camera)[frame], centre[:, None])
    _, visible = project(drive.camera, in_camera)
    distance = torch.where(visible, in_camera.norm(dim=-1), torch.inf)
    # The view itself counts, whatever its sign's centre as fitted.
    distance[:, 0] = in_camera[:, 0].norm(dim=-1)
    return frame.gather(1, distance.argmin(1, keepdim=True))[:, 0]
