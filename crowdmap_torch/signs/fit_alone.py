"""IV-B as the paper has it: mid-points of corners, center, axis and size of their best plane, least reprojection error.

Every sign by itself, from poses taken as they are: no prior of what signs are like, all pixels alike.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_median, group_sum
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.geometry.triangulation import midpoint_ragged
from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.linearize import residuals
from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, positive, pull_positive
from crowdmap_torch.optim.robust import Tukey
from crowdmap_torch.optim.solvers.dense import DenseBackend
from crowdmap_torch.optim.solvers.normal_equations import LinearFunctions
from crowdmap_torch.residuals.reprojection import sign_view, sign_view_jacobian
from crowdmap_torch.road.nonholonomic import DrivePath
from crowdmap_torch.signs.fit import SignFitConfig
from crowdmap_torch.signs.views import (
    SignFit,
    SignStart,
    SignViews,
    closest_approach,
    held_covariance,
)

LEAST_PX = 0.5
"""Least scale of Tukey's weights: no detector is surer of corners [px]."""


def mid_points(views: SignViews, count: int) -> Float[Tensor, "count 8 3"]:
    """The mid-point of the rays of each corner of every sign; corners that a shape does not have repeat others."""
    slots = polygon.MAX_CORNERS
    ideal = torch.nn.functional.pad(views.corners_ideal, (0, 1), value=1.0)
    ray = se3.rotate(views.T_world_camera[:, None], ideal)
    origin = views.p_world_camera[:, None].expand_as(ray)
    group = views.sign[:, None] * slots + torch.arange(slots, device=views.sign.device)
    point, _ = midpoint_ragged(
        origin.flatten(0, 1), ray.flatten(0, 1), group.flatten(), count * slots
    )
    return point.reshape(count, slots, 3)


def center_axis_size(
    corners_world: Float[Tensor, "n 8 3"], shape: Int[Tensor, " n"], views: SignViews
) -> SignStart:
    """Signs as centroid, best plane and size of their corners, which are the template's one by one."""
    n = len(shape)
    centroid = group_sum(views.p_world_camera, views.sign, n)
    number = torch.bincount(views.sign, minlength=n).to(centroid)
    toward = centroid / number[:, None] - corners_world[:, 0]
    T, size, _ = polygon.fit_sign(corners_world, shape, toward, shifts=1)
    return SignStart(T, size)


def fit_signs_alone(
    views: SignViews,
    shape: Int[Tensor, " n"],
    start: SignStart,
    drive: DrivePath,
    config: SignFitConfig,
) -> SignFit:
    """The signs with the least reprojection error, Tukey's weights of every corner by itself.

    The scale of the weights is that of each sign's own residuals, from those of the start on. Errors are in units of it,
    which covariances are of, too.
    """
    n = len(shape)
    view, _ = _rows(views, shape)
    values = {"sign": start.T_world_sign, "size": start.size}
    scale = _scale(views, shape, values)
    problem = reprojection_problem(views, shape, scale, tukey=config.tukey_alone)
    for _ in range(config.rounds):
        values = lm.solve(problem, values, config.lm).values
        scale = torch.minimum(scale, _scale(views, shape, values))
        problem = reprojection_problem(views, shape, scale, tukey=config.tukey_alone)
    found = SignStart(values["sign"], values["size"])
    square = residuals(problem.terms["corners"], values).square().sum(-1)
    own = torch.arange(n, device=shape.device)
    centre = torch.eye(3, 6).to(start.size).expand(n, 3, 6)
    normal = DenseBackend().assemble(problem, values)
    covariance = normal.covariance().of(LinearFunctions((("sign", own),), (centre,)))
    numbers = 2 * polygon.corner_count(shape)[views.sign]
    return SignFit(
        T_world_sign=found.T_world_sign,
        size=found.size,
        frame=closest_approach(views, found, drive),
        covariance=held_covariance(covariance),
        error_sq=group_sum(square, view, len(views)) / numbers,
        drift_scale=0.0,
    )


def reprojection_problem(
    views: SignViews, shape: Int[Tensor, " n"], scale: Float[Tensor, " n"], *, tukey: float
) -> Problem:
    """Tukey's loss of the pixel error of every corner of every view, one independent problem per sign.

    `scale` is the standard deviation of each sign's pixel errors [px], `tukey` the bound in terms of it.
    """
    own = torch.arange(len(shape), device=shape.device)
    view, corner = _rows(views, shape)
    sign = views.sign[view]
    template = polygon.template(shape).to(scale)[sign, corner]
    term = CostTerm(
        sign_view,
        (("sign", sign), ("size", sign)),
        (
            views.T_world_camera[view],
            template[:, None],
            views.observation[view, corner][:, None],
            template.new_zeros(len(view), 2),
            torch.eye(2).to(scale) / scale[sign, None, None],
        ),
        loss=Tukey(tukey),
        jacobian=sign_view_jacobian,
    )
    variables = {
        "sign": Variable(6, se3.retract, group=own, pull=se3.pull),
        "size": Variable(2, positive, group=own, pull=pull_positive),
    }
    return Problem(variables, {"corners": term}, group_count=len(own))


def _rows(
    views: SignViews, shape: Int[Tensor, " n"]
) -> tuple[Int[Tensor, " r"], Int[Tensor, " r"]]:
    """View and corner of each of its shape's corners."""
    view, corner = polygon.corner_mask(shape)[views.sign].nonzero(as_tuple=True)
    return view, corner


def _scale(
    views: SignViews, shape: Int[Tensor, " n"], values: Mapping[str, Tensor]
) -> Float[Tensor, " n"]:
    """Robust standard deviation of the pixel errors of each sign [px]."""
    ones = torch.ones_like(values["size"][:, 0])
    term = reprojection_problem(views, shape, ones, tukey=1.0).terms["corners"]
    error = residuals(term, values)
    view, _ = _rows(views, shape)
    of = views.sign[view].repeat_interleave(2)
    return (1.4826 * group_median(error.abs().flatten(), of, len(shape))).clamp_min(LEAST_PX)
