"""Every residual of the project, each for ONE observation, and its Jacobian by the chain rule, in batch.

An observation carries its own `observation_matrix` M (geometry.camera): `M p_camera`, dehomogenised, is the pixel error
that a camera-frame point leaves at that detection. Cameras of every model thus share one residual.

Autograd differentiates the projection (one small function); the chain rule carries it through SE(3) (retractions of
geometry.se3: translation along world axes, rotation about body axes). Tests hold each chain against plain autograd.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import jacfwd, vmap

from crowdmap_torch.geometry import se3

MIN_DEPTH = 0.05
"""Depth [m] in the observation's own frame below which the projection is held: behind the camera it means nothing."""


def pixel_error(
    point_camera: Float[Tensor, " 3"], observation: Float[Tensor, "3 3"]
) -> Float[Tensor, " 2"]:
    """Pixel error of one camera-frame point at one detection."""
    u, v, depth = (observation @ point_camera).unbind(-1)
    # `where`, not `clamp`: a clamped depth would have no gradient, and a point behind the camera no way back.
    depth = torch.where(depth < MIN_DEPTH, MIN_DEPTH + 0 * depth, depth)
    return torch.stack((u / depth, v / depth))


def point_reprojection(
    T_world_camera: Float[Tensor, "4 4"],
    point_world: Float[Tensor, " 3"],
    observation: Float[Tensor, "3 3"],
) -> Float[Tensor, " 2"]:
    """Pixel error of one free point in one frame."""
    return pixel_error(se3.transform(se3.inverse(T_world_camera), point_world), observation)


def sign_reprojection(
    T_world_camera: Float[Tensor, "4 4"],
    T_world_sign: Float[Tensor, "4 4"],
    size: Float[Tensor, " 2"],
    template: Float[Tensor, " 2"],
    observation: Float[Tensor, "3 3"],
) -> Float[Tensor, " 2"]:
    """Pixel error of one sign corner in one frame (V-B, first sum of eq:ba).

    `template` is the corner for width and height one, on the sign's plane.
    """
    corner_sign = torch.cat((template * size, torch.zeros_like(size[:1])))
    corner_world = se3.transform(T_world_sign, corner_sign)
    return pixel_error(se3.transform(se3.inverse(T_world_camera), corner_world), observation)


def sign_place(
    T_world_sign: Float[Tensor, "4 4"],
    size: Float[Tensor, " 2"],
    template: Float[Tensor, " 2"],
    surveyed: Float[Tensor, " 3"],
) -> Float[Tensor, " 3"]:
    """Displacement of a point of a sign's plane from where a survey puts it [m]."""
    point_sign = torch.cat((template * size, torch.zeros_like(size[:1])))
    return se3.transform(T_world_sign, point_sign) - surveyed


def lane_reprojection(
    T_world_camera: Float[Tensor, "4 4"],
    c0: Float[Tensor, " 3"],
    c1: Float[Tensor, " 3"],
    c2: Float[Tensor, " 3"],
    c3: Float[Tensor, " 3"],
    weights: Float[Tensor, " 4"],
    normal_px: Float[Tensor, " 2"],
    observation: Float[Tensor, "3 3"],
) -> Float[Tensor, " 1"]:
    """Pixel error of one lane point along the image normal of the projected spline (V-B, second sum of eq:ba).

    The spline point is `sum weights * coefficients`, at the closest parameter, which is held between steps. Unlike the
    paper, the error along the spline is left out: a marker has no points to match in that direction.
    """
    point_world = torch.stack((c0, c1, c2, c3), dim=-1) @ weights
    point_camera = se3.transform(se3.inverse(T_world_camera), point_world)
    return (normal_px @ pixel_error(point_camera, observation))[None]


def lane_height(
    T_world_camera: Float[Tensor, "4 4"],
    c0: Float[Tensor, " 3"],
    c1: Float[Tensor, " 3"],
    c2: Float[Tensor, " 3"],
    c3: Float[Tensor, " 3"],
    weights: Float[Tensor, " 4"],
    road_normal_camera: Float[Tensor, " 3"],
    camera_height: Float[Tensor, ""],
) -> Float[Tensor, " 1"]:
    """Height of a spline point over the road plane under the camera [m] (IV-C, eq:ipm, as a residual).

    A car that follows a marker sees it in one plane through its own path: how low the marker lies cannot be told
    from how far aside. What can tell is the road the car stands on.
    """
    point_world = torch.stack((c0, c1, c2, c3), dim=-1) @ weights
    point_camera = se3.transform(se3.inverse(T_world_camera), point_world)
    return (road_normal_camera @ point_camera - camera_height)[None]


