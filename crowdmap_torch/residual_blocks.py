"""The residuals of bundle adjustment for many rows at once: values, and blocks of the normal equations.

The same residuals as in `residuals`, and the same derivatives; tests hold one against the other. Here the rows are the
last axis and every number of a row a plane of its own, so that all arithmetic runs along the rows; and what two blocks
share is computed once: a pixel depends on pose and point through the point's place in the camera alone.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.optim.linearize import RowBlocks, RowGradients, sum_of_products
from crowdmap_torch.optim.robust import Loss
from crowdmap_torch.residuals import MIN_DEPTH


def point_reprojection(
    T_world_camera: Float[Tensor, "m 4 4"],
    point_world: Float[Tensor, "m 3"],
    observation: Float[Tensor, "m 3 3"],
) -> Float[Tensor, "m 2"]:
    """`residuals.point_reprojection` of many rows."""
    R, p = _planes(T_world_camera)
    offset = point_world.mT - p
    error, _ = _project(_turn(R, offset), observation.permute(1, 2, 0))
    return error.mT


def point_reprojection_blocks(
    blocks: tuple[Float[Tensor, "m 4 4"], Float[Tensor, "m 3"]],
    constants: tuple[Float[Tensor, "m 3 3"]],
    weight: Float[Tensor, " m"],
    loss: Loss,
) -> RowBlocks:
    """`residuals.point_reprojection` by camera pose and point."""
    R, p = _planes(blocks[0])
    point = _turn(R, blocks[1].mT - p)
    error, by_camera = _observed(point, constants[0], weight)
    pose, gradient, rho = _pose_blocks(R, point, error, by_camera, loss)
    return RowBlocks(
        rho,
        (gradient, -gradient[:3]),
        # Moving the camera one way is moving the point the other.
        {(0, 0): pose, (0, 1): -pose[:, :3], (1, 1): pose[:3, :3]},
    )


def point_reprojection_gradient(
    blocks: tuple[Float[Tensor, "m 4 4"], Float[Tensor, "m 3"]],
    constants: tuple[Float[Tensor, "m 3 3"]],
    weight: Float[Tensor, " m"],
    loss: Loss,
) -> RowGradients:
    """The gradient alone of `point_reprojection_blocks`."""
    R, p = _planes(blocks[0])
    point = _turn(R, blocks[1].mT - p)
    error, by_camera = _observed(point, constants[0], weight)
    s = error.square().sum(0)
    pulled = error * loss.weight(s)
    force = (by_camera[0] * pulled[0]).addcmul_(by_camera[1], pulled[1])
    by_point = (R[:, 0] * force[0]).addcmul_(R[:, 1], force[1]).addcmul_(R[:, 2], force[2])
    by_turn = torch.linalg.cross(force, point, dim=0)
    return RowGradients(loss.rho(s), (torch.cat((-by_point, by_turn)), by_point))


def sign_reprojection(
    T_world_camera: Float[Tensor, "m 4 4"],
    T_world_sign: Float[Tensor, "m 4 4"],
    size: Float[Tensor, "m 2"],
    template: Float[Tensor, "m 2"],
    observation: Float[Tensor, "m 3 3"],
) -> Float[Tensor, "m 2"]:
    """`residuals.sign_reprojection` of many rows."""
    (R, p), (R_sign, p_sign) = _planes(T_world_camera), _planes(T_world_sign)
    corner = (template * size).mT
    offset = R_sign[:, 0] * corner[0] + R_sign[:, 1] * corner[1] + p_sign - p
    error, _ = _project(_turn(R, offset), observation.permute(1, 2, 0))
    return error.mT


def sign_reprojection_blocks(
    blocks: tuple[Float[Tensor, "m 4 4"], Float[Tensor, "m 4 4"], Float[Tensor, "m 2"]],
    constants: tuple[Float[Tensor, "m 2"], Float[Tensor, "m 3 3"]],
    weight: Float[Tensor, " m"],
    loss: Loss,
) -> RowBlocks:
    """`residuals.sign_reprojection` by camera pose, sign pose and relative change of size."""
    (R, p), (R_sign, p_sign) = _planes(blocks[0]), _planes(blocks[1])
    template, observation = constants
    corner = (template * blocks[2]).mT
    along = R_sign[:, 0] * corner[0], R_sign[:, 1] * corner[1]
    point = _turn(R, along[0] + along[1] + p_sign - p)
    error, by_camera = _observed(point, observation, weight)
    pose, gradient, rho = _pose_blocks(R, point, error, by_camera, loss)
    # The corner by the sign's turning about its axes, R_sign (w x corner), and by its size; moving it is the identity.
    x, y = corner
    normal = R_sign[:, 2]
    turned = torch.stack((normal * y, -normal * x, R_sign[:, 1] * x - R_sign[:, 0] * y), dim=1)
    N = torch.cat((turned, torch.stack(along, dim=1)), dim=1)
    by_point = -pose[:3]
    crossed = sum_of_products(by_point, N)
    squared = sum_of_products(N, -crossed[:3])
    sign = torch.cat(
        (
            torch.cat((pose[:3, :3], -crossed[:3, :3]), dim=1),
            torch.cat((-crossed[:3, :3].transpose(0, 1), squared[:3, :3]), dim=1),
        )
    )
    pulled = -_pulled(N, gradient[:3])
    return RowBlocks(
        rho,
        (gradient, torch.cat((-gradient[:3], pulled[:3])), pulled[3:]),
        {
            (0, 0): pose,
            (0, 1): torch.cat((-pose[:, :3], crossed[:, :3]), dim=1),
            (0, 2): crossed[:, 3:],
            (1, 1): sign,
            (1, 2): torch.cat((-crossed[:3, 3:], squared[:3, 3:])),
            (2, 2): squared[3:, 3:],
        },
    )


def lane_reprojection(
    T_world_camera: Float[Tensor, "m 4 4"],
    c0: Float[Tensor, "m 3"],
    c1: Float[Tensor, "m 3"],
    c2: Float[Tensor, "m 3"],
    c3: Float[Tensor, "m 3"],
    weights: Float[Tensor, "m 4"],
    normal_px: Float[Tensor, "m 2"],
    observation: Float[Tensor, "m 3 3"],
) -> Float[Tensor, "m 1"]:
    """`residuals.lane_reprojection` of many rows."""
    R, p = _planes(T_world_camera)
    offset = _spline_point((c0, c1, c2, c3), weights) - p
    error, _ = _project(_turn(R, offset), observation.permute(1, 2, 0))
    return (error.mT * normal_px).sum(-1, keepdim=True)


def lane_reprojection_blocks(
    blocks: tuple[Float[Tensor, "m 4 4"], Tensor, Tensor, Tensor, Tensor],
    constants: tuple[Float[Tensor, "m 4"], Float[Tensor, "m 2"], Float[Tensor, "m 3 3"]],
    weight: Float[Tensor, " m"],
    loss: Loss,
) -> RowBlocks:
    """`residuals.lane_reprojection` by camera pose and the four coefficients."""
    weights, normal_px, observation = constants
    R, p = _planes(blocks[0])
    point = _turn(R, _spline_point(blocks[1:], weights) - p)
    error, by_camera = _observed(point, observation, weight)
    normal = normal_px.mT
    along = (normal * error).sum(0)[None]
    by_camera = (normal[0] * by_camera[0]).addcmul_(normal[1], by_camera[1])[None]
    return _spline_blocks(_pose_blocks(R, point, along, by_camera, loss), weights)


def lane_height(
    T_world_camera: Float[Tensor, "m 4 4"],
    c0: Float[Tensor, "m 3"],
    c1: Float[Tensor, "m 3"],
    c2: Float[Tensor, "m 3"],
    c3: Float[Tensor, "m 3"],
    weights: Float[Tensor, "m 4"],
    road_normal_camera: Float[Tensor, "m 3"],
    camera_height: Float[Tensor, " m"],
) -> Float[Tensor, "m 1"]:
    """`residuals.lane_height` of many rows."""
    R, p = _planes(T_world_camera)
    point = _turn(R, _spline_point((c0, c1, c2, c3), weights) - p)
    return ((road_normal_camera.mT * point).sum(0) - camera_height)[:, None]


def lane_height_blocks(
    blocks: tuple[Float[Tensor, "m 4 4"], Tensor, Tensor, Tensor, Tensor],
    constants: tuple[Float[Tensor, "m 4"], Float[Tensor, "m 3"], Float[Tensor, " m"]],
    weight: Float[Tensor, " m"],
    loss: Loss,
) -> RowBlocks:
    """`residuals.lane_height` by camera pose and the four coefficients."""
    weights, normal, height = constants
    R, p = _planes(blocks[0])
    point = _turn(R, _spline_point(blocks[1:], weights) - p)
    by_camera = normal.mT * weight
    error = (by_camera * point).sum(0) - height * weight
    return _spline_blocks(_pose_blocks(R, point, error[None], by_camera[None], loss), weights)


def _spline_point(
    coefficients: tuple[Tensor, ...], weights: Float[Tensor, "m 4"]
) -> Float[Tensor, "3 m"]:
    """The point of a spline that its four coefficients make."""
    point = coefficients[0].mT * weights[:, 0]
    for i, coefficient in enumerate(coefficients[1:], 1):
        point = point + coefficient.mT * weights[:, i]
    return point


def _spline_blocks(
    of_pose: tuple[Float[Tensor, "6 6 m"], Float[Tensor, "6 m"], Float[Tensor, " m"]],
    weights: Float[Tensor, "m 4"],
) -> RowBlocks:
    """Blocks by pose and spline coefficients: each moves the point by its weight, the camera by minus one."""
    pose, gradient, rho = of_pose
    shares = weights.unbind(1)
    hessian = {(0, 0): pose}
    for i, share in enumerate(shares):
        weighted = pose[:, :3] * share
        hessian[0, i + 1] = -weighted
        for j in range(i, 4):
            hessian[i + 1, j + 1] = weighted[:3] * shares[j]
    by_point = -gradient[:3]
    return RowBlocks(rho, (gradient, *(by_point * share for share in shares)), hessian)


def pose_deviation(
    T_world_camera: Float[Tensor, "m 4 4"],
    drift: Float[Tensor, "m 6"],
    prior: Float[Tensor, "m 4 4"],
) -> Float[Tensor, "m 6"]:
    """`residuals.pose_deviation` of many rows."""
    return pose_prior(T_world_camera, prior) - drift


def pose_deviation_blocks(
    blocks: tuple[Float[Tensor, "m 4 4"], Float[Tensor, "m 6"]],
    constants: tuple[Float[Tensor, "m 4 4"]],
    weight: Float[Tensor, "m 6"],
    loss: Loss,
) -> RowBlocks:
    """`residuals.pose_deviation` by pose and drift."""
    error, w = _deviation(_planes(constants[0]), _planes(blocks[0])), weight.mT
    B = _right_jacobian_inverse(error[3:])
    error = error - blocks[1].mT
    s = (error * w).square().sum(0)
    square = w.square() * loss.weight(s)
    pulled = square * error
    hessian, crossed, own = (error.new_zeros(6, 6, error.shape[1]) for _ in range(3))
    three, six = torch.arange(3), torch.arange(6)
    hessian[three, three], crossed[three, three], own[six, six] = square[:3], -square[:3], square
    weighted = B * square[3:, None]
    hessian[3:, 3:] = sum_of_products(weighted, B)
    crossed[3:, 3:] = -weighted.transpose(0, 1)
    by_pose = torch.cat((pulled[:3], _turn(B, pulled[3:])))
    return RowBlocks(
        loss.rho(s), (by_pose, -pulled), {(0, 0): hessian, (0, 1): crossed, (1, 1): own}
    )


def _pulled(N: Float[Tensor, "3 k m"], v: Float[Tensor, "3 m"]) -> Float[Tensor, "k m"]:
    """`N^T v` of every row."""
    return sum_of_products(N, v[:, None]).squeeze(1)


def _turn(R_a_b: Float[Tensor, "3 3 m"], v_a: Float[Tensor, "3 m"]) -> Float[Tensor, "3 m"]:
    """Vectors of frame a in frame b: `R_a_b^T v_a`."""
    return (R_a_b[0] * v_a[0]).addcmul_(R_a_b[1], v_a[1]).addcmul_(R_a_b[2], v_a[2])


def _project(
    point: Float[Tensor, "3 m"], M: Float[Tensor, "3 3 m"]
) -> tuple[Float[Tensor, "2 m"], Float[Tensor, " m"]]:
    """Pixel errors of camera-frame points, and their depths in the observation's frame."""
    u = (M[:, 0] * point[0]).addcmul_(M[:, 1], point[1]).addcmul_(M[:, 2], point[2])
    depth = u[2].clamp_min(MIN_DEPTH)
    return u[:2] / depth, depth


