"""Jacobians by the chain rule against full forward- and reverse-mode autograd."""

from __future__ import annotations

import pytest
import torch
from torch.func import jacfwd, jacrev, vmap

from crowdmap_torch import residuals
from crowdmap_torch.geometry import se3
from crowdmap_torch.optim.problem import positive

M = 20


def poses(generator, spread=1.0):
    return se3.exp(spread * torch.randn(M, 6, dtype=torch.float64, generator=generator))


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(5)


@pytest.fixture
def scene(generator):
    """Cameras near the origin that look along z, points some metres ahead, observations a few pixels off."""
    T_world_camera = poses(generator, 0.1)
    ahead = torch.randn(M, 3, dtype=torch.float64, generator=generator) + torch.tensor([0, 0, 12.0])
    u = torch.rand(M, 2, dtype=torch.float64, generator=generator)
    observation = torch.zeros(M, 3, 3, dtype=torch.float64)
    observation[:, 0, 0] = observation[:, 1, 1] = 1000
    observation[:, :2, 2] = 100 * (u - 0.5)
    observation[:, 2, 2] = 1
    return T_world_camera, ahead, observation


def check(residual, chain, blocks, retractions, constants):
    """Chain-rule residuals and Jacobians equal those of plain autograd, both modes, at zero tangent."""
    error, jacobians = chain(*blocks, *constants)

    def at(tangents, blocks, constants):
        moved = [
            retract(block[None], xi[None])[0]
            for retract, block, xi in zip(retractions, blocks, tangents, strict=True)
        ]
        return residual(*moved, *constants)

    dims = [J.shape[-1] for J in jacobians]
    zero = tuple(torch.zeros(M, k, dtype=torch.float64) for k in dims)
    torch.testing.assert_close(error, vmap(residual)(*blocks, *constants))
    for mode in (jacfwd, jacrev):
        full = vmap(mode(at))(zero, tuple(blocks), tuple(constants))
        for J, J_full in zip(jacobians, full, strict=True):
            # Pixels per metre reach 1e3: 1e-8 is eleven digits.
            torch.testing.assert_close(J, J_full, rtol=1e-9, atol=1e-8)


def add(value, delta):
    return value + delta


def test_sign_reprojection_jacobian_equals_autograd(scene, generator):
    T_world_camera, ahead, observation = scene
    T_world_sign = poses(generator, 0.3)
    T_world_sign[:, :3, 3] = ahead
    size = 0.5 + torch.rand(M, 2, dtype=torch.float64, generator=generator)
    template = torch.rand(M, 2, dtype=torch.float64, generator=generator) - 0.5
    check(
        residuals.sign_reprojection,
        residuals.sign_reprojection_jacobian,
        (T_world_camera, T_world_sign, size),
        (se3.retract, se3.retract, positive),
        (template, observation),
    )


def test_lane_reprojection_jacobian_equals_autograd(scene, generator):
    T_world_camera, ahead, observation = scene
    coefficients = [
        ahead + torch.randn(M, 3, dtype=torch.float64, generator=generator) for _ in range(4)
    ]
    weights = torch.softmax(torch.randn(M, 4, dtype=torch.float64, generator=generator), -1)
    normal = torch.nn.functional.normalize(
        torch.randn(M, 2, dtype=torch.float64, generator=generator), dim=-1
    )
    check(
        residuals.lane_reprojection,
        residuals.lane_reprojection_jacobian,
        (T_world_camera, *coefficients),
        (se3.retract, add, add, add, add),
        (weights, normal, observation),
    )


def test_lane_height_and_prior_jacobians_equal_autograd(scene, generator):
    T_world_camera, ahead, _ = scene
    coefficients = [
        ahead + torch.randn(M, 3, dtype=torch.float64, generator=generator) for _ in range(4)
    ]
    weights = torch.softmax(torch.randn(M, 4, dtype=torch.float64, generator=generator), -1)
    normal = torch.nn.functional.normalize(ahead, dim=-1)
    check(
        residuals.lane_height,
        residuals.lane_height_jacobian,
        (T_world_camera, *coefficients),
        (se3.retract, add, add, add, add),
        (weights, normal, torch.full((M,), 1.4, dtype=torch.float64)),
    )
    check(
        residuals.lane_prior,
        residuals.lane_prior_jacobian,
        (ahead,),
        (add,),
        (coefficients[0], T_world_camera[:, :3, :3]),
    )
    sizes = 0.5 + torch.rand(2, M, 2, dtype=torch.float64, generator=generator)
    check(
        residuals.size_class,
        residuals.size_class_jacobian,
        (sizes[0],),
        (positive,),
        (sizes[1],),
    )
    check(
        residuals.lane_slide,
        residuals.lane_slide_jacobian,
        (T_world_camera, ahead),
        (se3.retract, add),
        (coefficients[0], normal),
    )
    check(
        residuals.lane_stretch,
        residuals.lane_stretch_jacobian,
        (ahead, coefficients[1]),
        (add, add),
        (coefficients[0], T_world_camera[:, :3, :3]),
    )


@pytest.mark.parametrize("spread", [0.0, 1e-4, 0.3])
def test_pose_deviation_jacobian_equals_autograd(generator, spread):
    prior = poses(generator)
    T_world_camera = se3.retract(
        prior, spread * torch.randn(M, 6, dtype=torch.float64, generator=generator)
    )
    drift = torch.randn(M, 6, dtype=torch.float64, generator=generator)
    check(
        residuals.pose_deviation,
        residuals.pose_deviation_jacobian,
        (T_world_camera, drift),
        (se3.retract, add),
        (prior,),
    )


def test_drift_jacobians_equal_autograd(generator):
    drifts = [torch.randn(M, 6, dtype=torch.float64, generator=generator) for _ in range(3)]
    persistence = torch.rand(M, 6, dtype=torch.float64, generator=generator)
    check(
        residuals.drift_transition,
        residuals.drift_transition_jacobian,
        drifts,
        (add, add, add),
        (persistence,),
    )
    check(residuals.drift_start, residuals.drift_start_jacobian, drifts[:2], (add, add), ())
    check(residuals.constant_bias, residuals.constant_bias_jacobian, drifts[:1], (add,), ())


def test_a_point_behind_the_camera_leaves_finite_errors_and_jacobians(scene):
    T_world_camera, ahead, observation = scene
    error, by_pose, by_point = residuals._through_pose(T_world_camera, -ahead, observation)
    assert error.isfinite().all()
    assert by_pose.isfinite().all()
    assert by_point.isfinite().all()