def lane_prior(
    coefficient: Float[Tensor, " 3"],
    start: Float[Tensor, " 3"],
    R_world_lane: Float[Tensor, "3 3"],
) -> Float[Tensor, " 3"]:
    """Displacement of a spline coefficient from its start, along the lane, across it and upwards [m]."""
    return R_world_lane.mT @ (coefficient - start)


def size_class(size: Float[Tensor, " 2"], usual: Float[Tensor, " 2"]) -> Float[Tensor, " 2"]:
    """How far a sign's width and height are from a usual size, as logarithms."""
    return (size / usual).log()


def lane_stretch(
    c0: Float[Tensor, " 3"],
    c1: Float[Tensor, " 3"],
    start: Float[Tensor, " 3"],
    R_world_lane: Float[Tensor, "3 3"],
) -> Float[Tensor, " 3"]:
    """Change of the step between two neighbouring coefficients, along the lane, across it and upwards [m].

    `start` is the step at first. Observations say nothing about sliding along the marker, and little where it is hardly
    seen; a marker may slide as a whole, but its coefficients neither bunch nor tear.
    """
    return R_world_lane.mT @ (c1 - c0 - start)


def lane_slide(
    T_world_camera: Float[Tensor, "4 4"],
    coefficient: Float[Tensor, " 3"],
    offset: Float[Tensor, " 3"],
    along: Float[Tensor, " 3"],
) -> Float[Tensor, " 1"]:
    """How far a coefficient has slid along its marker, against a camera that drove by [m].

    Held between steps only, at the `offset` of the moment. Against a camera and not against the world: the map may
    shift as a whole, and the journeys' positions must not be counted twice.
    """
    return (along @ (coefficient - T_world_camera[:3, 3] - offset))[None]


def pose_deviation(
    T_world_camera: Float[Tensor, "4 4"],
    drift: Float[Tensor, " 6"],
    prior: Float[Tensor, "4 4"],
) -> Float[Tensor, " 6"]:
    """What is left of a frame's pose error after the slow drift: the module's white noise (V-B, footnote).

    The error is the tangent from the prior pose to the pose. Absolute regularisation acts through the drift, relative
    regularisation between frames through the chain that the drift forms.
    """
    return se3.local(prior, T_world_camera) - drift


def pose_prior(
    T_world_camera: Float[Tensor, "4 4"], prior: Float[Tensor, "4 4"]
) -> Float[Tensor, " 6"]:
    """Deviation of a pose from its prior: along the world axes, and about the body axes (V-B, footnote)."""
    return se3.local(prior, T_world_camera)


def relative_pose(
    T_world_from: Float[Tensor, "4 4"],
    T_world_to: Float[Tensor, "4 4"],
    measured: Float[Tensor, "4 4"],
) -> Float[Tensor, " 6"]:
    """Deviation of a relative pose from the `measured` pose of the second frame in the first (V-B, footnote)."""
    return se3.local(measured, se3.inverse(T_world_from) @ T_world_to)


def drift_transition(
    drift_from: Float[Tensor, " 6"],
    drift_to: Float[Tensor, " 6"],
    bias: Float[Tensor, " 6"],
    persistence: Float[Tensor, " 6"],
) -> Float[Tensor, " 6"]:
    """Innovation of the drift between two places: a Gauss-Markov chain about the journey's constant bias."""
    return drift_to - bias - persistence * (drift_from - bias)


def drift_start(drift: Float[Tensor, " 6"], bias: Float[Tensor, " 6"]) -> Float[Tensor, " 6"]:
    """How far the drift is from the journey's bias in its first frame."""
    return drift - bias


def constant_bias(bias: Float[Tensor, " 6"]) -> Float[Tensor, " 6"]:
    """What a journey's poses have wrong from start to end: next to nothing, by the module's absolute sigma."""
    return bias


