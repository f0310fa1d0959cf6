"""The epipolar constraint between two cameras whose poses are known (IV-A)."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.geometry import se3


def fundamental(
    T_world_a: Float[Tensor, "*#batch 4 4"], T_world_b: Float[Tensor, "*#batch 4 4"]
) -> Float[Tensor, "*#batch 3 3"]:
    """The matrix F_ab with `p_a^T F_ab q_b = 0` for two views p, q of one point (IV-A).

    Points are ideal (undistorted, on the plane z = 1), so this is the essential matrix: the
    fundamental matrix of two cameras with K = I. Its norm is the baseline [m] times sqrt(2);
    without a baseline it is zero and says nothing.
    """
    return fundamental_of_motion(se3.inverse(T_world_a) @ T_world_b)


def fundamental_of_motion(T_a_b: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 3 3"]:
    """`fundamental` of two views of which the second has this pose in the first."""
    return se3.skew(T_a_b[..., :3, 3]) @ T_a_b[..., :3, :3]


def epipolar_cost(
    F_ab: Float[Tensor, "*#batch 3 3"],
    p_a: Float[Tensor, "*#batch k"],
    q_b: Float[Tensor, "*#batch k"],
    *,
    components: Literal[2, 3] = 2,
) -> Float[Tensor, "*#batch"]:
    """The cost `|p^T F q|^2 / (|F^T p|^2 + |F q|^2)` of two detections being one point (IV-A).

    Points are ideal, with or without their third coordinate 1. With 2 `components` in the norms of
    the denominator the cost is Sampson's: to first order the squared distance, summed over both
    images, by which the detections must move to satisfy the constraint; times the squared focal
    length it is in px^2. With 3 it is the formula as the paper prints it, which is smaller by a
    factor that grows with the distance of the epipolar line from the image centre. The cost does
    not depend on the length of the baseline, and is zero where there is none.
    """
    p, q = _homogeneous(p_a), _homogeneous(q_b)
    line_a = (F_ab @ q[..., None])[..., 0]
    line_b = (F_ab.mT @ p[..., None])[..., 0]
    value = (p * line_a).sum(-1)
    norms = line_a[..., :components].square().sum(-1) + line_b[..., :components].square().sum(-1)
    tiny = torch.finfo(norms.dtype).tiny
    return value.square() / norms.clamp_min(tiny)


def _homogeneous(p: Tensor) -> Tensor:
    if p.shape[-1] == 3:
        return p
    return torch.cat((p, torch.ones_like(p[..., :1])), dim=-1)