def _observed(
    point: Float[Tensor, "3 m"], observation: Float[Tensor, "m 3 3"], weight: Float[Tensor, " m"]
) -> tuple[Float[Tensor, "2 m"], Float[Tensor, "2 3 m"]]:
    """Whitened pixel errors of camera-frame points, and their derivatives by the points."""
    M = observation.permute(1, 2, 0).contiguous()
    error, depth = _project(point, M)
    error = error * weight
    # Where the depth is held it has no part in the derivative.
    slope = torch.where(depth > MIN_DEPTH, error, 0.0)
    return error, (M[:2] * weight - slope[:, None] * M[2]) / depth


def _pose_blocks(
    R: Float[Tensor, "3 3 m"],
    point: Float[Tensor, "3 m"],
    error: Float[Tensor, "d m"],
    by_camera: Float[Tensor, "d 3 m"],
    loss: Loss,
) -> tuple[Float[Tensor, "6 6 m"], Float[Tensor, "6 m"], Float[Tensor, " m"]]:
    """Hessian and gradient by camera pose of residuals of a camera-frame point, and their losses."""
    s = error.square().sum(0)
    robust = loss.weight(s)
    x, y, z = by_camera.unbind(1)
    moved = x[:, None] * R[:, 0]
    moved.addcmul_(y[:, None], R[:, 1]).addcmul_(z[:, None], R[:, 2]).neg_()
    turned = (
        y * point[2] - z * point[1],
        z * point[0] - x * point[2],
        x * point[1] - y * point[0],
    )
    J = torch.cat((moved, torch.stack(turned, dim=1)), dim=1)
    JW = J * robust
    hessian = JW[0, :, None] * J[0]
    gradient = JW[0] * error[0]
    for i in range(1, len(J)):
        hessian.addcmul_(JW[i, :, None], J[i])
        gradient.addcmul_(JW[i], error[i])
    return hessian, gradient, loss.rho(s)


