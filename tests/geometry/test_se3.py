"""Group axioms and derivatives of rigid transforms."""

from __future__ import annotations

import math

import pytest
import torch
from torch.func import jacfwd, jacrev, vmap

from crowdmap_torch.geometry import se3

ROUNDING = 1e-12  # products of a few float64 matrices of order one


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def random_tangents(generator: torch.Generator, count: int, max_angle: float) -> torch.Tensor:
    t = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    axis = torch.nn.functional.normalize(
        torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    angle = max_angle * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    return torch.cat((t, axis * angle), dim=-1)


def test_skew_is_the_cross_product(generator):
    a, b = torch.randn(2, 50, 3, generator=generator, dtype=torch.float64)
    crossed = (se3.skew(a) @ b[..., None])[..., 0]
    torch.testing.assert_close(crossed, torch.linalg.cross(a, b))


def test_so3_exp_agrees_with_the_matrix_exponential(generator):
    w = random_tangents(generator, 200, 3.0)[:, 3:]
    torch.testing.assert_close(se3.so3_exp(w), torch.matrix_exp(se3.skew(w)), atol=1e-12, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 0.9999e-3, 1.0001e-3, 1e-2, 1.0])
def test_so3_exp_has_no_step_where_the_series_takes_over(angle):
    # the first term that the series leaves out is t^4 / 120: 1e-14 at the switch
    w = torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64) * angle
    torch.testing.assert_close(se3.so3_exp(w), torch.matrix_exp(se3.skew(w)), atol=1e-13, rtol=0)


def test_exp_and_log_are_inverse_below_half_a_turn(generator):
    xi = random_tangents(generator, 500, math.pi - 1e-3)
    # close to half a turn the quaternion's scalar part carries the angle: digits are lost as 1 /
    # (pi - angle)
    torch.testing.assert_close(se3.log(se3.exp(xi)), xi, atol=1e-10, rtol=0)


def test_log_is_accurate_at_small_and_middle_angles(generator):
    for angle in (0.0, 1e-12, 1e-8, 1e-4, 0.9e-3, 2e-3, 2.1e-3, 1e-1):
        xi = random_tangents(generator, 50, angle)
        torch.testing.assert_close(se3.log(se3.exp(xi)), xi, atol=1e-13, rtol=1e-12)


def test_log_of_half_a_turn_has_length_pi():
    for axis in torch.eye(3, dtype=torch.float64):
        w = se3.so3_log(se3.so3_exp(axis * math.pi))
        assert w.norm().item() == pytest.approx(math.pi, abs=1e-7)
        assert w.abs().max().item() == pytest.approx(math.pi, abs=1e-7)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.0999, 0.1001, 1.0, 3.0])
def test_right_jacobian_inverse_is_the_derivative_of_the_logarithm(angle, generator):
    w = torch.nn.functional.normalize(
        torch.randn(3, generator=generator, dtype=torch.float64), dim=0
    )
    w = angle * w

    def moved(d):
        return se3.so3_log(se3.so3_exp(w) @ se3.so3_exp(d))

    expected = jacfwd(moved)(torch.zeros(3, dtype=torch.float64))
    torch.testing.assert_close(se3.right_jacobian_inverse(w), expected, rtol=0, atol=1e-11)


def test_right_jacobian_inverse_of_large_and_small_angles_together_is_that_of_each(generator):
    w = random_tangents(generator, 6, 1.0)[:, 3:]
    w = torch.nn.functional.normalize(w) * torch.tensor([0.0, 0.05, 0.09, 0.2, 1.0, 3.0])[:, None]
    together = se3.right_jacobian_inverse(w.mT)
    for each, column in zip(w, together.unbind(-1), strict=True):
        torch.testing.assert_close(se3.right_jacobian_inverse(each), column, rtol=1e-15, atol=0)


def test_inverse_undoes(generator):
    T = se3.exp(random_tangents(generator, 100, 3.0))
    identity = torch.eye(4, dtype=torch.float64).expand_as(T)
    torch.testing.assert_close(se3.inverse(T) @ T, identity, atol=ROUNDING, rtol=0)
    torch.testing.assert_close(T @ se3.inverse(T), identity, atol=ROUNDING, rtol=0)


def test_transform_composes_and_rotate_leaves_out_the_translation(generator):
    T_a_b, T_b_c = se3.exp(random_tangents(generator, 200, 3.0)).chunk(2)
    p_c = torch.randn(100, 3, generator=generator, dtype=torch.float64)
    one_by_one = se3.transform(T_a_b, se3.transform(T_b_c, p_c))
    torch.testing.assert_close(se3.transform(T_a_b @ T_b_c, p_c), one_by_one)
    origin = se3.transform(T_a_b, torch.zeros_like(p_c))
    torch.testing.assert_close(se3.rotate(T_a_b, p_c), se3.transform(T_a_b, p_c) - origin)


