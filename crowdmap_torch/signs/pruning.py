"""Which tracklets of one journey become signs, and why the others do not (IV-B)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_argmin, group_sum
from crowdmap_torch.geometry import se3
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
from crowdmap_torch.signs.fit import SignFitConfig
from crowdmap_torch.signs.initialize import SignStartConfig
from crowdmap_torch.signs.merge_tracks import RejoinConfig
from crowdmap_torch.signs.views import SignFit, SignViews, distance_away

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
_OF_PLACE = (TOO_FAR, UNCERTAIN)
"""What prunes signs that may well be some, but not where they are."""
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
    max_afar_sigma_m: Sigma = 5.0
    """Those, and such that are further away, still say whether another journey is right to see one, if their standard
    deviation is less."""
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
class Fates:
    """What becomes of fitted signs."""

    reason: Int[Tensor, " n"]
    """Whether each is kept, or why it is pruned, the first reason: an index into `REASONS`."""
    doubtful: Bool[Tensor, " n"]
    """Those pruned for having few views alone."""
    from_afar: Bool[Tensor, " n"]
    """Those pruned for their distance or how uncertain their place is alone, less than `max_afar_sigma_m`."""


def fates(
    views: SignViews, fit: SignFit, scale: Float[Tensor, " n"], config: SignTriangulationConfig
) -> Fates:
    """What becomes of signs that were fitted together, by how much noisier their views are than usual (`scale`)."""
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
    reason = _first_reason(tests)
    few = agreeing < _least_views(agreeing[reason == KEPT], config.doubtful_frames)
    but_for_place = _first_reason([test for test in tests if test[0] not in _OF_PLACE])
    known = (sigma < config.max_afar_sigma_m) & ~few
    doubtful = (reason == KEPT) & few & ~(sigma < config.max_doubtful_sigma_m)
    return Fates(
        reason=reason.masked_fill(doubtful, UNCERTAIN),
        doubtful=doubtful,
        from_afar=(reason != KEPT) & (but_for_place == KEPT) & known,
    )


def _least_views(number: Float[Tensor, " n"], most: int) -> float:
    """So many views make a tracklet of a drive with such numbers no run of false detections, and `most` do anyway.

    Half of those that half of its views come with: a slow camera, or one of few pixels, shows each sign a few times.
    """
    return min(most, usual(number, number, assumed=2.0 * most, beside=_VIEWS_BESIDE) / 2)


def fates_alone(views: SignViews, fit: SignFit, config: SignTriangulationConfig) -> Fates:
    """As `fates`, by the angles that signs are seen at, and of what can be no sign."""
    every = torch.ones_like(views.sign, dtype=torch.bool)
    narrow = _parallax(views, fit, every) < math.radians(config.min_parallax_alone_deg)
    low, high = config.size_m
    no_sign = ((fit.size < low) | (fit.size > high)).any(-1)
    tests = (BEHIND, _is_behind(views, fit)), (NO_PARALLAX, narrow), (SIZE, no_sign)
    return Fates(_first_reason(tests), torch.zeros_like(narrow), torch.zeros_like(narrow))


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
