"""How noise of images pulls signs near where poses err less than they are taken to, and what holds them off.

What a pose is wrong by is estimated beside the map, and noise of the image is taken in part for it: an angle is noise of
the image or, times the distance, of the position. The nearer the signs the smaller are the errors that it makes, so that
the cost of these falls with the scale of the map, however many frames there are (Neyman and Scott, Consistent estimates
based on partially consistent observations, 1948). True errors of the given poses do not: from where a camera was said to
be a nearer sign is seen off by more, which is as much dearer. With residuals y of the given poses, of noise R, errors of
variance B and their Jacobian J, which goes with one over the distance, the cost is y^T S^-1 y / 2 with S = R + J B J^T.
Where the errors' true variance is tau B, the mean of its slope by log(distance) is

    (1 - tau) tr(S^-1 J B J^T S^-1 R)  =  (1 - tau) tr(Q J^T R^-1 J),        Q = P B^-1 P,

with P = (B^-1 + J^T R^-1 J)^-1 the covariance of the errors' estimates, and Q what of it is the prior's: the rest is noise
of images. There is no pull where all errors are as large as they are taken to be (tau = 1), as in structural relations
with errors in both variables (Fuller, Measurement error models, 1987). Signs are held off by the slope, detection by
detection; `detection_shifts` has tau.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.shared_corner_errors import CornerDetections
from crowdmap_torch.optim.problem import CostTerm, Follows, Values
from crowdmap_torch.optim.solvers.normal_equations import MapEquations
from crowdmap_torch.processes.sums import add_at

_POSITION = slice(0, 3)
"""The numbers of a pose's tangent that are its position's."""
_MORE = 1e-4
"""Share by which observations are to tell more where covariances are differenced."""


def left_by_prior(
    equations: MapEquations, covariance: Float[Tensor, "p 6 6"]
) -> Float[Tensor, "p 6 6"]:
    """Q: what errors of the prior leave of the `covariance` of each pose, P + dP/ds with observations that tell s times.

    With all else known, as P = `conditional_covariance` of normal equations.
    """
    more = equations.conditional_covariance("pose", told=1 + _MORE)
    return covariance + (more - covariance) / _MORE


def held_off(
    term: CostTerm,
    detections: CornerDetections,
    values: Values,
    information: Float[Tensor, "d 6 6"],
    by_prior: Float[Tensor, "p 6 6"],
    journey: Int[Tensor, " m"],
    journeys: int,
) -> Float[Tensor, " d"]:
    """The `strength` of `noise_pull_term` of every detection that undoes the pull at tau = 0 [m].

    `term` is that of the detections' corners, by camera and sign, `information` what each tells of its pose, `by_prior` Q
    of each pose, and `journey` of so many `journeys` each row's. A detection that pulls the other way, where turns make up
    for positions, has none, and all others of its journey so much less.
    """
    (_, frame), (_, sign), *_ = term.slots
    frame, sign = frame[detections.first], sign[detections.first]
    slope = (by_prior[frame] * information).sum(-1)[:, _POSITION].sum(-1)
    whose, both = journey[detections.first], torch.stack((slope, slope.clamp_min(0)), dim=1)
    every = add_at(both.new_zeros(journeys, 2), 0, whose, both)
    share = (every[:, 0] / every[:, 1].clamp_min(torch.finfo(both.dtype).tiny)).clamp_min(0)
    slope = share[whose] * both[:, 1]
    distance = (values["sign"][sign, :3, 3] - values["pose"][frame, :3, 3]).norm(dim=-1)
    return slope.sqrt() * distance


def noise_pull_term(
    frame: Int[Tensor, " d"], sign: Int[Tensor, " d"], strength: Float[Tensor, " d"]
) -> CostTerm:
    """Holds signs off the cameras that saw them, with `strength` [m] over the distance; and the cameras off the signs."""
    return CostTerm(
        nearness, (("pose", frame), ("sign", sign)), (strength,), jacobian=nearness_jacobian
    )


def nearness(
    T_world_camera: Float[Tensor, "4 4 *#rows"],
    T_world_sign: Float[Tensor, "4 4 *#rows"],
    strength: Float[Tensor, "*#rows"],
) -> Float[Tensor, "1 *#rows"]:
    """One over a sign's distance from a camera, times `strength`: half its square has the slope -strength^2/distance^2."""
    return (strength / _offset(T_world_camera, T_world_sign).norm(dim=0))[None]


def nearness_jacobian(
    T_world_camera: Float[Tensor, "4 4 m"],
    T_world_sign: Float[Tensor, "4 4 m"],
    strength: Float[Tensor, " m"],
) -> tuple[Float[Tensor, "1 m"], tuple[Tensor, Follows]]:
    """`nearness`, and its Jacobians by the poses of camera and sign, of which no turn counts."""
    offset = _offset(T_world_camera, T_world_sign)
    distance = offset.norm(dim=0)
    by_camera = strength / distance**3 * offset
    by_pose = torch.cat((by_camera, torch.zeros_like(by_camera)))[None]
    return (strength / distance)[None], (by_pose, Follows(6))


def _offset(T_world_camera: Tensor, T_world_sign: Tensor) -> Float[Tensor, "3 *#rows"]:
    return T_world_sign[:3, 3] - T_world_camera[:3, 3]