def test_retract_by_zero_is_identity(generator):
    T = se3.exp(random_tangents(generator, 20, 3.0))
    assert torch.equal(se3.retract(T, torch.zeros(20, 6, dtype=torch.float64)), T)


def test_local_undoes_retract(generator):
    T = se3.exp(random_tangents(generator, 100, 3.0))
    xi = random_tangents(generator, 100, 3.0)
    torch.testing.assert_close(se3.local(T, se3.retract(T, xi)), xi, atol=1e-11, rtol=0)


def test_retract_moves_along_world_axes_and_turns_about_body_axes():
    quarter = torch.tensor([0, 0, 0, 0, 0, math.pi / 2], dtype=torch.float64)
    T = se3.exp(quarter)
    moved = se3.retract(T, torch.tensor([1.0, 2.0, 3.0, 0, 0, 0], dtype=torch.float64))
    torch.testing.assert_close(moved[:3, 3], torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    turned = se3.retract(T, torch.tensor([0, 0, 0, 0.1, 0, 0], dtype=torch.float64))
    body_turn = se3.exp(torch.tensor([0, 0, 0, 0.1, 0, 0], dtype=torch.float64))
    torch.testing.assert_close(turned, T @ body_turn)


@pytest.mark.parametrize("jacobian", [jacfwd, jacrev])
def test_retract_and_local_jacobians_are_finite_and_the_identity_at_zero(jacobian, generator):
    T = se3.exp(random_tangents(generator, 1, 2.0))[0]
    zero = torch.zeros(6, dtype=torch.float64)
    J = jacobian(lambda xi: se3.local(T, se3.retract(T, xi)))(zero)
    torch.testing.assert_close(J, torch.eye(6, dtype=torch.float64), atol=1e-12, rtol=0)


def test_retract_works_under_vmap(generator):
    T = se3.exp(random_tangents(generator, 10, 2.0))
    xi = random_tangents(generator, 10, 1.0)
    torch.testing.assert_close(vmap(se3.retract)(T, xi), se3.retract(T, xi))


def test_mean_of_symmetric_deviations_is_the_centre(generator):
    T = se3.exp(random_tangents(generator, 1, 2.0))
    xi = random_tangents(generator, 10, 0.3)
    xi = torch.cat((xi, -xi))
    centre = se3.mean(se3.retract(T.expand(20, 4, 4), xi))
    # the fixed point contracts by less than a tenth an iteration here, and there are ten
    torch.testing.assert_close(centre, T[0], atol=1e-9, rtol=0)


def test_mean_ignores_rows_of_weight_zero(generator):
    T = se3.exp(random_tangents(generator, 5, 0.5))
    weight = torch.tensor([1.0, 2.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    kept = weight > 0
    torch.testing.assert_close(se3.mean(T, weight), se3.mean(T[kept], weight[kept]))


def test_quaternions_round_trip_with_positive_scalar_part(generator):
    R = se3.so3_exp(random_tangents(generator, 500, math.pi)[:, 3:])
    q = se3.to_quaternion(R)
    assert (q[:, 3] >= 0).all()
    torch.testing.assert_close(q.norm(dim=-1), torch.ones(500, dtype=torch.float64))
    torch.testing.assert_close(se3.from_quaternion(q), R, atol=ROUNDING, rtol=0)


def test_quaternion_agrees_with_scipy(generator):
    rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    q = torch.randn(100, 4, generator=generator, dtype=torch.float64)
    expected = torch.from_numpy(rotation.from_quat(q.numpy()).as_matrix())
    torch.testing.assert_close(se3.from_quaternion(q), expected)


def test_quaternion_of_half_turns_divides_by_nothing_small():
    for diagonal in ((1.0, -1, -1), (-1.0, 1, -1), (-1.0, -1, 1)):
        R = torch.diag(torch.tensor(diagonal, dtype=torch.float64))
        torch.testing.assert_close(se3.from_quaternion(se3.to_quaternion(R)), R)


def test_orthonormalise_returns_the_nearest_rotation(generator):
    R = se3.so3_exp(random_tangents(generator, 50, 3.0)[:, 3:])
    noise = 1e-6 * torch.randn(50, 3, 3, generator=generator, dtype=torch.float64)
    restored = se3.orthonormalise(R + noise)
    identity = torch.eye(3, dtype=torch.float64).expand_as(R)
    torch.testing.assert_close(restored @ restored.mT, identity, atol=ROUNDING, rtol=0)
    torch.testing.assert_close(torch.linalg.det(restored), torch.ones(50, dtype=torch.float64))
    assert (restored - R).abs().max() < 1e-5
