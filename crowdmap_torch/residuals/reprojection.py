"""Pixel errors of points, of sign corners and of whole sign detections (IV-B; V-B, first sum of eq:ba).

An observation carries its own `observation_matrix` M (geometry.camera): `M p_camera`, dehomogenised, is the pixel error
that a camera-frame point leaves at that detection. Cameras of every model thus share one residual.

A residual is written for ONE observation, on the leading axes of its arguments, so that the same lines serve many with
the rows last. What stands beside it as `..._jacobian` takes many: residuals `[d, rows]` and, by every block, `[d, k,
rows]` at zero tangent (retractions of geometry.se3: translation along world axes, rotation about body axes).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.optim.linearize import sum_of_products
from crowdmap_torch.optim.problem import Follows

MIN_DEPTH = 0.05
"""Depth [m] in the observation's own frame below which the projection is held: behind the camera it means nothing."""


def into_camera(
    T_world_camera: Float[Tensor, "4 4 *#rows"], point_world: Float[Tensor, "3 *#rows"]
) -> Float[Tensor, "3 *#rows"]:
    """A world point in the camera's frame."""
    return components(T_world_camera[:3, :3], point_world - T_world_camera[:3, 3])


def components(
    axes: Float[Tensor, "3 *#k_rows"], vector: Float[Tensor, "3 *#rows"]
) -> Float[Tensor, "*#k_rows"]:
    """The components of a vector along some axes, the columns of a matrix or one alone: `axes^T vector`."""
    total = torch.addcmul(axes[0] * vector[0], axes[1], vector[1])
    return torch.addcmul(total, axes[2], vector[2])


def corner_world(
    T_world_sign: Float[Tensor, "4 4 *#rows"], corner_sign: Float[Tensor, "2 *#rows"]
) -> Float[Tensor, "3 *#rows"]:
    """World point of a point on a sign's plane."""
    x, y = corner_sign
    return T_world_sign[:3, 0] * x + T_world_sign[:3, 1] * y + T_world_sign[:3, 3]


def pixel_error(
    point_camera: Float[Tensor, "3 *#rows"], observation: Float[Tensor, "3 3 *#rows"]
) -> Float[Tensor, "2 *#rows"]:
    """Pixel error of a camera-frame point at one detection [px]."""
    seen = components(observation.transpose(0, 1), point_camera)
    return seen[:2] / seen[2].clamp_min(MIN_DEPTH)


def point_reprojection(
    T_world_camera: Float[Tensor, "4 4 *#rows"],
    point_world: Float[Tensor, "3 *#rows"],
    observation: Float[Tensor, "3 3 *#rows"],
) -> Float[Tensor, "2 *#rows"]:
    """Pixel error of a free point in one frame [px]."""
    return pixel_error(into_camera(T_world_camera, point_world), observation)


def sign_reprojection(
    T_world_camera: Float[Tensor, "4 4 *#rows"],
    T_world_sign: Float[Tensor, "4 4 *#rows"],
    size: Float[Tensor, "2 *#rows"],
    template: Float[Tensor, "2 *#rows"],
    observation: Float[Tensor, "3 3 *#rows"],
) -> Float[Tensor, "2 *#rows"]:
    """Pixel error of one sign corner in one frame [px] (V-B, first sum of eq:ba).

    `size` is width and height [m], `template` the corner for width and height one, on the sign's plane.
    """
    point_world = corner_world(T_world_sign, template * size)
    return point_reprojection(T_world_camera, point_world, observation)


def sign_view(
    T_world_sign: Float[Tensor, "4 4 *#rows"],
    size: Float[Tensor, "2 *#rows"],
    T_world_camera: Float[Tensor, "4 4 *#rows"],
    template: Float[Tensor, "c 2 *#rows"],
    observation: Float[Tensor, "c 3 3 *#rows"],
    expected: Float[Tensor, "e *#rows"],
    whitening: Float[Tensor, "e e *#rows"],
) -> Float[Tensor, "e *#rows"]:
    """Pixel errors of all corners of one detection, beyond those `expected` of the pose's own error, whitened (IV-B).

    The corners share the error of the view's pose; `whitening` is an inverse root of their joint covariance [1/px].
    """
    error = sign_reprojection(
        T_world_camera[:, :, None],
        T_world_sign[:, :, None],
        size[:, None],
        template.transpose(0, 1),
        observation.movedim(0, 2),
    )
    return (whitening * (error.transpose(0, 1).flatten(0, 1) - expected)).sum(1)


