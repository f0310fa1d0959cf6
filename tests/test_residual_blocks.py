"""Blocks of the normal equations, rows last, against those of the Jacobians by autograd."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from crowdmap_torch import residual_blocks, residuals
from crowdmap_torch.geometry import se3
from crowdmap_torch.optim.linearize import residuals as whitened
from crowdmap_torch.optim.linearize import row_blocks, row_gradients
from crowdmap_torch.optim.problem import CostTerm, Variable, euclidean, positive
from crowdmap_torch.optim.robust import Huber, Quadratic, Tukey

VARIABLES = {
    "pose": Variable(6, se3.retract),
    "point": Variable(3, euclidean),
    "sign": Variable(6, se3.retract),
    "size": Variable(2, positive),
    "lane": Variable(3, euclidean),
    "drift": Variable(6, euclidean),
}
ROWS = 40


def draw(seed, *shape, scale=1.0):
    generator = torch.Generator().manual_seed(seed)
    return scale * torch.randn(*shape, dtype=torch.float64, generator=generator)


def poses(seed):
    return se3.exp(draw(seed, ROWS, 6))


def observations():
    return torch.eye(3, dtype=torch.float64).repeat(ROWS, 1, 1) + draw(3, ROWS, 3, 3, scale=0.02)


def corner_term(loss):
    values = {"pose": poses(0), "point": draw(1, ROWS, 3)}
    # Points in front of the cameras, and two behind, where the projection is held.
    ahead = torch.cat((draw(2, ROWS, 2), 4 + draw(2, ROWS, 1).abs()), dim=-1)
    ahead[:2, 2] = -3.0
    values["point"] = se3.transform(values["pose"], ahead)
    every = torch.arange(ROWS)
    return (
        CostTerm(
            residuals.point_reprojection,
            (("pose", every), ("point", every)),
            (observations(),),
            1 + draw(4, ROWS).abs(),
            loss,
            batched=residual_blocks.point_reprojection,
            normal=residual_blocks.point_reprojection_blocks,
            gradient=residual_blocks.point_reprojection_gradient,
        ),
        values,
    )


def prior_term(loss):
    values = {"pose": poses(0)}
    prior = se3.retract(values["pose"], draw(5, ROWS, 6, scale=0.4))
    # Right at the prior, where angles vanish, and far from it.
    prior[0] = values["pose"][0]
    prior[1] = se3.retract(prior[1], torch.tensor([0.0, 0, 0, 2.0, 1.0, 0], dtype=torch.float64))
    return (
        CostTerm(
            residuals.pose_prior,
            (("pose", torch.arange(ROWS)),),
            (prior,),
            1 + draw(4, ROWS, 6).abs(),
            loss,
            batched=residual_blocks.pose_prior,
            normal=residual_blocks.pose_prior_blocks,
            gradient=residual_blocks.pose_prior_gradient,
        ),
        values,
    )


def relative_term(loss):
    values = {"pose": poses(0)}
    measured = se3.inverse(values["pose"][:-1]) @ values["pose"][1:]
    measured[1:] = se3.retract(measured, draw(5, ROWS - 1, 6, scale=0.4))[1:]
    first = torch.arange(ROWS - 1)
    return (
        CostTerm(
            residuals.relative_pose,
            (("pose", first), ("pose", first + 1)),
            (measured,),
            1 + draw(4, ROWS - 1, 6).abs(),
            loss,
            batched=residual_blocks.relative_pose,
            normal=residual_blocks.relative_pose_blocks,
            gradient=residual_blocks.relative_pose_gradient,
        ),
        values,
    )


def sign_term(loss):
    values = {"pose": poses(0), "sign": poses(6), "size": 0.5 + draw(7, ROWS, 2).abs()}
    ahead = torch.cat((draw(2, ROWS, 2), 6 + draw(2, ROWS, 1).abs()), dim=-1)
    values["sign"][:, :3, 3] = se3.transform(values["pose"], ahead)
    every = torch.arange(ROWS)
    return (
        CostTerm(
            residuals.sign_reprojection,
            (("pose", every), ("sign", every), ("size", every)),
            (draw(8, ROWS, 2), observations()),
            1 + draw(4, ROWS).abs(),
            loss,
            batched=residual_blocks.sign_reprojection,
            normal=residual_blocks.sign_reprojection_blocks,
        ),
        values,
    )


def lane_values():
    values = {"pose": poses(0)}
    ahead = torch.cat((draw(2, ROWS, 2), 8 + draw(2, ROWS, 1).abs()), dim=-1)
    point = se3.transform(values["pose"], ahead)
    values["lane"] = (point[:, None] + 0.5 * draw(9, ROWS, 4, 3)).flatten(0, 1)
    first = 4 * torch.arange(ROWS)
    slots = (("pose", torch.arange(ROWS)), *(("lane", first + i) for i in range(4)))
    return values, slots, torch.softmax(draw(10, ROWS, 4), dim=-1)


def lane_term(loss):
    values, slots, weights = lane_values()
    normal = torch.nn.functional.normalize(draw(11, ROWS, 2), dim=-1)
    return (
        CostTerm(
            residuals.lane_reprojection,
            slots,
            (weights, normal, observations()),
            1 + draw(4, ROWS).abs(),
            loss,
            batched=residual_blocks.lane_reprojection,
            normal=residual_blocks.lane_reprojection_blocks,
        ),
        values,
    )


def height_term(loss):
    values, slots, weights = lane_values()
    return (
        CostTerm(
            residuals.lane_height,
            slots,
            (weights, draw(12, ROWS, 3), draw(13, ROWS)),
            1 + draw(4, ROWS).abs(),
            loss,
            batched=residual_blocks.lane_height,
            normal=residual_blocks.lane_height_blocks,
        ),
        values,
    )


def deviation_term(loss):
    term, values = prior_term(loss)
    values["drift"] = draw(14, ROWS, 6, scale=0.1)
    every = torch.arange(ROWS)
    return (
        replace(
            term,
            residual=residuals.pose_deviation,
            gradient=None,
            slots=(("pose", every), ("drift", every)),
            batched=residual_blocks.pose_deviation,
            normal=residual_blocks.pose_deviation_blocks,
        ),
        values,
    )


TERMS = [
    corner_term,
    prior_term,
    relative_term,
    sign_term,
    lane_term,
    height_term,
    deviation_term,
]


@pytest.mark.parametrize("loss", [Quadratic(), Huber(1.5), Tukey(30.0)])
@pytest.mark.parametrize("make", TERMS)
def test_blocks_are_those_of_autograd(make, loss):
    term, values = make(loss)
    ours = row_blocks(term, VARIABLES, values)
    theirs = row_blocks(replace(term, normal=None, batched=None), VARIABLES, values)
    torch.testing.assert_close(ours.rho, theirs.rho)
    for mine, other in zip(ours.gradient, theirs.gradient, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-9, atol=1e-9)
    assert ours.hessian.keys() == theirs.hessian.keys()
    for pair, block in ours.hessian.items():
        torch.testing.assert_close(block, theirs.hessian[pair], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("loss", [Quadratic(), Tukey(30.0)])
@pytest.mark.parametrize("make", TERMS)
def test_gradients_alone_are_those_of_the_blocks(make, loss):
    term, values = make(loss)
    alone = row_gradients(term, VARIABLES, values)
    blocks = row_blocks(term, VARIABLES, values)
    torch.testing.assert_close(alone.rho, blocks.rho)
    for mine, other in zip(alone.gradient, blocks.gradient, strict=True):
        torch.testing.assert_close(mine, other)


@pytest.mark.parametrize("make", TERMS)
def test_residuals_of_many_rows_are_those_of_one(make):
    term, values = make(Quadratic())
    torch.testing.assert_close(
        whitened(term, values), whitened(replace(term, batched=None), values)
    )


@pytest.mark.parametrize("make", TERMS)
def test_chain_rule_jacobians_are_those_of_autograd(make):
    term, values = make(Quadratic())
    jacobian = getattr(residuals, f"{term.residual.__name__}_jacobian")
    ours = row_blocks(replace(term, normal=None, jacobian=jacobian), VARIABLES, values)
    theirs = row_blocks(replace(term, normal=None), VARIABLES, values)
    for pair, block in ours.hessian.items():
        torch.testing.assert_close(block, theirs.hessian[pair], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("make", TERMS)
def test_gradients_by_autograd_are_finite_everywhere(make):
    term, values = make(Quadratic())
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    whitened(term, leaves).square().sum().backward()
    for name in {slot for slot, _ in term.slots}:
        gradient = leaves[name].grad
        assert gradient is not None and bool(gradient.isfinite().all())


def test_a_pose_at_its_prior_has_a_gradient():
    pose = poses(0).requires_grad_()
    deviation = residual_blocks.pose_prior(pose, pose.detach())
    deviation.square().sum().backward()
    assert pose.grad is not None
    torch.testing.assert_close(pose.grad, torch.zeros_like(pose.grad), rtol=0, atol=1e-12)