def pixel_error_and_jacobian(
    point_camera: Float[Tensor, "m 3"], observation: Float[Tensor, "m 3 3"]
) -> tuple[Float[Tensor, "m 2"], Float[Tensor, "m 2 3"]]:
    """`pixel_error` of many observations, and its derivative by the camera-frame point, by autograd."""

    def twice(point, matrix):
        error = pixel_error(point, matrix)
        return error, error

    jacobian, error = vmap(jacfwd(twice, has_aux=True))(point_camera, observation)
    return error, jacobian


def point_reprojection_jacobian(
    T_world_camera: Float[Tensor, "m 4 4"],
    point_world: Float[Tensor, "m 3"],
    observation: Float[Tensor, "m 3 3"],
) -> tuple[Float[Tensor, "m 2"], tuple[Tensor, Tensor]]:
    """`point_reprojection` and its Jacobians by camera pose and point."""
    error, by_pose, by_point = _through_pose(T_world_camera, point_world, observation)
    return error, (by_pose, by_point)


def sign_reprojection_jacobian(
    T_world_camera: Float[Tensor, "m 4 4"],
    T_world_sign: Float[Tensor, "m 4 4"],
    size: Float[Tensor, "m 2"],
    template: Float[Tensor, "m 2"],
    observation: Float[Tensor, "m 3 3"],
) -> tuple[Float[Tensor, "m 2"], tuple[Tensor, Tensor, Tensor]]:
    """`sign_reprojection` and its Jacobians by camera pose, sign pose and relative change of size."""
    corner = torch.nn.functional.pad(template * size, (0, 1))
    R_sign = T_world_sign[:, :3, :3]
    offset_world = (R_sign @ corner[..., None])[..., 0]
    error, by_pose, by_point = _through_pose(
        T_world_camera, T_world_sign[:, :3, 3] + offset_world, observation
    )
    by_body = by_point @ R_sign
    # d (R exp(w) c) = R (w x c), so J w = (c x J^T) . w row by row.
    by_rotation = torch.linalg.cross(corner[:, None].expand_as(by_body), by_body)
    by_size = by_body[..., :2] * corner[:, None, :2]
    return error, (by_pose, torch.cat((by_point, by_rotation), dim=-1), by_size)


def lane_reprojection_jacobian(
    T_world_camera: Float[Tensor, "m 4 4"],
    c0: Float[Tensor, "m 3"],
    c1: Float[Tensor, "m 3"],
    c2: Float[Tensor, "m 3"],
    c3: Float[Tensor, "m 3"],
    weights: Float[Tensor, "m 4"],
    normal_px: Float[Tensor, "m 2"],
    observation: Float[Tensor, "m 3 3"],
) -> tuple[Float[Tensor, "m 1"], tuple[Tensor, ...]]:
    """`lane_reprojection` and its Jacobians by camera pose and the four coefficients."""
    point_world = (torch.stack((c0, c1, c2, c3), dim=-1) @ weights[..., None])[..., 0]
    # The image normal turns the two rows of the observation into one before anything is differentiated.
    error, by_pose, by_point = _through_pose(T_world_camera, point_world, observation)
    along = normal_px[:, None]
    by_point = along @ by_point
    by_coefficient = by_point[:, None] * weights[:, :, None, None]
    along_error = (along @ error[..., None])[..., 0]
    return along_error, (along @ by_pose, *by_coefficient.unbind(1))


def lane_height_jacobian(
    T_world_camera: Float[Tensor, "m 4 4"],
    c0: Float[Tensor, "m 3"],
    c1: Float[Tensor, "m 3"],
    c2: Float[Tensor, "m 3"],
    c3: Float[Tensor, "m 3"],
    weights: Float[Tensor, "m 4"],
    road_normal_camera: Float[Tensor, "m 3"],
    camera_height: Float[Tensor, " m"],
) -> tuple[Float[Tensor, "m 1"], tuple[Tensor, ...]]:
    """`lane_height` and its Jacobians by camera pose and the four coefficients."""
    point_world = (torch.stack((c0, c1, c2, c3), dim=-1) @ weights[..., None])[..., 0]
    point_camera, by_rotation_of = _into_camera(T_world_camera, point_world)
    by_camera = road_normal_camera[:, None]
    by_point = by_camera @ T_world_camera[:, :3, :3].mT
    by_pose = torch.cat((-by_point, by_rotation_of(by_camera)), dim=-1)
    by_coefficient = by_point[:, None] * weights[:, :, None, None]
    height = (by_camera @ point_camera[..., None])[..., 0] - camera_height[:, None]
    return height, (by_pose, *by_coefficient.unbind(1))


