"""What holds camera poses: the positioning module's word, odometry, and the drift between them (V-B, footnote).

Errors of poses are tangents of geometry.se3: translation along the world axes [m], rotation about the body axes [rad].
As in `reprojection`: a residual for one observation, which many pass through with the rows last, and its Jacobians.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.optim.linearize import sum_of_products
from crowdmap_torch.optim.problem import Jacobian, SparseJacobian
from crowdmap_torch.residuals.reprojection import components


def pose_prior(
    T_world_camera: Float[Tensor, "4 4 *#rows"], prior: Float[Tensor, "4 4 *#rows"]
) -> Float[Tensor, "6 *#rows"]:
    """Deviation of a pose from its prior: along the world axes, and about the body axes (V-B, footnote)."""
    turn = _turn(prior, T_world_camera)
    return torch.cat((T_world_camera[:3, 3] - prior[:3, 3], _log(turn)))


def pose_deviation(
    T_world_camera: Float[Tensor, "4 4 *#rows"],
    drift: Float[Tensor, "_ *#rows"],
    prior: Float[Tensor, "4 4 *#rows"],
) -> Float[Tensor, "6 *#rows"]:
    """What is left of a frame's pose error after the slow drift: the module's white noise (V-B, footnote).

    Of the drift six numbers count.

    The error is the tangent from the prior pose to the pose. Absolute regularisation acts through the drift, relative
    regularisation between frames through the chain that the drift forms.
    """
    return pose_prior(T_world_camera, prior) - drift[:6]


def relative_pose(
    T_world_from: Float[Tensor, "4 4 *#rows"],
    T_world_to: Float[Tensor, "4 4 *#rows"],
    measured: Float[Tensor, "4 4 *#rows"],
) -> Float[Tensor, "6 *#rows"]:
    """Deviation of a relative pose from the `measured` pose of the second frame in the first (V-B, footnote)."""
    R_from_to, step = _step(T_world_from, T_world_to)
    return torch.cat((step - measured[:3, 3], _log(_turn(measured, R_from_to))))


def gauss_markov_start(
    state: Float[Tensor, "k *#rows"], mean: Float[Tensor, "k *#rows"]
) -> Float[Tensor, "k *#rows"]:
    """How far the first state of a Gauss-Markov chain is from its mean: a journey's drift from its constant bias."""
    return state - mean


def gauss_markov_step(
    before: Float[Tensor, "b *#rows"],
    after: Float[Tensor, "a *#rows"],
    mean: Float[Tensor, "k *#rows"],
    keep: Float[Tensor, "k *#rows"],
) -> Float[Tensor, "k *#rows"]:
    """Innovation of a Gauss-Markov chain from one place to the next, which the share `keep` of what was is left at.

    What is cut has a number behind its state that is none of it (`parting_before_cut`).
    """
    k = len(keep)
    return after[:k] - mean - keep * (before[:k] - mean)


def wandering_start(
    state: Float[Tensor, "k *#rows"], mean: Float[Tensor, "6 *#rows"]
) -> Float[Tensor, "9 *#rows"]:
    """How far the first state of a drift is from a bias that wanders, and that from its mean.

    The state is the pose error (6) and how far the bias of the position is from its `mean` there (3).
    """
    wander = state[6:9]
    return torch.cat((state[:3] - wander - mean[:3], state[3:6] - mean[3:], wander))


def wandering_step(
    before: Float[Tensor, "b *#rows"],
    after: Float[Tensor, "a *#rows"],
    mean: Float[Tensor, "6 *#rows"],
    keep: Float[Tensor, "9 *#rows"],
) -> Float[Tensor, "9 *#rows"]:
    """Innovations of a drift about a bias that wanders, and of that, as in `wandering_start`."""
    return wandering_start(after, mean) - keep * wandering_start(before, mean)


def sideways_parting(
    before: Float[Tensor, "k *#rows"],
    after: Float[Tensor, "k *#rows"],
    seen: Float[Tensor, "*#rows"],
    by_before: Float[Tensor, "k *#rows"],
    by_after: Float[Tensor, "k *#rows"],
) -> Float[Tensor, "1 *#rows"]:
    """How far measured and reckoned path part sideways from knot to knot, once drift and slip are taken off [m]."""
    return seen + (by_before * before + by_after * after).sum(0, keepdim=True)


def parting_of_course(
    before: Float[Tensor, "k *#rows"],
    after: Float[Tensor, "k *#rows"],
    stance: Float[Tensor, "2 *#rows"],
    seen: Float[Tensor, "*#rows"],
    of_before: Float[Tensor, "6 *#rows"],
    of_after: Float[Tensor, "6 *#rows"],
    of_stance: Float[Tensor, "2 *#rows"],
) -> Float[Tensor, "1 *#rows"]:
    """`sideways_parting` where slip and lever are the same along the drive, and drifts may have more numbers than a pose."""
    of_drift = of_before * before[:6] + of_after * after[:6]
    return seen + of_drift.sum(0, keepdim=True) + (of_stance * stance).sum(0, keepdim=True)


