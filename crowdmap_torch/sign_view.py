"""What one detection says of a sign: pixel errors of all its corners at once, whitened, with Jacobians (IV-B).

`residuals.sign_reprojection` is one corner; here the corners of one detection, which share the error of the view's pose.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch import residuals
from crowdmap_torch.geometry import se3


def sign_view(
    T_world_sign: Float[Tensor, "4 4"],
    size: Float[Tensor, " 2"],
    T_world_camera: Float[Tensor, "4 4"],
    template: Float[Tensor, "c 2"],
    observation: Float[Tensor, "c 3 3"],
    expected: Float[Tensor, " e"],
    whitening: Float[Tensor, "e e"],
) -> Float[Tensor, " e"]:
    """Whitened pixel errors of all corners of one detection, beyond those expected of the pose's own error (IV-B)."""
    error = torch.func.vmap(residuals.sign_reprojection, in_dims=(None, None, None, 0, 0))(
        T_world_camera, T_world_sign, size, template, observation
    )
    return whitening @ (error.reshape(-1) - expected)


def drifting_sign_view(
    T_world_sign: Float[Tensor, "4 4"],
    size: Float[Tensor, " 2"],
    before: Float[Tensor, " 8"],
    after: Float[Tensor, " 8"],
    T_world_camera: Float[Tensor, "4 4"],
    template: Float[Tensor, "c 2"],
    observation: Float[Tensor, "c 3 3"],
    expected: Float[Tensor, " e"],
    whitening: Float[Tensor, "e e"],
    share: Float[Tensor, ""],
) -> Float[Tensor, " e"]:
    """`sign_view` from a pose that is off by the interpolation of two knots."""
    moved = se3.retract(T_world_camera, ((1 - share) * before + share * after)[:6])
    return sign_view(T_world_sign, size, moved, template, observation, expected, whitening)


def sign_view_jacobian(
    T_world_sign: Float[Tensor, "m 4 4"],
    size: Float[Tensor, "m 2"],
    T_world_camera: Float[Tensor, "m 4 4"],
    template: Float[Tensor, "m c 2"],
    observation: Float[Tensor, "m c 3 3"],
    expected: Float[Tensor, "m e"],
    whitening: Float[Tensor, "m e e"],
) -> tuple[Float[Tensor, "m e"], tuple[Tensor, Tensor]]:
    """`sign_view` and its Jacobians by sign pose and relative size."""
    error, (_, by_sign, by_size) = corner_errors(
        T_world_camera, T_world_sign, size, template, observation
    )
    whitened = (whitening @ (error - expected)[..., None])[..., 0]
    return whitened, (whitening @ by_sign, whitening @ by_size)


def drifting_sign_view_jacobian(
    T_world_sign: Float[Tensor, "m 4 4"],
    size: Float[Tensor, "m 2"],
    before: Float[Tensor, "m 8"],
    after: Float[Tensor, "m 8"],
    T_world_camera: Float[Tensor, "m 4 4"],
    template: Float[Tensor, "m c 2"],
    observation: Float[Tensor, "m c 3 3"],
    expected: Float[Tensor, "m e"],
    whitening: Float[Tensor, "m e e"],
    share: Float[Tensor, " m"],
) -> tuple[Float[Tensor, "m e"], tuple[Tensor, Tensor, Tensor, Tensor]]:
    """`drifting_sign_view` and its Jacobians by sign pose, relative size and the two knots.

    By the rotation of the drift to first order: drifts are fractions of a degree.
    """
    a = share[:, None]
    moved = se3.retract(T_world_camera, ((1 - a) * before + a * after)[:, :6])
    error, (by_pose, by_sign, by_size) = corner_errors(
        moved, T_world_sign, size, template, observation
    )
    whitened = (whitening @ (error - expected)[..., None])[..., 0]
    by_drift, a = torch.nn.functional.pad(whitening @ by_pose, (0, 2)), a[..., None]
    return whitened, (
        *(whitening @ by_sign, whitening @ by_size),
        *((1 - a) * by_drift, a * by_drift),
    )


def corner_errors(
    T_world_camera: Float[Tensor, "m 4 4"],
    T_world_sign: Float[Tensor, "m 4 4"],
    size: Float[Tensor, "m 2"],
    template: Float[Tensor, "m c 2"],
    observation: Float[Tensor, "m c 3 3"],
) -> tuple[Float[Tensor, "m e"], tuple[Tensor, Tensor, Tensor]]:
    """Pixel errors of all corners of every detection, and their Jacobians by camera, sign and relative size.

    `residuals.sign_reprojection_jacobian` for corners that share a camera and a sign.
    """
    R_camera, R_sign = T_world_camera[:, :3, :3], T_world_sign[:, :3, :3]
    corner = torch.nn.functional.pad(template * size[:, None], (0, 1))
    offset = T_world_sign[:, None, :3, 3] - T_world_camera[:, None, :3, 3]
    in_camera = (corner @ R_sign.mT + offset) @ R_camera
    u, v, depth = (observation @ in_camera[..., None])[..., 0].unbind(-1)
    is_ahead = depth > residuals.MIN_DEPTH
    depth = torch.where(is_ahead, depth, residuals.MIN_DEPTH)[..., None]
    error = torch.stack((u, v), dim=-1) / depth
    by_depth = (error * is_ahead[..., None])[..., None] * observation[..., 2:, :]
    by_camera = ((observation[..., :2, :] - by_depth) / depth[..., None]).flatten(1, 2)
    by_world = by_camera @ R_camera.mT
    in_camera, corner = (x.repeat_interleave(2, dim=1) for x in (in_camera, corner))
    by_body = by_world @ R_sign
    by_pose = torch.cat((-by_world, torch.linalg.cross(by_camera, in_camera)), dim=-1)
    by_sign = torch.cat((by_world, torch.linalg.cross(corner, by_body)), dim=-1)
    return error.flatten(1), (by_pose, by_sign, by_body[..., :2] * corner[..., :2])