def drifting_sign_view(
    T_world_sign: Float[Tensor, "4 4 *#rows"],
    size: Float[Tensor, "2 *#rows"],
    before: Float[Tensor, "8 *#rows"],
    after: Float[Tensor, "8 *#rows"],
    T_world_camera: Float[Tensor, "4 4 *#rows"],
    template: Float[Tensor, "c 2 *#rows"],
    observation: Float[Tensor, "c 3 3 *#rows"],
    expected: Float[Tensor, "e *#rows"],
    whitening: Float[Tensor, "e e *#rows"],
    share: Float[Tensor, "*#rows"],
) -> Float[Tensor, "e *#rows"]:
    """`sign_view` from a pose that is off by the interpolation of two knots of the journey's drift."""
    moved = _moved(T_world_camera, ((1 - share) * before + share * after)[:6])
    return sign_view(T_world_sign, size, moved, template, observation, expected, whitening)


def _moved(
    T_world_camera: Float[Tensor, "4 4 *#rows"], drift: Float[Tensor, "6 *#rows"]
) -> Float[Tensor, "4 4 *#rows"]:
    """`se3.retract`, rows last."""
    first = T_world_camera.movedim((0, 1), (-2, -1))
    return se3.retract(first, drift.movedim(0, -1)).movedim((-2, -1), (0, 1))


def pixel_error_jacobian(
    point_camera: Float[Tensor, "3 *#rows"], observation: Float[Tensor, "3 3 *#rows"]
) -> tuple[Float[Tensor, "2 *#rows"], Float[Tensor, "2 3 *#rows"]]:
    """`pixel_error`, and its Jacobian by the camera-frame point."""
    seen = components(observation.transpose(0, 1), point_camera)
    depth = seen[2].clamp_min(MIN_DEPTH)
    error = seen[:2] / depth
    # Where the depth is held it has no part in the derivative.
    slope = torch.where(seen[2] > MIN_DEPTH, error, 0.0)
    return error, torch.addcmul(observation[:2], slope[:, None], observation[2], value=-1) / depth


def by_pose_and_point(
    T_world_camera: Float[Tensor, "4 4 *#rows"],
    point_camera: Float[Tensor, "3 *#rows"],
    by_camera: Float[Tensor, "d 3 *#rows"],
) -> tuple[Float[Tensor, "d 6 *#rows"], Float[Tensor, "d 3 *#rows"]]:
    """Jacobians by the camera's pose and by the world point, of one by the point in the camera's frame."""
    R = T_world_camera[:3, :3].transpose(0, 1)
    x, y, z = by_camera.unbind(1)
    by_point = (x[:, None] * R[0]).addcmul_(y[:, None], R[1]).addcmul_(z[:, None], R[2])
    # exp(-w) p = p + p x w to first order, so J (p x w) = (J x p) . w row by row.
    px, py, pz = point_camera
    by_turn = torch.stack((y * pz - z * py, z * px - x * pz, x * py - y * px), dim=1)
    return torch.cat((-by_point, by_turn), dim=1), by_point


def point_reprojection_jacobian(
    T_world_camera: Float[Tensor, "4 4 *#rows"],
    point_world: Float[Tensor, "3 *#rows"],
    observation: Float[Tensor, "3 3 *#rows"],
) -> tuple[Float[Tensor, "2 *#rows"], tuple[Tensor, Follows]]:
    """`point_reprojection` and its Jacobians by camera pose and point."""
    point = into_camera(T_world_camera, point_world)
    error, by_camera = pixel_error_jacobian(point, observation)
    by_pose, _ = by_pose_and_point(T_world_camera, point, by_camera)
    return error, (by_pose, Follows(3))