def pose_prior(
    T_world_camera: Float[Tensor, "m 4 4"], prior: Float[Tensor, "m 4 4"]
) -> Float[Tensor, "m 6"]:
    """`residuals.pose_prior` of many rows."""
    return _deviation(_planes(prior), _planes(T_world_camera)).mT


def relative_pose(
    T_world_from: Float[Tensor, "m 4 4"],
    T_world_to: Float[Tensor, "m 4 4"],
    measured: Float[Tensor, "m 4 4"],
) -> Float[Tensor, "m 6"]:
    """`residuals.relative_pose` of many rows."""
    step = _step(_planes(T_world_from), _planes(T_world_to))
    return _deviation(_planes(measured), step).mT


def pose_prior_blocks(
    blocks: tuple[Float[Tensor, "m 4 4"]],
    constants: tuple[Float[Tensor, "m 4 4"]],
    weight: Float[Tensor, "m 6"],
    loss: Loss,
) -> RowBlocks:
    """`residuals.pose_prior` by the pose."""
    error, w = _deviation(_planes(constants[0]), _planes(blocks[0])), weight.mT
    turned = error[3:]
    s = (error * w).square().sum(0)
    square = w.square() * loss.weight(s)
    B = _right_jacobian_inverse(turned)
    hessian = error.new_zeros(6, 6, error.shape[1])
    hessian[(0, 1, 2), (0, 1, 2)] = square[:3]
    hessian[3:, 3:] = sum_of_products(B * square[3:, None], B)
    pulled = square * error
    gradient = torch.cat((pulled[:3], _turn(B, pulled[3:])))
    return RowBlocks(loss.rho(s), (gradient,), {(0, 0): hessian})


