"""Rigid transforms as 4 x 4 matrices, and the tangent space that the optimiser works in.

A tangent vector is `(t, w)`: a translation along the *world* axes [m] and a rotation about the *body* axes [rad].
The two are decoupled: `retract(T, (t, w)) = [R exp(w), p + t]`. A bias of a positioning module is a constant `t`,
a tilted camera mount a constant `w`, wherever the car drives and whichever way it heads.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

_SERIES_BELOW = 1e-6
"""Squared angle below which Taylor series replace the closed forms; (t - sin t) / t^3 cancels below about 1e-4."""


def skew(w: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The matrix of the cross product, `skew(w) @ p == cross(w, p)`."""
    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    rows = (zero, -z, y, z, zero, -x, -y, x, zero)
    return torch.stack(rows, dim=-1).reshape(*w.shape[:-1], 3, 3)


def so3_exp(w: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrix of a rotation vector [rad] (Rodrigues); value and derivatives are finite at zero."""
    x, y, z = w.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    theta_sq = xx + yy + zz
    small = theta_sq < _SERIES_BELOW
    # Double `where`: the branch that is not taken must stay finite too, or its gradient turns into NaN.
    theta = torch.where(small, torch.ones_like(theta_sq), theta_sq).sqrt()
    a = torch.where(small, 1 - theta_sq / 6, theta.sin() / theta)
    b = torch.where(small, 0.5 - theta_sq / 24, (1 - theta.cos()) / theta.square())
    ax, ay, az = a * x, a * y, a * z
    xy, xz, yz = b * x * y, b * x * z, b * y * z
    rows = (
        *(1 - b * (yy + zz), xy - az, xz + ay),
        *(xy + az, 1 - b * (xx + zz), yz - ax),
        *(xz - ay, yz + ax, 1 - b * (xx + yy)),
    )
    return torch.stack(rows, dim=-1).reshape(*w.shape[:-1], 3, 3)


def so3_log(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3"]:
    """Rotation vector [rad] of a rotation matrix, of length at most pi."""
    quaternion = to_quaternion(R)
    v, w = quaternion[..., :3], quaternion[..., 3:]
    # q and -q are one rotation: the one with w >= 0 is the shorter way round.
    sign = torch.where(w < 0, -torch.ones_like(w), torch.ones_like(w))
    v, w = v * sign, w * sign
    sin_sq = v.square().sum(-1, keepdim=True)
    small = sin_sq < _SERIES_BELOW
    sin_half = torch.where(small, torch.ones_like(sin_sq), sin_sq).sqrt()
    half = torch.atan2(sin_half, w)
    return v * torch.where(
        small,
        2 / w.clamp_min(0.5) * (1 - sin_sq / w.clamp_min(0.5).square() / 3),
        2 * half / sin_half,
    )


def right_jacobian_inverse(w: Float[Tensor, "3 *#rows"]) -> Float[Tensor, "3 3 *#rows"]:
    """Inverse right Jacobian of SO(3): `log(exp(w) exp(d)) = w + J d` to first order (Chirikjian 2012).

    The rows come last, as in residuals, which alone take it.
    """
    x, y, z = w / 2
    theta_sq = w.square().sum(0)
    # Bernoulli numbers' series below a tenth of a radian, where the next term is below 1e-13.
    small = theta_sq < 0.01
    factor = 1 / 12 + theta_sq * (1 / 720 + theta_sq * (1 / 30240 + theta_sq / 1209600))
    # Errors of poses are small: nearly always that is all.
    if not bool(small.all()):
        theta = torch.where(small, torch.ones_like(theta_sq), theta_sq).sqrt()
        closed = (1 - theta * (1 + theta.cos()) / (2 * theta.sin())) / theta.square()
        factor = torch.where(small, factor, closed)
    # I + W / 2 + factor W W, where W W = w w^T - |w|^2 I.
    a = 4 * factor
    xx, yy, zz = a * x * x, a * y * y, a * z * z
    xy, xz, yz = a * x * y, a * x * z, a * y * z
    rows = (
        *(1 - yy - zz, xy - z, xz + y),
        *(xy + z, 1 - xx - zz, yz - x),
        *(xz - y, yz + x, 1 - xx - yy),
    )
    return torch.stack(rows).unflatten(0, (3, 3))


def make(
    R: Float[Tensor, "*batch 3 3"], p: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 4 4"]:
    """The transform with rotation `R` and translation `p`."""
    top = torch.cat((R, p[..., None]), dim=-1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1
    return torch.cat((top, bottom), dim=-2)


def exp(xi: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    """The transform at tangent `(t, w)` from the identity; the two parts are decoupled."""
    return make(so3_exp(xi[..., 3:]), xi[..., :3])


def log(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 6"]:
    """The tangent `(t, w)` of a transform, the inverse of `exp` for angles below pi."""
    return torch.cat((T[..., :3, 3], so3_log(T[..., :3, :3])), dim=-1)


def retract(
    T: Float[Tensor, "*batch 4 4"], xi: Float[Tensor, "*batch 6"]
) -> Float[Tensor, "*batch 4 4"]:
    """`T` moved by the tangent `(t, w)`: translation along world axes, rotation about body axes."""
    return make(T[..., :3, :3] @ so3_exp(xi[..., 3:]), T[..., :3, 3] + xi[..., :3])


def pull(
    T: Float[Tensor, "4 4 *#rows"], gradient: Float[Tensor, "d 4 4 *#rows"]
) -> Float[Tensor, "d 6 *#rows"]:
    """Derivatives by the tangent of `retract` at zero, of those by the entries of `T`; the rows come last.

    A turn by w adds `R skew(w)` to R, so its derivative is the axis of `R^T G - (R^T G)^T`, G being those by R.
    """
    R, by_R = T[:3, :3], gradient[:, :3, :3]

    def entry(i: int, j: int) -> Tensor:
        total = torch.addcmul(R[0, i] * by_R[:, 0, j], R[1, i], by_R[:, 1, j])
        return torch.addcmul(total, R[2, i], by_R[:, 2, j])

    turn = (entry(2, 1) - entry(1, 2), entry(0, 2) - entry(2, 0), entry(1, 0) - entry(0, 1))
    return torch.cat((gradient[:, :3, 3], torch.stack(turn, dim=1)), dim=1)


def local(
    T_from: Float[Tensor, "*batch 4 4"], T_to: Float[Tensor, "*batch 4 4"]
) -> Float[Tensor, "*batch 6"]:
    """The tangent that moves `T_from` to `T_to`: what `retract` needs to get there."""
    rotation = T_from[..., :3, :3].mT @ T_to[..., :3, :3]
    return torch.cat((T_to[..., :3, 3] - T_from[..., :3, 3], so3_log(rotation)), dim=-1)


def inverse(T: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """`T_b_a` of `T_a_b`."""
    R_t = T[..., :3, :3].mT
    return make(R_t, -(R_t @ T[..., :3, 3:])[..., 0])


def transform(
    T_a_b: Float[Tensor, "*#batch 4 4"], p_b: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*#batch 3"]:
    """Points of frame b in frame a; the leading dimensions broadcast."""
    return (T_a_b[..., :3, :3] @ p_b[..., None])[..., 0] + T_a_b[..., :3, 3]


def rotate(
    T_a_b: Float[Tensor, "*#batch 4 4"], ray_b: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*#batch 3"]:
    """Directions of frame b in frame a; the leading dimensions broadcast."""
    return (T_a_b[..., :3, :3] @ ray_b[..., None])[..., 0]


def mean(
    T: Float[Tensor, "n 4 4"], weight: Float[Tensor, " n"] | None = None, *, iterations: int = 10
) -> Float[Tensor, "4 4"]:
    """The weighted mean of transforms: of positions, and of rotations in the geodesic sense (Karcher mean)."""
    weight = torch.ones_like(T[:, 0, 0]) if weight is None else weight
    share = (weight / weight.sum())[:, None]
    centre = T[weight.argmax()]
    for _ in range(iterations):
        centre = retract(centre, (share * local(centre.expand_as(T), T)).sum(0))
    return centre


def from_quaternion(q_xyzw: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrix of a Hamilton quaternion `qx qy qz qw`, normalised first."""
    x, y, z, w = torch.nn.functional.normalize(q_xyzw, dim=-1).unbind(-1)
    rows = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack(rows, dim=-1).reshape(*q_xyzw.shape[:-1], 3, 3)


def to_quaternion(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit Hamilton quaternion `qx qy qz qw` with qw >= 0 of a rotation matrix.

    Of the four ways to compute it the one with the largest pivot is taken (Shepperd 1978), so none divides by zero.
    """
    m = R.flatten(-2).unbind(-1)
    pivots = torch.stack(
        (
            1 + m[0] - m[4] - m[8],
            1 - m[0] + m[4] - m[8],
            1 - m[0] - m[4] + m[8],
            1 + m[0] + m[4] + m[8],
        ),
        dim=-1,
    )
    x = torch.stack((pivots[..., 0], m[1] + m[3], m[2] + m[6], m[7] - m[5]), dim=-1)
    y = torch.stack((m[1] + m[3], pivots[..., 1], m[5] + m[7], m[2] - m[6]), dim=-1)
    z = torch.stack((m[2] + m[6], m[5] + m[7], pivots[..., 2], m[3] - m[1]), dim=-1)
    w = torch.stack((m[7] - m[5], m[2] - m[6], m[3] - m[1], pivots[..., 3]), dim=-1)
    candidates = torch.stack((x, y, z, w), dim=-2)
    choice = pivots.argmax(-1)[..., None, None].expand(*pivots.shape[:-1], 1, 4)
    q = torch.nn.functional.normalize(candidates.gather(-2, choice)[..., 0, :], dim=-1)
    return q * torch.where(q[..., 3:] < 0, -1.0, 1.0).to(q)


def orthonormalise(R: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The rotation nearest to a matrix that is almost one (polar decomposition)."""
    u, _, vh = torch.linalg.svd(R)
    sign = torch.ones_like(R[..., 0])
    sign[..., 2] = torch.linalg.det(u @ vh)
    return u @ (sign[..., None] * vh)