def sign_reprojection_jacobian(
    T_world_camera: Float[Tensor, "4 4 *#rows"],
    T_world_sign: Float[Tensor, "4 4 *#rows"],
    size: Float[Tensor, "2 *#rows"],
    template: Float[Tensor, "2 *#rows"],
    observation: Float[Tensor, "3 3 *#rows"],
) -> tuple[Float[Tensor, "2 *#rows"], tuple[Tensor, Tensor, Tensor]]:
    """`sign_reprojection` and its Jacobians by camera pose, sign pose and relative change of size."""
    x, y = template * size
    right, down, normal = T_world_sign[:3, :3].unbind(1)
    along = right * x, down * y
    point = into_camera(T_world_camera, along[0] + along[1] + T_world_sign[:3, 3])
    error, by_camera = pixel_error_jacobian(point, observation)
    by_pose, by_point = by_pose_and_point(T_world_camera, point, by_camera)
    # What the corner moves by: R (w x c) by the sign's turning about its axes, R c by axis as its sides grow.
    moves = torch.stack((normal * y, -normal * x, down * x - right * y, *along), dim=1)
    by_shape = torch.stack([components(moves, row) for row in by_point])
    by_sign = torch.cat((by_point, by_shape[:, :3]), dim=1)
    return error, (by_pose, by_sign, by_shape[:, 3:])


def corner_errors_jacobian(
    T_world_camera: Float[Tensor, "4 4 m"],
    T_world_sign: Float[Tensor, "4 4 m"],
    size: Float[Tensor, "2 m"],
    template: Float[Tensor, "c 2 m"],
    observation: Float[Tensor, "c 3 3 m"],
) -> tuple[Float[Tensor, "e m"], tuple[Tensor, Tensor, Tensor]]:
    """Pixel errors of all corners of one detection, and their Jacobians by camera, sign and relative size."""
    error, jacobians = sign_reprojection_jacobian(
        T_world_camera[:, :, None],
        T_world_sign[:, :, None],
        size[:, None],
        template.transpose(0, 1),
        observation.movedim(0, 2),
    )
    by_pose, by_sign, by_size = (J.movedim(2, 0).flatten(0, 1) for J in jacobians)
    return error.transpose(0, 1).flatten(0, 1), (by_pose, by_sign, by_size)


def sign_view_jacobian(
    T_world_sign: Float[Tensor, "4 4 m"],
    size: Float[Tensor, "2 m"],
    T_world_camera: Float[Tensor, "4 4 m"],
    template: Float[Tensor, "c 2 m"],
    observation: Float[Tensor, "c 3 3 m"],
    expected: Float[Tensor, "e m"],
    whitening: Float[Tensor, "e e m"],
) -> tuple[Float[Tensor, "e m"], tuple[Tensor, Tensor, Tensor]]:
    """`sign_view` and its Jacobians by sign pose, relative size and camera pose."""
    error, jacobians = corner_errors_jacobian(
        T_world_camera, T_world_sign, size, template, observation
    )
    weights, beyond = whitening.transpose(0, 1), (error - expected)[:, None]
    by_camera, by_sign, by_size = (sum_of_products(weights, J) for J in jacobians)
    return sum_of_products(weights, beyond)[:, 0], (by_sign, by_size, by_camera)


def drifting_sign_view_jacobian(
    T_world_sign: Float[Tensor, "4 4 m"],
    size: Float[Tensor, "2 m"],
    before: Float[Tensor, "8 m"],
    after: Float[Tensor, "8 m"],
    T_world_camera: Float[Tensor, "4 4 m"],
    template: Float[Tensor, "c 2 m"],
    observation: Float[Tensor, "c 3 3 m"],
    expected: Float[Tensor, "e m"],
    whitening: Float[Tensor, "e e m"],
    share: Float[Tensor, " m"],
) -> tuple[Float[Tensor, "e m"], tuple[Tensor, Tensor, Tensor, Tensor]]:
    """`drifting_sign_view` and its Jacobians by sign pose, relative size and the two knots.

    By the rotation of the drift to first order: drifts are fractions of a degree.
    """
    drift = torch.lerp(before, after, share)[:6]
    moved = _moved(T_world_camera, drift)
    error, (by_sign, by_size, by_camera) = sign_view_jacobian(
        T_world_sign, size, moved, template, observation, expected, whitening
    )
    by_drift = torch.nn.functional.pad(by_camera, (0, 0, 0, 2))
    return error, (by_sign, by_size, by_drift * (1 - share), by_drift * share)