def parting_before_cut(
    before: Float[Tensor, "k *#rows"],
    cut: Float[Tensor, "c *#rows"],
    stance: Float[Tensor, "2 *#rows"],
    seen: Float[Tensor, "*#rows"],
    of_before: Float[Tensor, "6 *#rows"],
    of_stance: Float[Tensor, "2 *#rows"],
) -> Float[Tensor, "1 *#rows"]:
    """`parting_of_course` as far as is known before a cut, less what the cut has of it: its last number."""
    of_drift = (of_before * before[:6]).sum(0, keepdim=True)
    return seen + of_drift + (of_stance * stance).sum(0, keepdim=True) - cut[-1:]


def parting_behind_cut(
    cut: Float[Tensor, "c *#rows"],
    after: Float[Tensor, "k *#rows"],
    of_after: Float[Tensor, "6 *#rows"],
) -> Float[Tensor, "1 *#rows"]:
    """What the cut has of `parting_of_course`, and what the drift behind it adds."""
    return cut[-1:] + (of_after * after[:6]).sum(0, keepdim=True)


def pose_prior_jacobian(
    T_world_camera: Float[Tensor, "4 4 m"], prior: Float[Tensor, "4 4 m"]
) -> tuple[Float[Tensor, "6 m"], tuple[SparseJacobian]]:
    """`pose_prior` and its Jacobian by the pose."""
    error = pose_prior(T_world_camera, prior)
    moved = SparseJacobian.diagonal(torch.ones_like(error[:3])).rows
    turned = ((3, row) for row in se3.right_jacobian_inverse(error[3:]))
    return error, (SparseJacobian(6, (*moved, *turned)),)


def pose_deviation_jacobian(
    T_world_camera: Float[Tensor, "4 4 m"],
    drift: Float[Tensor, "k m"],
    prior: Float[Tensor, "4 4 m"],
) -> tuple[Float[Tensor, "6 m"], tuple[Jacobian, Jacobian]]:
    """`pose_deviation` and its Jacobians by pose and drift."""
    error, (by_pose,) = pose_prior_jacobian(T_world_camera, prior)
    by_drift = SparseJacobian.diagonal(-torch.ones_like(drift[:6]))
    return error - drift[:6], (by_pose, SparseJacobian(len(drift), by_drift.rows))


def relative_pose_jacobian(
    T_world_from: Float[Tensor, "4 4 m"],
    T_world_to: Float[Tensor, "4 4 m"],
    measured: Float[Tensor, "4 4 m"],
) -> tuple[Float[Tensor, "6 m"], tuple[Jacobian, Jacobian]]:
    """`relative_pose` and its Jacobians by the two poses."""
    R_from_to, step = _step(T_world_from, T_world_to)
    error = torch.cat((step - measured[:3, 3], _log(_turn(measured, R_from_to))))
    A, B = T_world_from[:3, :3].transpose(0, 1), se3.right_jacobian_inverse(error[3:])
    C = -sum_of_products(B.transpose(0, 1), R_from_to.transpose(0, 1))
    # A turn w of the first frame moves the step by step x w.
    (x, y, z), none = step, torch.zeros_like(step[0])
    swung = torch.stack((none, -z, y, z, none, -x, -y, x, none)).unflatten(0, (3, 3))
    by_from = (*((0, row) for row in torch.cat((-A, swung), dim=1)), *((3, row) for row in C))
    by_to = (*((0, row) for row in A), *((3, row) for row in B))
    return error, (SparseJacobian(6, by_from), SparseJacobian(6, by_to))


def gauss_markov_step_jacobian(
    before: Float[Tensor, "b m"],
    after: Float[Tensor, "a m"],
    mean: Float[Tensor, "k m"],
    keep: Float[Tensor, "k m"],
) -> tuple[Float[Tensor, "k m"], tuple[Jacobian, ...]]:
    """`gauss_markov_step` and its Jacobians by the two states and the mean."""
    by = ((before, -keep), (after, torch.ones_like(keep)), (mean, keep - 1))
    error = gauss_markov_step(before, after, mean, keep)
    return error, tuple(
        SparseJacobian(len(of), SparseJacobian.diagonal(entries).rows) for of, entries in by
    )


