"""Blocks of the normal equations, rows last, against those of the Jacobians by autograd."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from crowdmap_torch import residual_blocks, residuals
from crowdmap_torch.geometry import se3
from crowdmap_torch.optim.linearize import residuals as whitened
from crowdmap_torch.optim.linearize import row_blocks, row_gradients
from crowdmap_torch.optim.problem import CostTerm, Variable, euclidean
from crowdmap_torch.optim.robust import Huber, Quadratic, Tukey

VARIABLES = {"pose": Variable(6, se3.retract), "point": Variable(3, euclidean)}
ROWS = 40


def draw(seed, *shape, scale=1.0):
    generator = torch.Generator().manual_seed(seed)
    return scale * torch.randn(*shape, dtype=torch.float64, generator=generator)


def poses(seed):
    return se3.exp(draw(seed, ROWS, 6))


def corner_term(loss):
    values = {"pose": poses(0), "point": draw(1, ROWS, 3)}
    # Points in front of the cameras, and two behind, where the projection is held.
    ahead = torch.cat((draw(2, ROWS, 2), 4 + draw(2, ROWS, 1).abs()), dim=-1)
    ahead[:2, 2] = -3.0
    values["point"] = se3.transform(values["pose"], ahead)
    M = torch.eye(3, dtype=torch.float64).repeat(ROWS, 1, 1) + draw(3, ROWS, 3, 3, scale=0.02)
    every = torch.arange(ROWS)
    return (
        CostTerm(
            residuals.point_reprojection,
            (("pose", every), ("point", every)),
            (M,),
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
        ),
        values,
    )


@pytest.mark.parametrize("loss", [Quadratic(), Huber(1.5), Tukey(30.0)])
@pytest.mark.parametrize("make", [corner_term, prior_term, relative_term])
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
@pytest.mark.parametrize("make", [corner_term, prior_term, relative_term])
def test_gradients_alone_are_those_of_the_blocks(make, loss):
    term, values = make(loss)
    alone = row_gradients(term, VARIABLES, values)
    blocks = row_blocks(term, VARIABLES, values)
    torch.testing.assert_close(alone.rho, blocks.rho)
    for mine, other in zip(alone.gradient, blocks.gradient, strict=True):
        torch.testing.assert_close(mine, other)


@pytest.mark.parametrize("make", [corner_term, prior_term, relative_term])
def test_residuals_of_many_rows_are_those_of_one(make):
    term, values = make(Quadratic())
    torch.testing.assert_close(
        whitened(term, values), whitened(replace(term, batched=None), values)
    )


@pytest.mark.parametrize("make", [corner_term, prior_term, relative_term])
def test_chain_rule_jacobians_are_those_of_autograd(make):
    term, values = make(Quadratic())
    jacobian = getattr(residuals, f"{term.residual.__name__}_jacobian")
    ours = row_blocks(replace(term, normal=None, jacobian=jacobian), VARIABLES, values)
    theirs = row_blocks(replace(term, normal=None), VARIABLES, values)
    for pair, block in ours.hessian.items():
        torch.testing.assert_close(block, theirs.hessian[pair], rtol=1e-9, atol=1e-9)