def lane_prior_jacobian(
    coefficient: Float[Tensor, "m 3"],
    start: Float[Tensor, "m 3"],
    R_world_lane: Float[Tensor, "m 3 3"],
) -> tuple[Float[Tensor, "m 3"], tuple[Tensor]]:
    """`lane_prior` and its Jacobian by the coefficient."""
    R_t = R_world_lane.mT
    return (R_t @ (coefficient - start)[..., None])[..., 0], (R_t,)


def size_class_jacobian(
    size: Float[Tensor, "m 2"], usual: Float[Tensor, "m 2"]
) -> tuple[Float[Tensor, "m 2"], tuple[Tensor]]:
    """`size_class` and its Jacobian by relative changes of the size."""
    eye = torch.eye(2, dtype=size.dtype, device=size.device)
    return (size / usual).log(), (eye.expand(len(size), 2, 2),)


def lane_stretch_jacobian(
    c0: Float[Tensor, "m 3"],
    c1: Float[Tensor, "m 3"],
    start: Float[Tensor, "m 3"],
    R_world_lane: Float[Tensor, "m 3 3"],
) -> tuple[Float[Tensor, "m 3"], tuple[Tensor, Tensor]]:
    """`lane_stretch` and its Jacobians by the two coefficients."""
    R_t = R_world_lane.mT
    return (R_t @ (c1 - c0 - start)[..., None])[..., 0], (-R_t, R_t)


def lane_slide_jacobian(
    T_world_camera: Float[Tensor, "m 4 4"],
    coefficient: Float[Tensor, "m 3"],
    offset: Float[Tensor, "m 3"],
    along: Float[Tensor, "m 3"],
) -> tuple[Float[Tensor, "m 1"], tuple[Tensor, Tensor]]:
    """`lane_slide` and its Jacobians by camera pose and coefficient."""
    change = coefficient - T_world_camera[:, :3, 3] - offset
    by_pose = torch.nn.functional.pad(-along, (0, 3))
    return (along * change).sum(-1, keepdim=True), (by_pose[:, None], along[:, None])


def pose_deviation_jacobian(
    T_world_camera: Float[Tensor, "m 4 4"],
    drift: Float[Tensor, "m 6"],
    prior: Float[Tensor, "m 4 4"],
) -> tuple[Float[Tensor, "m 6"], tuple[Tensor, Tensor]]:
    """`pose_deviation` and its Jacobians by pose and drift; the rotation's is the inverse right Jacobian of SO(3)."""
    error, (by_pose,) = pose_prior_jacobian(T_world_camera, prior)
    return error - drift, (by_pose, -_identity(drift))


def pose_prior_jacobian(
    T_world_camera: Float[Tensor, "m 4 4"], prior: Float[Tensor, "m 4 4"]
) -> tuple[Float[Tensor, "m 6"], tuple[Tensor]]:
    """`pose_prior` and its Jacobian by the pose."""
    error = se3.local(prior, T_world_camera)
    eye = torch.eye(3, dtype=error.dtype, device=error.device).expand(len(error), 3, 3)
    return error, (_block_diagonal(eye, _right_jacobian_inverse(error[:, 3:])),)


def relative_pose_jacobian(
    T_world_from: Float[Tensor, "m 4 4"],
    T_world_to: Float[Tensor, "m 4 4"],
    measured: Float[Tensor, "m 4 4"],
) -> tuple[Float[Tensor, "m 6"], tuple[Tensor, Tensor]]:
    """`relative_pose` and its Jacobians by the two poses."""
    T_from_to = se3.inverse(T_world_from) @ T_world_to
    error = se3.local(measured, T_from_to)
    R_t = T_world_from[:, :3, :3].mT
    turn = _right_jacobian_inverse(error[:, 3:])
    by_from = _block_diagonal(-R_t, -turn @ T_from_to[:, :3, :3].mT)
    by_from[:, :3, 3:] = se3.skew(T_from_to[:, :3, 3])
    return error, (by_from, _block_diagonal(R_t, turn))