def pose_prior_gradient(
    blocks: tuple[Float[Tensor, "m 4 4"]],
    constants: tuple[Float[Tensor, "m 4 4"]],
    weight: Float[Tensor, "m 6"],
    loss: Loss,
) -> RowGradients:
    """The gradient alone of `pose_prior_blocks`."""
    error, w = _deviation(_planes(constants[0]), _planes(blocks[0])), weight.mT
    s = (error * w).square().sum(0)
    pulled = error * w.square() * loss.weight(s)
    gradient = torch.cat((pulled[:3], _pulled_back(error[3:], pulled[3:])))
    return RowGradients(loss.rho(s), (gradient,))


def relative_pose_gradient(
    blocks: tuple[Float[Tensor, "m 4 4"], Float[Tensor, "m 4 4"]],
    constants: tuple[Float[Tensor, "m 4 4"]],
    weight: Float[Tensor, "m 6"],
    loss: Loss,
) -> RowGradients:
    """The gradient alone of `relative_pose_blocks`."""
    R_from, _ = T_from = _planes(blocks[0])
    R_from_to, step = moved = _step(T_from, _planes(blocks[1]))
    error, w = _deviation(_planes(constants[0]), moved), weight.mT
    s = (error * w).square().sum(0)
    pulled = error * w.square() * loss.weight(s)
    force = _turn(R_from.transpose(0, 1), pulled[:3])
    turn = _pulled_back(error[3:], pulled[3:])
    turn_from = torch.linalg.cross(pulled[:3], step, dim=0) - _turn(R_from_to.transpose(0, 1), turn)
    return RowGradients(loss.rho(s), (torch.cat((-force, turn_from)), torch.cat((force, turn))))


