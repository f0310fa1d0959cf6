"""Projection and its inverse, for every lens model."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace

import cv2
import pytest
import torch
from torch.func import jacfwd, jacrev, vmap

from crowdmap_torch.geometry import camera
from crowdmap_torch.geometry.camera import Camera

WIDTH, HEIGHT = 1280, 800
BROWN_CONRADY = {
    "0": (1000.0, []),
    "4": (1000.0, [-0.3, 0.08, 1e-3, -5e-4]),
    "4 barrel wide": (600.0, [-0.3, 0.0, 0.0, 0.0]),
    "4 barrel": (1000.0, [-0.3, 0.0, 0.0, 0.0]),
    "5": (1000.0, [-0.35, 0.12, 1e-3, -5e-4, -0.02]),
    "5 pincushion": (900.0, [0.3, 0.2, 0.0, 0.0, 0.1]),
    "8 rational": (700.0, [-0.4, 0.2, 1e-3, -1e-3, 0.1, 0.2, -0.05, 0.02]),
    "12 thin prism": (800.0, [-0.3, 0.1, 1e-3, -1e-3, 0.01, 0.1, 0, 0, 1e-3, -2e-3, 2e-3, 1e-3]),
    "14 tilted": (
        800.0,
        [-0.3, 0.1, 1e-3, -1e-3, 0.01, 0.1, 0, 0, 1e-3, -2e-3, 2e-3, 1e-3, 0.03, -0.02],
    ),
}
KANNALA_BRANDT = {
    "fisheye equidistant": (430.0, [0.0, 0.0, 0.0, 0.0]),
    "fisheye": (350.0, [-0.02, 0.003, -0.001, 0.0002]),
    "fisheye strong": (430.0, [0.1, -0.05, 0.02, -0.005]),
}
LENSES = [*BROWN_CONRADY, *KANNALA_BRANDT]


def make_camera(name: str) -> Camera:
    fisheye = name in KANNALA_BRANDT
    f, distortion = (KANNALA_BRANDT if fisheye else BROWN_CONRADY)[name]
    K = torch.tensor(
        [[f, 0, WIDTH / 2 - 0.5], [0, 1.01 * f, HEIGHT / 2 - 0.5], [0, 0, 1]], dtype=torch.float64
    )
    model = "kannala_brandt" if fisheye else "brown_conrady"
    return Camera(model, WIDTH, HEIGHT, K, torch.tensor(distortion, dtype=torch.float64))


@pytest.fixture(params=LENSES)
def lens(request) -> Camera:
    return make_camera(request.param)


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def ideal_points(lens: Camera, count: int, generator: torch.Generator) -> torch.Tensor:
    """Points all over where the lens is one-to-one, no further out than 20 images."""
    share, turn = torch.rand(2, count, generator=generator, dtype=torch.float64)
    # 0.999: at the fold itself the derivative vanishes and there is no inverse
    radius = (0.999 * share * math.atan(lens.monotonic_radius)).tan()
    angle = turn * 2 * math.pi
    ideal = radius[:, None] * torch.stack((angle.cos(), angle.sin()), dim=-1)
    near = camera.distort(lens, ideal).abs().amax(-1) < 20 * WIDTH
    return ideal[near]


def test_distortion_agrees_with_opencv(lens, generator):
    ideal = ideal_points(lens, 500, generator)
    p = torch.cat((ideal, torch.ones(len(ideal), 1, dtype=torch.float64)), dim=-1).numpy()
    K, distortion = lens.K.numpy(), lens.distortion.numpy()
    none = torch.zeros(3, dtype=torch.float64).numpy()
    if lens.model == "kannala_brandt":
        expected, _ = cv2.fisheye.projectPoints(p[:, None], none, none, K, distortion)
    else:
        expected, _ = cv2.projectPoints(p, none, none, K, distortion if len(distortion) else None)
    expected = torch.from_numpy(expected).reshape(-1, 2)
    # relative: pixels reach 25,000 with the pincushion
    torch.testing.assert_close(camera.distort(lens, ideal), expected, atol=1e-6, rtol=1e-9)


def test_undistortion_closes_wherever_the_lens_is_one_to_one(lens, generator):
    ideal = ideal_points(lens, 20_000, generator)
    px = camera.distort(lens, ideal)
    found, closes = camera.unproject(lens, px)
    assert closes.all()
    # Newton stops at 1e-9 px or where rounding ends it: 1e-12 of pixels that reach 25,000
    assert (camera.distort(lens, found) - px).abs().max() < 1e-6
    # as an angle; next to the fold 1e-9 px is more
    error = (found - ideal).norm(dim=-1) / (1 + ideal.square().sum(-1))
    assert error.max() < 1e-7


def test_undistortion_of_image_pixels_tells_the_truth(lens, generator):
    size = torch.tensor([WIDTH, HEIGHT], dtype=torch.float64)
    px = torch.rand(5000, 2, generator=generator, dtype=torch.float64) * size - 0.5
    ideal, closes = camera.unproject(lens, px)
    assert ideal.isfinite().all()
    again, visible = camera.project(lens, torch.cat((ideal, torch.ones_like(px[:, :1])), dim=-1))
    miss = (again - px).norm(dim=-1)
    assert (miss[closes] < camera.CLOSING_TOLERANCE_PX).all()
    assert visible[closes].all()
    assert (ideal[closes].norm(dim=-1) < math.tan(camera.MAX_OFF_AXIS)).all()


def test_pixels_beyond_the_fold_do_not_close():
    lens = make_camera("4 barrel wide")
    # r (1 - 0.3 r^2) is at most 0.7027, at r = 1.0541: 421.6 px from the centre
    assert lens.monotonic_radius == pytest.approx(math.sqrt(1 / 0.9), abs=1e-6)
    u = lens.K[0, 2] + torch.tensor([421.0, 422.0], dtype=torch.float64)
    px = torch.stack((u, lens.K[1, 2].expand(2)), dim=-1)
    assert camera.unproject(lens, px)[1].tolist() == [True, False]


def test_unproject_keeps_shapes_and_survives_what_is_not_finite():
    lens = make_camera("5")
    px = torch.full((2, 3, 2), 500.0, dtype=torch.float64)
    px[0, 1, 0], px[1, 2, 1] = math.nan, math.inf
    ideal, closes = camera.unproject(lens, px)
    assert ideal.shape == (2, 3, 2)
    assert ideal.isfinite().all()
    assert closes.tolist() == [[True, False, True], [True, True, False]]
    assert camera.unproject(lens, px[:0])[0].shape == (0, 3, 2)


def test_unproject_in_chunks_is_unproject(monkeypatch, generator):
    lens = make_camera("8 rational")
    px = torch.rand(1000, 2, generator=generator, dtype=torch.float64) * 700
    whole = camera.unproject(lens, px)
    monkeypatch.setattr(camera, "_CHUNK", 64)
    in_chunks = camera.unproject(lens, px)
    # kornia's and our arithmetic is elementwise, so rounding apart from vector widths is the same
    torch.testing.assert_close(in_chunks[0], whole[0], atol=1e-12, rtol=0)
    assert torch.equal(in_chunks[1], whole[1])


def test_points_behind_beside_and_beyond_are_not_visible():
    lens = make_camera("4 barrel")
    points = torch.tensor(
        [[0.1, 0.1, 5.0], [0.1, 0.1, -5.0], [0.0, 0.0, 0.0], [9.0, 0, 5.0], [40.0, 0.0, 5.0]],
        dtype=torch.float64,
    )
    px, visible = camera.project(lens, points)
    assert visible.tolist() == [True, False, False, False, False]
    assert px.isfinite().all()


def test_a_point_that_the_barrel_folds_back_into_the_image_is_not_visible():
    lens = make_camera("4 barrel wide")
    # at r = 1.6, r (1 - 0.3 r^2) = 0.37: 223 px from the centre, well inside the image
    p = torch.tensor([1.6, 0.0, 1.0], dtype=torch.float64)
    px, visible = camera.project(lens, p)
    assert camera.inside_image(lens, px)
    assert not visible


def test_rays_of_85_degrees_are_never_used():
    lens = make_camera("fisheye equidistant")
    angle = torch.deg2rad(torch.tensor([84.99, 85.01], dtype=torch.float64))
    p = torch.stack((angle.sin(), torch.zeros_like(angle), angle.cos()), dim=-1)
    px, visible = camera.project(lens, p)
    assert camera.inside_image(lens, px).all()
    assert visible.tolist() == [True, False]
    assert camera.unproject(lens, px)[1].tolist() == [True, False]


def test_image_reaches_half_a_pixel_beyond_the_outer_centres():
    lens = make_camera("0")
    px = torch.tensor(
        [[-0.5, -0.5], [-0.51, 0], [1279.5, 799.5], [1279.51, 0], [0, 799.51]], dtype=torch.float64
    )
    assert camera.inside_image(lens, px).tolist() == [True, False, True, False, False]


def test_pixel_jacobian_is_the_full_jacobian(lens, generator):
    ideal = ideal_points(lens, 50, generator)
    J = camera.pixel_jacobian(lens, ideal)
    for jacobian in (jacfwd, jacrev):
        full = vmap(jacobian(lambda x: camera.distort(lens, x)))(ideal)
        torch.testing.assert_close(J, full, atol=1e-8, rtol=1e-10)


def test_projection_of_one_point_differentiates_under_vmap(lens, generator):
    ideal = ideal_points(lens, 30, generator)
    p = 7.0 * torch.cat((ideal, torch.ones_like(ideal[:, :1])), dim=-1)
    J = vmap(jacfwd(lambda x: camera.project(lens, x)[0]))(p)
    chain = torch.cat(
        (torch.eye(2, dtype=torch.float64).expand(len(p), 2, 2), -ideal[..., None]), dim=-1
    )
    expected = camera.pixel_jacobian(lens, ideal) @ chain / 7.0
    torch.testing.assert_close(J, expected, atol=1e-8, rtol=1e-9)
    one_by_one, visible = vmap(lambda x: camera.project(lens, x))(p)
    together, all_visible = camera.project(lens, p)
    torch.testing.assert_close(one_by_one, together)
    assert torch.equal(visible, all_visible)


@pytest.mark.parametrize("jacobian", [jacfwd, jacrev])
@pytest.mark.parametrize("name", ["5", "14 tilted", "fisheye"])
def test_projection_has_finite_derivatives_on_axis_and_behind(name, jacobian):
    lens = make_camera(name)
    for p in ([0.0, 0.0, 3.0], [0.0, 0.0, -3.0], [1.0, 2.0, 0.0]):
        at = torch.tensor(p, dtype=torch.float64)
        assert jacobian(lambda x: camera.project(lens, x)[0])(at).isfinite().all()


@pytest.mark.parametrize("name", ["5", "14 tilted", "fisheye"])
@pytest.mark.parametrize("derived", [camera.pixel_jacobian, camera.projective_bend])
def test_what_is_derived_of_a_lens_has_derivatives_itself(name, derived):
    lens = make_camera(name)
    at = torch.tensor([0.1, -0.2], dtype=torch.float64)

    def by_lens(distortion: torch.Tensor) -> torch.Tensor:
        return derived(replace(lens, distortion=distortion), at)

    for function, x in ((lambda x: derived(lens, x), at), (by_lens, lens.distortion)):
        forward, back = jacfwd(function)(x), jacrev(function)(x)
        leaf = x.clone().requires_grad_()
        total = torch.autograd.grad(function(leaf).sum(), leaf)[0]
        step = 1e-6 * torch.eye(len(x), dtype=x.dtype)
        differences = torch.stack([(function(x + h) - function(x - h)) / 2e-6 for h in step], -1)
        # They are there, and by all ways the same.
        assert forward.abs().max() > 1e-3
        torch.testing.assert_close(forward, back)
        torch.testing.assert_close(total, back.flatten(0, -2).sum(0))
        torch.testing.assert_close(forward, differences, rtol=1e-4, atol=1e-6)


def test_lenses_leave_torchs_compiler_alone():
    program = (
        "import sys, torch; from crowdmap_torch.geometry import camera; "
        "K = torch.tensor([[800.0, 0, 640], [0, 800, 360], [0, 0, 1]]).double(); "
        "lens = camera.Camera('brown_conrady', 1280, 720, K, torch.tensor([-0.3, 0.1, 0, 0]).double()); "
        "px = torch.tensor([[100.0, 200.0]]).double(); "
        "camera.observation_matrix(lens, px, camera.unproject(lens, px)[0]); "
        "print([name for name in ('torch._dynamo', 'sympy') if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def apply(M: torch.Tensor, p: torch.Tensor) -> torch.Tensor:
    q = (M @ p[..., None])[..., 0]
    return q[..., :2] / q[..., 2:]


def test_observation_matrix_of_a_pinhole_is_exact(generator):
    lens = make_camera("0")
    p = torch.randn(100, 3, generator=generator, dtype=torch.float64)
    p[:, 2] = p[:, 2].abs() * 20 + 2
    px = torch.rand(100, 2, generator=generator, dtype=torch.float64) * HEIGHT
    M = camera.observation_matrix(lens, px, camera.unproject(lens, px)[0])
    error = camera.project(lens, p)[0] - px
    torch.testing.assert_close(apply(M, p), error, atol=1e-8, rtol=0)


def test_observation_matrix_gives_the_raw_pixel_error_near_the_detection(lens, generator):
    # 3 px is a large detection error; what the lens bends within it may cost 0.05 px
    size = torch.tensor([WIDTH, HEIGHT], dtype=torch.float64)
    px = torch.rand(2000, 2, generator=generator, dtype=torch.float64) * size - 0.5
    turn = 2 * math.pi * torch.rand(2000, generator=generator, dtype=torch.float64)
    moved = px + 3.0 * torch.stack((turn.cos(), turn.sin()), dim=-1)
    ideal, closes = camera.unproject(lens, px)
    moved_ideal, moved_closes = camera.unproject(lens, moved)
    # A lens that has almost folded is no projective map even within 3 px: stay where it keeps 0.6
    # of its central scale.
    scale = torch.linalg.svdvals(camera.pixel_jacobian(lens, ideal))[:, -1]
    good = closes & moved_closes & (scale * (1 + ideal.square().sum(-1)) > 0.6 * lens.K[0, 0])
    assert good.sum() > 500
    M = camera.observation_matrix(lens, px, ideal)
    depth = 2 + 60 * torch.rand(2000, 1, generator=generator, dtype=torch.float64)
    p = depth * torch.cat((moved_ideal, torch.ones_like(depth)), dim=-1)
    miss = (apply(M, p) - (moved - px))[good].norm(dim=-1)
    assert miss.max() < 0.05


def test_observation_matrices_of_many_pixels_are_those_of_each(monkeypatch, generator):
    lens = make_camera(next(iter(BROWN_CONRADY)))
    px = 100 + 200 * torch.rand(5, 3, 2, generator=generator, dtype=torch.float64)
    ideal, _ = camera.unproject(lens, px)
    bend = camera.projective_bend(lens, ideal)
    expected = camera.observation_matrix(lens, px, ideal)
    monkeypatch.setattr(camera, "_LOT", 4)
    close = torch.testing.assert_close
    close(camera.observation_matrix(lens, px, ideal), expected, rtol=1e-12, atol=1e-12)
    close(camera.observation_matrix(lens, px, ideal, bend=bend), expected, rtol=1e-12, atol=1e-12)
    assert camera.observation_matrix(lens, px[:0], ideal[:0]).shape == (0, 3, 3, 3)


def test_observation_matrix_is_right_to_first_order_at_the_detection(lens, generator):
    ideal = ideal_points(lens, 100, generator)
    px = camera.distort(lens, ideal)
    M = camera.observation_matrix(lens, px, ideal)
    ray = torch.nn.functional.pad(ideal, (0, 1), value=1.0)
    assert (
        apply(M, ray).abs().max() < 1e-7
    )  # rounding of pixels that reach 25,000, over small scales
    J = vmap(
        jacfwd(lambda m, x: apply(m, torch.nn.functional.pad(x, (0, 1), value=1.0)), argnums=1)
    )
    torch.testing.assert_close(
        J(M, ideal), camera.pixel_jacobian(lens, ideal), atol=1e-6, rtol=1e-6
    )


def test_observation_matrix_keeps_the_miss_of_a_pixel_that_does_not_close():
    lens = make_camera("4 barrel wide")
    px = torch.tensor([0.0, 0.0], dtype=torch.float64)
    ideal, closes = camera.unproject(lens, px)
    M = camera.observation_matrix(lens, px, ideal)
    assert not closes
    expected = camera.distort(lens, ideal) - px
    ray = torch.nn.functional.pad(ideal, (0, 1), value=1.0)
    torch.testing.assert_close(apply(M, ray), expected, atol=1e-9, rtol=0)


def test_closing_share_tells_calibrations_apart():
    # the corners of "4 barrel wide" lie beyond its fold; of the others at least the rays below 85
    # degrees close
    for name in LENSES:
        share = camera.closing_share(make_camera(name))
        assert (share < 0.6) if name == "4 barrel wide" else (share > 0.95), name


def test_closing_share_leaves_out_the_rim_of_a_fisheye():
    lens = make_camera("fisheye")
    corner = torch.tensor([0.0, 0.0], dtype=torch.float64)
    assert not camera.unproject(lens, corner)[1]
    assert camera.closing_share(lens) == 1.0


def test_unknown_models_and_wrong_numbers_of_coefficients_are_refused():
    K = torch.eye(3, dtype=torch.float64)
    with pytest.raises(ValueError, match="brown_conrady"):
        Camera("pinhole", 10, 10, K, torch.zeros(0))
    with pytest.raises(ValueError, match=r"3 distortion coefficients; expected one of \(0, 4"):
        Camera("brown_conrady", 10, 10, K, torch.zeros(3))
    with pytest.raises(ValueError, match=r"5 distortion coefficients; expected one of \(4,\)"):
        Camera("kannala_brandt", 10, 10, K, torch.zeros(5))