def drift_transition_jacobian(
    drift_from: Float[Tensor, "m 6"],
    drift_to: Float[Tensor, "m 6"],
    bias: Float[Tensor, "m 6"],
    persistence: Float[Tensor, "m 6"],
) -> tuple[Float[Tensor, "m 6"], tuple[Tensor, Tensor, Tensor]]:
    """`drift_transition` and its Jacobians by the two drifts and the bias."""
    change = drift_to - bias - persistence * (drift_from - bias)
    keep = torch.diag_embed(persistence)
    eye = _identity(change)
    return change, (-keep, eye, keep - eye)


def drift_start_jacobian(
    drift: Float[Tensor, "m 6"], bias: Float[Tensor, "m 6"]
) -> tuple[Float[Tensor, "m 6"], tuple[Tensor, Tensor]]:
    """`drift_start` and its Jacobians by drift and bias."""
    eye = _identity(drift)
    return drift - bias, (eye, -eye)


def constant_bias_jacobian(
    bias: Float[Tensor, "m 6"],
) -> tuple[Float[Tensor, "m 6"], tuple[Tensor]]:
    """`constant_bias` and its Jacobian."""
    return bias, (_identity(bias),)


def _identity(tangent: Float[Tensor, "m k"]) -> Float[Tensor, "m k k"]:
    m, k = tangent.shape
    return torch.eye(k, dtype=tangent.dtype, device=tangent.device).expand(m, k, k)


def _through_pose(
    T_world_camera: Float[Tensor, "m 4 4"],
    point_world: Float[Tensor, "m 3"],
    observation: Float[Tensor, "m 3 3"],
) -> tuple[Float[Tensor, "m 2"], Float[Tensor, "m 2 6"], Float[Tensor, "m 2 3"]]:
    """Pixel errors of world points, and their Jacobians by camera pose and by point."""
    point_camera, by_rotation_of = _into_camera(T_world_camera, point_world)
    error, by_camera = pixel_error_and_jacobian(point_camera, observation)
    by_point = by_camera @ T_world_camera[:, :3, :3].mT
    return error, torch.cat((-by_point, by_rotation_of(by_camera)), dim=-1), by_point


def _into_camera(
    T_world_camera: Float[Tensor, "m 4 4"], point_world: Float[Tensor, "m 3"]
) -> tuple[Float[Tensor, "m 3"], Callable[[Tensor], Tensor]]:
    """Camera-frame points, and what turns a Jacobian by them [m, d, 3] into one by the camera's rotation."""
    offset = point_world - T_world_camera[:, :3, 3]
    point_camera = (T_world_camera[:, :3, :3].mT @ offset[..., None])[..., 0]

    # exp(-w) p = p - w x p = p + p x w to first order, so J (p x w) = (J x p) . w row by row.
    def by_rotation_of(by_camera: Tensor) -> Tensor:
        return torch.linalg.cross(by_camera, point_camera[:, None].expand_as(by_camera))

    return point_camera, by_rotation_of


def _block_diagonal(a: Float[Tensor, "m 3 3"], b: Float[Tensor, "m 3 3"]) -> Float[Tensor, "m 6 6"]:
    joint = a.new_zeros(len(a), 6, 6)
    joint[:, :3, :3], joint[:, 3:, 3:] = a, b
    return joint


def _right_jacobian_inverse(w: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3 3"]:
    """Inverse right Jacobian of SO(3): `log(exp(w) exp(d)) = w + J d` to first order (Chirikjian 2012)."""
    theta_sq = w.square().sum(-1)[:, None, None]
    small = theta_sq < 1e-4
    theta = torch.where(small, torch.ones_like(theta_sq), theta_sq).sqrt()
    closed = (1 - theta * (1 + theta.cos()) / (2 * theta.sin())) / theta.square()
    W = se3.skew(w)
    eye = torch.eye(3, dtype=w.dtype, device=w.device)
    return eye + W / 2 + torch.where(small, 1 / 12 + theta_sq / 720, closed) * (W @ W)
