"""How poses' noise pulls signs near, and what holds them off: the bias of estimating what every frame has to itself.

Each frame has an error of its pose to itself, white noise, that is estimated beside the map (Neyman and Scott, Consistent
estimates based on partially consistent observations, 1948). It takes up image noise: an angle is noise of the image or,
times the distance, of the position. The nearer the signs the smaller are the errors that it takes, so that the cost of
these falls with the scale of the map, however many frames there are. Integrated out, as the map's likelihood has them, they
leave half a log-determinant, which rises as much: of errors that are as large as they are taken to be,

    d/d log(distance) of  1/2 log det A  =  - tr(P J^T W J) over the positions,

with A = P^-1 the information on a frame's pose and J^T W J that of a detection on it. How large the errors really are the
estimates tell: -w . g of a detection, with w the position's error and g the gradient of the detection's cost along it, is
what the cost falls by as that sign alone comes nearer. A drive's detections are held off by as much, in proportion to the
traces; what one of them pulls with is mostly chance.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.shared_corner_errors import CornerDetections
from crowdmap_torch.optim.linearize import first_blocks
from crowdmap_torch.optim.problem import CostTerm, Follows, Values, Variable
from crowdmap_torch.processes.sums import add_at

_POSITION = slice(0, 3)
"""The numbers of a pose's tangent that are its position's."""


def held_off(
    term: CostTerm,
    detections: CornerDetections,
    variables: Mapping[str, Variable],
    values: Values,
    covariance: Float[Tensor, "p 6 6"],
    error: Float[Tensor, "p 6"],
    journey: Int[Tensor, " m"],
    journeys: int,
) -> Float[Tensor, " d"]:
    """The `strength` of `noise_pull_term` of every detection that undoes the pull at these values [m].

    `term` is that of the detections' corners, by camera and sign; `covariance` that of each pose, with all else known,
    `error` what it has wrong to itself, and `journey` of so many `journeys` each row's.
    """
    (_, frame), (_, sign), *_ = term.slots
    frame, sign = frame[detections.first], sign[detections.first]
    runs = detections.run, len(detections.count)
    _, gradient, information = first_blocks(term, variables, values, *runs)
    trace = (covariance[frame] * information).sum(-1)[:, _POSITION].sum(-1).clamp_min(0)
    work = -(error[frame] * gradient)[:, _POSITION].sum(-1)
    whose, both = journey[detections.first], torch.stack((work, trace), dim=1)
    of_journeys = add_at(both.new_zeros(journeys, 2), 0, whose, both)
    least = torch.finfo(both.dtype).tiny
    share = (of_journeys[:, 0] / of_journeys[:, 1].clamp_min(least)).clamp(0, 1)
    distance = (values["sign"][sign, :3, 3] - values["pose"][frame, :3, 3]).norm(dim=-1)
    return (share[whose] * trace).sqrt() * distance


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