def relative_pose_blocks(
    blocks: tuple[Float[Tensor, "m 4 4"], Float[Tensor, "m 4 4"]],
    constants: tuple[Float[Tensor, "m 4 4"]],
    weight: Float[Tensor, "m 6"],
    loss: Loss,
) -> RowBlocks:
    """`residuals.relative_pose` by the two poses."""
    R_from, _ = T_from = _planes(blocks[0])
    R_from_to, step = moved = _step(T_from, _planes(blocks[1]))
    error, w = _deviation(_planes(constants[0]), moved), weight.mT
    turned = error[3:]
    s = (error * w).square().sum(0)
    square = w.square() * loss.weight(s)
    pulled = square * error
    # Rows of translation: -A and the cross product with the step for the first pose, A for the second. Rows of rotation:
    # -B R_from_to^T for the first pose, B for the second.
    A, B = R_from.transpose(0, 1), _right_jacobian_inverse(turned)
    BC = sum_of_products(B.transpose(0, 1), R_from_to.transpose(0, 1))
    S = _skew(step)
    WA, WB, WS = A * square[:3, None], B * square[3:, None], S * square[:3, None]
    along, turn_to = sum_of_products(WA, A), sum_of_products(WB, B)
    by_to = along.new_zeros(6, 6, along.shape[2])
    by_to[:3, :3], by_to[3:, 3:] = along, turn_to
    across = torch.zeros_like(by_to)
    swing = sum_of_products(WS, A)
    across[:3, :3], across[3:, :3] = -along, swing
    turn = sum_of_products(WB, BC)
    across[3:, 3:] = -turn.transpose(0, 1)
    by_from = torch.zeros_like(by_to)
    by_from[:3, :3], by_from[3:, :3], by_from[:3, 3:] = along, -swing, -swing.transpose(0, 1)
    by_from[3:, 3:] = sum_of_products(WS, S) + sum_of_products(BC * square[3:, None], BC)
    shift = _turn(A, pulled[:3])
    return RowBlocks(
        loss.rho(s),
        (
            torch.cat((-shift, _turn(S, pulled[:3]) - _turn(BC, pulled[3:]))),
            torch.cat((shift, _turn(B, pulled[3:]))),
        ),
        {(0, 0): by_from, (0, 1): across, (1, 1): by_to},
    )


