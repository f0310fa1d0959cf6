"""How much of a lens is missing from the pixels of a drive: its signs, the drift of its poses, and that share at once.

A lens bends the way of a sign through the image, and its outline. So does the drift of the poses, but in every drive and at
every place otherwise. Corners of signs, drift, and the share of the lens that is missing from the pixels (0: none of it,
1: all) are one problem for each drive; what all drives together say of that share decides.

A lens bends by where a sign is in the image, and that is known either way with an error. Where it is expected is off by what
its pose has wrong, and so is what it is seen off from there: the two go together, and noise of poses looks like a barrel.
Where it is detected goes with noise of the image and with drift, which look like a cushion. A lens looks alike by both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_median, group_sum
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.geometry.camera import Camera, distort, unproject
from crowdmap_torch.geometry.trajectory import station
from crowdmap_torch.geometry.triangulation import midpoint_ragged
from crowdmap_torch.noise.pixels import PixelNoiseConfig, detection_noise, longer_side
from crowdmap_torch.noise.positioning import (
    DriftPathConfig,
    PositioningNoise,
    knot_count,
    left_between_knots,
    places_on_path,
)
from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.linearize import residuals
from crowdmap_torch.optim.problem import (
    CostTerm,
    Problem,
    Values,
    Variable,
    euclidean,
    pull_euclidean,
)
from crowdmap_torch.optim.robust import Tukey
from crowdmap_torch.optim.solvers.banded_schur import BandBackend
from crowdmap_torch.optim.solvers.normal_equations import LinearFunctions
from crowdmap_torch.residuals.pose import (
    gauss_markov_start,
    gauss_markov_step,
    gauss_markov_step_jacobian,
)
from crowdmap_torch.residuals.reprojection import MIN_DEPTH, into_camera
from crowdmap_torch.signs.triangulate import shape_by_vote, usable_rows, views_of
from crowdmap_torch.signs.views import SignViews, thinned
from crowdmap_torch.tables import Journey, Tracklets


@dataclass(frozen=True)
class LensLimits:
    """What counts, and when a mistake is named."""

    views: tuple[int, int] = (6, 16)
    """Fewest views of a sign that counts, and the most of them that are looked at."""
    least_parallax_deg: float = 3.0
    """Root mean square angle between its rays."""
    knot_m: float = 8.0
    """Distance between the knots of the drift."""
    tukey: float = 3.0
    """Views with a root mean square whitened error beyond this many standard deviations have no say."""
    log_ratio: float = 5.0
    """Least logarithm of the likelihood of undistorted pixels over that of raw ones. Raw pixels come there by chance where
    they are three standard deviations off, and most of a lens."""
    most: float = 1.5
    """Largest share of the lens that may be missing, but for two standard deviations: more has another cause."""
    all_of_it: float = 0.3
    """A share this near to 1, or within three standard deviations of it, is taken for all of the lens."""
    sure: float = 4.0
    """Standard deviations from zero of a lens that a rig does not have, ..."""
    least_k1: float = 0.02
    """... and how strong it is: pixels that were undistorted with a slightly wrong lens are no mistake."""
    scatter: tuple[float, float] = (1.9, 32.0)
    """Shares of simulated drives differ from the truth as if their variances were so many times larger, and with how many
    degrees of freedom that is known."""
    looked_again: float = 1.0
    """Standard deviations from zero of a share that is looked for by where signs are detected as well, and of what is found
    there, of a lens that a rig does not have."""
    contradicting: float = 0.99
    """Quantile of that scatter from which on drives are said to contradict each other."""


@dataclass(frozen=True)
class MissingLens:
    """The share of a lens that is missing from pixels: 0 none of it, 1 all."""

    share: float
    sigma: float
    as_detected: MissingLens | None = None
    """That of a lens that bends by where signs are detected, not by where they are expected; None: not looked for."""

    @property
    def log_ratio(self) -> float:
        """Logarithm of the likelihood of pixels without the lens over that of pixels with it."""
        return (self.share - 0.5) / self.sigma**2


_POINTS = 4
"""Corners of an outline that are looked at."""
_EVERY_OTHER = (0, 2, 4, 6, 1, 3, 5, 7)
"""Corners of an octagon, those that are looked at first."""
_ANCHOR_M = 300.0
"""What is known of a corner before it is seen, about where its rays meet [m]."""
_UNKNOWN_SHARE = 30.0
"""What is known of the share, ..."""
_KEPT = 1 - 1e-9
"""... and what of it is left from knot to knot: it is one for the whole drive."""
_NEAREST_M = 1.0
"""Nearer to a camera than this is no sign [m]."""
_LEAST_NOISE = 0.5
"""Drives whose detections are less noisy than usual count no more than by this factor of their variance."""
_LM = lm.LmConfig(max_iterations=12, cost_tolerance=1e-4, initial_damping=1e-9)
"""Next to no damping: the share is held by every knot at once."""


def missing_lens(
    journey: Journey,
    tracks: Tracklets,
    other: Camera,
    positioning: PositioningNoise,
    limits: LensLimits,
    *,
    again: bool = False,
) -> MissingLens | None:
    """How far detections are on the way from the journey's own lens to another one; None where no sign tells.

    `again` where a share that may be more than chance is looked for by where signs are detected, too.
    """
    shape = shape_by_vote(journey, tracks)
    rows = usable_rows(journey, tracks, shape)
    fewest, most = limits.views
    often = torch.bincount(tracks.label[rows], minlength=tracks.count) >= fewest
    rows = rows[often[tracks.label[rows]]]
    if not len(rows):
        return None
    label, sign = tracks.label[rows].unique(return_inverse=True)
    views = views_of(journey, tracks, rows, sign)
    views = views[thinned(views, most)]
    px = _ordered(views.corners_px, shape[label][views.sign])
    ideal, closes = unproject(journey.rig.camera, px[:, :_POINTS])
    point, is_told = _meeting_points(views, ideal, len(label), limits)
    kept = is_told[views.sign] & closes.all(1)
    if int(kept.sum()) < fewest:
        return None
    seen = _Seen(views[kept], px[kept], shape[label], point)
    config = DriftPathConfig(knot_m=limits.knot_m)
    problem, values = _problem(journey, seen, other, positioning, config, limits)
    found, values = _solved(problem, values, seen)
    if not again or abs(found.share) < limits.looked_again * found.sigma:
        return found
    as_detected, _ = _solved(_as_detected(problem, seen, ideal[kept], other), values, seen)
    return replace(found, as_detected=as_detected)


@dataclass(frozen=True)
class _Seen:
    """Views of signs, those corners first that are looked at."""

    views: SignViews
    px: Float[Tensor, "m 8 2"]
    shape: Int[Tensor, " n"]
    point: Float[Tensor, "n 4 3"]
    """Where these corners are about."""

    @property
    def numbers(self) -> Int[Tensor, " m"]:
        """How many coordinates of each view count: triangles have three corners."""
        return 2 * polygon.corner_count(self.shape)[self.views.sign].clamp_max(_POINTS)


def _ordered(corners: Float[Tensor, "m 8 2"], shape: Int[Tensor, " m"]) -> Float[Tensor, "m 8 2"]:
    is_octagon = (polygon.corner_count(shape) == len(_EVERY_OTHER))[:, None, None]
    return torch.where(is_octagon, corners[:, _EVERY_OTHER], corners)


def _meeting_points(
    views: SignViews, ideal: Float[Tensor, "m 4 2"], signs: int, limits: LensLimits
) -> tuple[Float[Tensor, "n 4 3"], Bool[Tensor, " n"]]:
    """Where the rays to each corner meet, and whether those of a sign do so at an angle and in front of the cameras."""
    ray = torch.nn.functional.normalize(torch.nn.functional.pad(ideal, (0, 1), value=1.0), dim=-1)
    ray = se3.rotate(views.T_world_camera[:, None], ray).flatten(0, 1)
    corner = torch.arange(signs * _POINTS, device=ray.device).unflatten(0, (signs, _POINTS))
    corner = corner[views.sign].flatten()
    origin = views.p_world_camera.repeat_interleave(_POINTS, dim=0)
    point, _ = midpoint_ragged(origin, ray, corner, signs * _POINTS)
    # Once more with angles alike, not metres.
    weight = (point[corner] - origin).norm(dim=-1).clamp_min(1.0).pow(-2)
    point, spread = midpoint_ragged(origin, ray, corner, signs * _POINTS, weight)
    behind = (((point[corner] - origin) * ray).sum(-1) < _NEAREST_M).to(ray)
    is_told = (spread > math.radians(limits.least_parallax_deg) ** 2) & (
        group_sum(behind, corner, signs * _POINTS) == 0
    )
    return point.unflatten(0, (signs, _POINTS)), is_told.unflatten(0, (signs, _POINTS)).all(1)


def lens_view(
    given: Camera,
    other: Camera,
    outline: Float[Tensor, "12 *#rows"],
    before: Float[Tensor, "7 *#rows"],
    after: Float[Tensor, "7 *#rows"],
    T_world_camera: Float[Tensor, "4 4 *#rows"],
    share: Float[Tensor, "*#rows"],
    px: Float[Tensor, "4 2 *#rows"],
    whitening: Float[Tensor, "8 8 *#rows"],
    detected: Float[Tensor, "2 2 *#rows"] | None = None,
) -> Float[Tensor, "8 *#rows"]:
    """Whitened pixel errors of four corners, seen from a pose that drifts by a lens between `given` and `other`.

    `before` and `after` are knots of the path, `share` the way between them: error of position and rotation (6), and how
    far the lens is from `given`. It bends where corners are expected, or around where `_middle` of them is `detected`, by
    either lens. Errors are of raw pixels: those of undistorted ones would grow with a lens that is taken to be strong, and
    all lenses look stronger than they are.
    """
    path = (1 - share) * before + share * after
    point = outline.unflatten(0, (_POINTS, 3)).transpose(0, 1)
    # The drift is small: to first order.
    x, y, z = into_camera(T_world_camera[:, :, None], point - path[:3, None])
    a, b, c = path[3:6, None]
    depth = (z - a * y + b * x).clamp_min(MIN_DEPTH)
    seen = torch.stack(((x - b * z + c * y) / depth, (y - c * x + a * z) / depth), dim=-1)
    missing, raw = path[6][..., None], distort(given, seen)
    if detected is None:
        bent = distort(other, seen) - raw
    else:
        near, far = detected[0].movedim(0, -1), detected[1].movedim(0, -1)
        place = seen + (near + missing * (far - near) - _middle(seen))
        bent = distort(other, place) - distort(given, place)
    predicted = raw + missing * bent
    return (whitening * (predicted.movedim(-1, 1) - px).flatten(0, 1)).sum(1)


def _problem(
    journey: Journey,
    seen: _Seen,
    other: Camera,
    positioning: PositioningNoise,
    config: DriftPathConfig,
    limits: LensLimits,
) -> tuple[Problem, Values]:
    along = station(journey.T_world_camera)
    places = places_on_path(along[seen.views.frame], config)
    knots = knot_count(along, config)
    outline = seen.point.flatten(1)
    terms = {
        "view": CostTerm(
            partial(lens_view, journey.rig.camera, other),
            (("outline", seen.views.sign), ("path", places.before), ("path", places.before + 1)),
            (
                *(seen.views.T_world_camera, places.share, seen.px[:, :_POINTS]),
                _whitening(seen, journey.rig.camera, positioning, config),
            ),
            loss=Tukey(limits.tukey * (2 * _POINTS) ** 0.5),
            takes_rows=True,
        ),
        "anchor": CostTerm(
            gauss_markov_start,
            (("outline", torch.arange(len(outline), device=outline.device)),),
            (outline,),
            torch.full_like(outline, 1 / _ANCHOR_M),
            takes_rows=True,
        ),
        **_chain(knots, outline, positioning, config),
    }
    variables = {
        "outline": Variable(3 * _POINTS, euclidean, pull=pull_euclidean),
        "path": Variable(7, euclidean, pull=pull_euclidean),
    }
    return Problem(variables, terms), {"outline": outline, "path": outline.new_zeros(knots, 7)}


def _middle(corners: Float[Tensor, "4 *rows 2"]) -> Float[Tensor, "*rows 2"]:
    """That of the corners that every outline has."""
    return corners[:3].mean(0)


def _as_detected(
    problem: Problem, seen: _Seen, ideal: Float[Tensor, "m 4 2"], other: Camera
) -> Problem:
    """The same with lenses that bend by where signs are detected, not by where they are expected."""
    far, closes = unproject(other, seen.px[:, :_POINTS])
    far = torch.where(closes[..., None], far, ideal)
    detected = torch.stack((_middle(ideal.transpose(0, 1)), _middle(far.transpose(0, 1))), dim=1)
    view = (terms := problem.terms)["view"]
    return replace(
        problem, terms={**terms, "view": replace(view, constants=(*view.constants, detected))}
    )


def _solved(problem: Problem, values: Values, seen: _Seen) -> tuple[MissingLens, Values]:
    backend = BandBackend("path")
    state = lm.solve(problem, values, _LM, backend=backend)
    # The share is the same at every knot. It is read where a sign is seen from: the inverse is filled from one to the other.
    sign, knot = (block[:1] for _, block in problem.terms["view"].slots[:2])
    of_outline, of_path = seen.point.new_zeros(1, 1, 3 * _POINTS), seen.point.new_zeros(1, 1, 7)
    of_path[..., 6] = 1
    of_share = LinearFunctions((("outline", sign), ("path", knot)), (of_outline, of_path))
    variance = backend.assemble(problem, state.values).covariance().of(of_share)[0, 0, 0]
    error = residuals(problem.terms["view"], state.values)
    noisier = (error.square().sum(1) / seen.numbers).median().clamp_min(_LEAST_NOISE)
    share = float(state.values["path"][0, 6])
    return MissingLens(share, float((variance * noisier).sqrt())), state.values


def _whitening(
    seen: _Seen, camera: Camera, positioning: PositioningNoise, config: DriftPathConfig
) -> Float[Tensor, "m 8 8"]:
    """Roots of the inverse covariances of the corners that are looked at; what a pose gets wrong shifts all of a view."""
    views, signs = seen.views, len(seen.shape)
    away = (seen.point.mean(1)[views.sign] - views.p_world_camera).norm(dim=-1)
    away = away.clamp_min(_NEAREST_M)
    position, rotation = left_between_knots(positioning, config)
    position += positioning.white_sigma_m**2
    rotation += positioning.white_sigma_rad**2
    shift = camera.K[0, 0].square() * (rotation + position / away.square())
    by_pose = torch.zeros_like(seen.px.flatten(1))[..., None].repeat(1, 1, 6)
    by_pose[:, 0::2, 0], by_pose[:, 1::2, 1] = 1.0, 1.0
    # By the size that all views of a sign expect of each: an outline that came out large by chance would weigh more.
    pixels = PixelNoiseConfig()
    box = longer_side(seen.px)
    expected = group_median(box * away, views.sign, signs)[views.sign] / away
    small = pixels.small_box_px
    factor = ((1 + (small / expected).square()) / (1 + (small / box).square())).sqrt()
    variance = shift[:, None].repeat(1, 6)
    shape, unmoved = seen.shape[views.sign], torch.zeros_like(variance)
    noise = detection_noise(seen.px, shape, factor, by_pose, variance, unmoved, pixels)
    leading = 2 * _POINTS
    counts = torch.arange(leading, device=box.device) < seen.numbers[:, None]
    return noise.whitening[:, :leading, :leading] * counts[:, :, None]


def _chain(
    knots: int, like: Tensor, positioning: PositioningNoise, config: DriftPathConfig
) -> dict[str, CostTerm]:
    """The drift of the poses, and the share, which is one for the whole drive."""
    p = positioning
    far = like.new_tensor((p.drift_sigma_m,) * 3 + (p.rotation_sigma_rad,) * 3 + (_UNKNOWN_SHARE,))
    way = like.new_tensor((p.drift_length_m,) * 3 + (p.rotation_length_m,) * 3)
    keep = torch.cat((torch.exp(-config.knot_m / way), way.new_tensor([_KEPT])))
    before = torch.arange(knots - 1, device=like.device)
    at_rest = torch.zeros_like(far)
    return {
        "step": CostTerm(
            gauss_markov_step,
            (("path", before), ("path", before + 1)),
            (at_rest.expand(len(before), 7), keep.expand(len(before), 7)),
            weight=(1 / (far * (1 - keep.square()).sqrt())).expand(len(before), 7),
            jacobian=gauss_markov_step_jacobian,
        ),
        "start": CostTerm(
            gauss_markov_start,
            (("path", before[:1]),),
            (at_rest[None],),
            (1 / far)[None],
            takes_rows=True,
        ),
    }