def wandering_step_jacobian(
    before: Float[Tensor, "b m"],
    after: Float[Tensor, "a m"],
    mean: Float[Tensor, "6 m"],
    keep: Float[Tensor, "9 m"],
) -> tuple[Float[Tensor, "9 m"], tuple[Jacobian, ...]]:
    """`wandering_step` and its Jacobians by the two states and the mean."""
    one, none = torch.ones_like(keep), torch.zeros_like(keep[:3])

    def by_state(state: Tensor, factor: Float[Tensor, "9 m"]) -> SparseJacobian:
        diagonal = SparseJacobian.diagonal(factor).rows
        # Position and wander of an axis are six apart.
        drawn = (
            (i, torch.cat((factor[i : i + 1], none, none[:2], -factor[i : i + 1])))
            for i in range(3)
        )
        return SparseJacobian(len(state), (*drawn, *diagonal[3:]))

    of_mean = SparseJacobian.diagonal((keep - 1)[:6]).rows
    by_mean = SparseJacobian(6, (*of_mean, *((0, none[:1]) for _ in range(3))))
    error = wandering_step(before, after, mean, keep)
    return error, (by_state(before, -keep), by_state(after, one), by_mean)


def parting_of_course_jacobian(
    before: Float[Tensor, "k m"],
    after: Float[Tensor, "k m"],
    stance: Float[Tensor, "2 m"],
    seen: Float[Tensor, " m"],
    of_before: Float[Tensor, "6 m"],
    of_after: Float[Tensor, "6 m"],
    of_stance: Float[Tensor, "2 m"],
) -> tuple[Float[Tensor, "1 m"], tuple[Jacobian, ...]]:
    """`parting_of_course` and its Jacobians by the two drifts and the stance."""
    error = parting_of_course(before, after, stance, seen, of_before, of_after, of_stance)
    of_drifts = (SparseJacobian(len(before), ((0, by),)) for by in (of_before, of_after))
    return error, (*of_drifts, SparseJacobian(2, ((0, of_stance),)))


def parting_before_cut_jacobian(
    before: Float[Tensor, "k m"],
    cut: Float[Tensor, "c m"],
    stance: Float[Tensor, "2 m"],
    seen: Float[Tensor, " m"],
    of_before: Float[Tensor, "6 m"],
    of_stance: Float[Tensor, "2 m"],
) -> tuple[Float[Tensor, "1 m"], tuple[Jacobian, ...]]:
    """`parting_before_cut` and its Jacobians by the drift, the cut and the stance."""
    error = parting_before_cut(before, cut, stance, seen, of_before, of_stance)
    last = SparseJacobian(len(cut), ((len(cut) - 1, -torch.ones_like(error)),))
    of_drift = SparseJacobian(len(before), ((0, of_before),))
    return error, (of_drift, last, SparseJacobian(2, ((0, of_stance),)))


def parting_behind_cut_jacobian(
    cut: Float[Tensor, "c m"], after: Float[Tensor, "k m"], of_after: Float[Tensor, "6 m"]
) -> tuple[Float[Tensor, "1 m"], tuple[Jacobian, ...]]:
    """`parting_behind_cut` and its Jacobians by the cut and the drift."""
    error = parting_behind_cut(cut, after, of_after)
    last = SparseJacobian(len(cut), ((len(cut) - 1, torch.ones_like(error)),))
    return error, (last, SparseJacobian(len(after), ((0, of_after),)))


def _step(
    T_world_from: Float[Tensor, "4 4 *#rows"], T_world_to: Float[Tensor, "4 4 *#rows"]
) -> tuple[Float[Tensor, "3 3 *#rows"], Float[Tensor, "3 *#rows"]]:
    """Rotation and translation of the second frame in the first."""
    step = components(T_world_from[:3, :3], T_world_to[:3, 3] - T_world_from[:3, 3])
    return _turn(T_world_from, T_world_to), step


def _turn(
    T_world_from: Float[Tensor, "_ _ *#rows"], T_world_to: Float[Tensor, "_ _ *#rows"]
) -> Float[Tensor, "3 3 *#rows"]:
    """Rotation of the second frame in the first."""
    return components(T_world_from[:3, :3, None], T_world_to[:3, None, :3])


def _log(R: Float[Tensor, "3 3 *#rows"]) -> Float[Tensor, "3 *#rows"]:
    """`se3.so3_log`, rows last; of many rotations in half the time where none of them is near half a turn."""
    # R - R^T is twice the sine of the angle about the axis: sound up to a right angle.
    twice = torch.stack((R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]))
    cosine = (R[0, 0] + R[1, 1] + R[2, 2] - 1) / 2
    # One alone may stand for many under `vmap`, where nothing can be asked of its value.
    if R.ndim == 2 or bool((cosine < 0.1).any()):
        return se3.so3_log(R.movedim((0, 1), (-2, -1))).movedim(-1, 0)
    square = twice.square().sum(0)
    small = square < 4e-8
    sine = torch.where(small, 1.0, square).sqrt() / 2
    return twice / 2 * torch.where(small, 1 + square / 24, torch.atan2(sine, cosine) / sine)