def _planes(T: Float[Tensor, "m 4 4"]) -> tuple[Float[Tensor, "3 3 m"], Float[Tensor, "3 m"]]:
    """Rotation and translation of transforms, rows last."""
    planes = T[:, :3].permute(1, 2, 0).contiguous()
    return planes[:, :3], planes[:, 3]


def _step(
    T_world_from: tuple[Tensor, Tensor], T_world_to: tuple[Tensor, Tensor]
) -> tuple[Float[Tensor, "3 3 m"], Float[Tensor, "3 m"]]:
    """Rotation and translation of the second frame in the first."""
    (R_from, p_from), (R_to, p_to) = T_world_from, T_world_to
    return sum_of_products(R_from, R_to), _turn(R_from, p_to - p_from)


def _deviation(T_from: tuple[Tensor, Tensor], T_to: tuple[Tensor, Tensor]) -> Float[Tensor, "6 m"]:
    """`se3.local`, rows last."""
    (R_from, p_from), (R_to, p_to) = T_from, T_to
    return torch.cat((p_to - p_from, _log(sum_of_products(R_from, R_to))))


def _skew(v: Float[Tensor, "3 m"]) -> Float[Tensor, "3 3 m"]:
    """The matrix of the cross product."""
    S = v.new_zeros(3, 3, v.shape[1])
    S[(2, 0, 1), (1, 2, 0)] = v
    S[(1, 2, 0), (2, 0, 1)] = -v
    return S


def _log(R: Float[Tensor, "3 3 m"]) -> Float[Tensor, "3 m"]:
    """Rotation vectors of rotation matrices."""
    # R - R^T is twice the sine of the angle about the axis: sound up to a right angle, and no square root needed there.
    twice = torch.stack((R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]))
    cosine = (R[0, 0] + R[1, 1] + R[2, 2] - 1) / 2
    if bool((cosine < 0.1).any()):
        return se3.so3_log(R.permute(2, 0, 1)).mT
    square = twice.square().sum(0)
    small = square < 4e-8
    # Double `where`: the root at zero has no gradient.
    sine = torch.where(small, 1.0, square).sqrt() / 2
    factor = torch.where(small, 1 + square / 24, torch.atan2(sine, cosine) / sine)
    return twice / 2 * factor


def _pulled_back(w: Float[Tensor, "3 m"], v: Float[Tensor, "3 m"]) -> Float[Tensor, "3 m"]:
    """The transposed inverse right Jacobian at `w` times `v`, without the matrix."""
    factor = _curvature(w.square().sum(0))
    across = torch.linalg.cross(w, v, dim=0)
    return v - across / 2 + torch.linalg.cross(w, across, dim=0) * factor


def _curvature(theta_sq: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
    """Factor of the squared term in the inverse right Jacobian, by the squared angle."""
    # Bernoulli numbers' series: the next term is below 1e-13 up to a tenth of a radian.
    factor = 1 / 12 + theta_sq * (1 / 720 + theta_sq * (1 / 30240 + theta_sq / 1209600))
    small = theta_sq < 0.01
    if not bool(small.all()):
        theta = torch.where(small, 1.0, theta_sq).sqrt()
        closed = (1 - theta * (1 + theta.cos()) / (2 * theta.sin())) / theta.square()
        factor = torch.where(small, factor, closed)
    return factor


def _right_jacobian_inverse(w: Float[Tensor, "3 m"]) -> Float[Tensor, "3 3 m"]:
    """`residuals.right_jacobian_inverse`, rows last."""
    theta_sq = w.square().sum(0)
    factor = _curvature(theta_sq)
    # W W = w w^T - |w|^2 I.
    J = _skew(w / 2) + w[:, None] * w * factor
    J[(0, 1, 2), (0, 1, 2)] += 1 - theta_sq * factor
    return J
