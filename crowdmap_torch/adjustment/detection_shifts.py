"""What detections are shifted by as a whole, told apart from what poses are wrong by: both move all corners of a view alike.

A pose goes where the corners of its frame want it, so that their residuals say little of either. The shift of a detection
as everything else foresees it, its innovation, has the variance

    E |y|^2 / 2  =  C + tau v + w

with C that of shifts, v what errors of poses make of it, as the prior has these, and w what noise of the corners and of
other detections does. Near signs are moved by positions far more than distant ones, so that C and tau, by which the errors
of poses are smaller than they are taken to be, are told apart by all detections together: weighted least squares, as in
variance components (Rao and Kleffe, Estimation of variance components, 1988).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from crowdmap_torch.adjustment.shared_corner_errors import CornerDetections
from crowdmap_torch.optim.linearize import CHUNK_ROWS, at_once, linearize, residuals
from crowdmap_torch.optim.problem import CostTerm, Values, Variable
from crowdmap_torch.optim.robust import Quadratic
from crowdmap_torch.residuals import reprojection

_CLIP = 9.0
"""Squares of innovations are clipped at so many times what is expected of them."""
_ROUNDS = 12
"""Rounds of reweighting."""
_APART = 1e-9
"""Share of the mean square of slopes that their variance is, at least, where they are not all alike but for rounding."""
_TRUST = 24.0
"""Detections that tell of errors of poses alone that their being as large as they are taken to be counts as."""


def shift_innovations(
    term: CostTerm,
    detections: CornerDetections,
    variables: Mapping[str, Variable],
    values: Values,
    gradient: Float[Tensor, "d 6"],
    information: Float[Tensor, "d 6 6"],
    covariance: Float[Tensor, "p 6 6"],
    by_prior: Float[Tensor, "p 6 6"],
) -> Float[Tensor, "d 3"]:
    """Of every detection the square of its shift's innovation, and what poses' errors and others' noise make of it [px^2].

    Means of u and v. `term` is that of the detections' corners, by camera, sign and its size, at the minimum; of
    each detection there are the `gradient` by its pose and the `information` on it;
    `covariance` that of each pose, with all else known, and `by_prior` what of it the prior's errors leave. All three are
    zero where nothing tells: of detections that have no say.
    """
    (_, frame), (_, sign), *_ = term.slots
    first, n = detections.first, len(detections.count)
    template, matrix = (detections.mean(x.flatten(1)) for x in term.constants[:2])
    frame, sign = frame[first], sign[first]
    middle = CostTerm(
        reprojection.sign_reprojection,
        (("pose", frame), ("sign", sign), ("size", sign)),
        (template, matrix.view(-1, 3, 3)),
        jacobian=reprojection.sign_reprojection_jacobian,
    )
    plain = replace(term, weight=None, shared=None, loss=Quadratic())
    shift = detections.mean(residuals(plain, values))
    by_pose = linearize(middle, variables, values).jacobians[0].movedim(-1, 0)

    def of_some(at: Tensor) -> Float[Tensor, "m 3"]:
        J, own, of_pose = by_pose[at], information[at], covariance[frame[at]]
        # Without the detection the pose is where all else has it.
        known = torch.linalg.inv_ex(of_pose).inverse
        without = torch.linalg.inv_ex(known - own).inverse
        foreseen = shift[at] + (J @ without @ gradient[at][..., None])[..., 0]
        wider = without @ known
        of_prior = wider @ by_prior[frame[at]] @ wider.mT
        every, poses = (
            (J @ P @ J.mT).diagonal(dim1=-2, dim2=-1).mean(-1) for P in (without, of_prior)
        )
        poses = torch.minimum(poses.clamp_min(0), every)
        found = torch.stack((foreseen.square().mean(-1), poses, every - poses), dim=-1)
        counts = (own.diagonal(dim1=-2, dim2=-1).sum(-1) > 0) & (poses > 0)
        return torch.where((counts & found.isfinite().all(-1))[:, None], found, 0.0)

    some = torch.arange(n, device=first.device).split(at_once(CHUNK_ROWS, first.device))
    return torch.cat([shift.new_zeros(0, 3), *map(of_some, some)])


def told_apart(
    innovation: Float[Tensor, "d 3"], noise: Float[Tensor, " d"], counted: Bool[Tensor, " d"]
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """The variance of shifts [px^2], and the share of the variances of poses' errors that is there, neither below zero.

    Of `shift_innovations`, where they are `counted`; `noise` is what corners' own makes of the mean of a detection [px^2].
    Where little is told of it the share is drawn towards one. Without any there are no shifts.
    """
    square, poses, others = innovation.unbind(1)
    weighs = (counted & (poses > 0)).to(square)
    poses, rest = torch.where(weighs > 0, poses, 1.0), noise + others
    shift, share, told = square.new_zeros(()), square.new_ones(()), square.new_zeros(())
    for _ in range(_ROUNDS):
        expected = shift + share * poses + rest
        weight = weighs / expected.square().clamp_min(1e-12)
        seen = torch.minimum(square, _CLIP * expected) - rest
        shift, share, told = _least_squares(weight, poses, seen)
    return shift * (weighs.sum() > 0), (told * share + _TRUST) / (told + _TRUST)


def _least_squares(
    weight: Float[Tensor, " d"], slope: Float[Tensor, " d"], seen: Float[Tensor, " d"]
) -> tuple[Float[Tensor, ""], Float[Tensor, ""], Float[Tensor, ""]]:
    """`a` and `b`, neither below zero, of a + b `slope` as it was `seen`, and the information on `b`.

    Where slopes are alike there is none, and `b` is one.
    """
    least = torch.finfo(seen.dtype).tiny
    one, two = weight.sum().clamp_min(least), (weight * slope.square()).sum().clamp_min(least)
    both = (weight * slope).sum()
    of_one, of_two = (weight * seen).sum(), (weight * slope * seen).sum()
    det = one * two - both.square()
    apart, det = det > _APART * one * two, det.clamp_min(least)
    a, b = (two * of_one - both * of_two) / det, (one * of_two - both * of_one) / det
    # At a bound the other one has all of it.
    bounded_a = torch.where(b < 0, of_one / one, a)
    bounded_b = torch.where(a < 0, of_two / two, b).clamp_min(0)
    return (
        torch.where(apart, bounded_a, (of_one - both) / one).clamp_min(0),
        torch.where(apart, bounded_b, 1.0),
        torch.where(apart, two - both.square() / one, 0.0),
    )
