"""Fits of signs: Jacobians against autograd, the noise model, and what a fit must not be led astray by."""

from __future__ import annotations

import pytest
import torch
from sign_drive import CAMERA, F64, drive_past, signs_at, straight_poses
from torch.func import jacfwd, jacrev

from crowdmap_torch.geometry import camera as cameras
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.optim.problem import positive
from crowdmap_torch.sign_fit import (
    SignFitConfig,
    SignStart,
    SignViews,
    fit_signs,
    fit_signs_coarsely,
    robust_noise_scale,
)
from crowdmap_torch.sign_view import (
    drifting_sign_view,
    drifting_sign_view_jacobian,
    sign_view,
    sign_view_jacobian,
)

CONFIG = SignFitConfig()
FACING_SOUTH = torch.tensor([0.0, -1.0, 0.0], dtype=F64)


def views_of(drive) -> SignViews:
    """The detections of a drive, corners in the signs' order."""
    signs = drive.journey.signs
    T = se3.inverse(drive.journey.T_world_camera[signs.frame])
    exact = se3.transform(T[:, None], drive.corners_world[drive.sign])
    count = polygon.corner_count(signs.shape)
    px, _ = cameras.project(CAMERA, exact)
    shift, _ = polygon.best_shift(px, signs.corners_px, count)
    px = polygon.roll(signs.corners_px, shift, count)
    ideal = polygon.roll(signs.corners_ideal, shift, count)
    return SignViews(
        sign=drive.sign,
        frame=signs.frame,
        corners_px=px,
        corners_ideal=ideal,
        observation=cameras.observation_matrix(CAMERA, px, ideal),
        T_world_camera=drive.journey.T_world_camera[signs.frame],
    )


def start_of(drive, generator, *, push: float = 0.1) -> SignStart:
    n = len(drive.T_world_sign)
    xi = push * torch.randn(n, 6, dtype=F64, generator=generator)
    return SignStart(se3.retract(drive.T_world_sign, xi), drive.size * 1.2)


def facing(n: int) -> torch.Tensor:
    return FACING_SOUTH.expand(n, 3)


@pytest.mark.parametrize("shape", range(len(polygon.SHAPES)))
def test_jacobians_are_those_of_forward_and_reverse_autograd(shape, generator):
    drive = drive_past(straight_poses(12), signs_at([(3.0, 30.0, 2.2)]), shape=[shape], noise_px=1)
    views = views_of(drive)[torch.tensor([2])]
    c = int(polygon.corner_count(torch.tensor(shape)))
    T, size = se3.retract(drive.T_world_sign, torch.full((1, 6), 0.05, dtype=F64)), drive.size
    whitening = torch.randn(1, 2 * c, 2 * c, dtype=F64, generator=generator)
    expected = torch.randn(1, 2 * c, dtype=F64, generator=generator)
    before, after = 0.1 * torch.randn(2, 1, 3, dtype=F64, generator=generator)
    constants = (
        views.T_world_camera,
        polygon.template(torch.tensor([shape]))[:, :c],
        views.observation[:, :c],
        expected,
        whitening,
    )
    share = torch.tensor([0.3], dtype=F64)
    row = tuple(x[0] for x in constants)

    def still(xi, log_size):
        moved = se3.retract(T[0], xi)
        return sign_view(moved, positive(size[0], log_size), *row)

    def drifting(xi, log_size, d_before, d_after):
        moved = se3.retract(T[0], xi)
        return drifting_sign_view(
            moved,
            positive(size[0], log_size),
            before[0] + d_before,
            after[0] + d_after,
            row[0],
            row[1],
            row[2],
            row[3],
            row[4],
            share[0],
        )

    zeros = [torch.zeros(k, dtype=F64) for k in (6, 2, 3, 3)]
    value, found = sign_view_jacobian(T, size, *constants)
    drifted, with_drift = drifting_sign_view_jacobian(T, size, before, after, *constants, share)
    torch.testing.assert_close(value[0], still(*zeros[:2]))
    torch.testing.assert_close(drifted[0], drifting(*zeros))
    for jacobian in (jacfwd, jacrev):
        for exact, J in zip(jacobian(still, (0, 1))(*zeros[:2]), found, strict=True):
            torch.testing.assert_close(J[0], exact)
        for exact, J in zip(jacobian(drifting, (0, 1, 2, 3))(*zeros), with_drift, strict=True):
            torch.testing.assert_close(J[0], exact)


@pytest.mark.parametrize("fit", [fit_signs, fit_signs_coarsely])
def test_exact_views_give_exact_signs(fit, generator):
    centers = [(3.5 * (-1) ** i, 50.0 + 3.0 * i, 2.0 + 0.2 * i) for i in range(6)]
    drive = drive_past(straight_poses(60), signs_at(centers, yaw_deg=10.0), shape=list(range(6)))
    start = start_of(drive, generator)
    scale = () if fit is fit_signs_coarsely else (torch.ones(6, dtype=F64),)
    found = fit(views_of(drive), drive.shape, start, facing(6), *scale, CONFIG)
    # What signs are usually like pulls along the line of sight, by a tenth of the standard deviation there.
    error = se3.transform(found.T_world_sign[:, None], polygon.corners(drive.shape, found.size))
    tolerance = 0.02 if fit is fit_signs else 0.05
    assert float((error - drive.corners_world).norm(dim=-1).max()) < tolerance


def test_signs_are_fitted_as_if_each_were_alone(generator):
    centers = [(4.0, 50.0, 2.0), (-4.0, 55.0, 2.5)]
    drive = drive_past(straight_poses(60), signs_at(centers), shape=[2, 5], noise_px=0.5)
    start, views = start_of(drive, generator), views_of(drive)
    ones = torch.ones(2, dtype=F64)
    both = fit_signs(views, drive.shape, start, facing(2), ones, CONFIG)
    for i in range(2):
        mine = views[views.sign == i]
        alone = fit_signs(
            SignViews(**{**mine.__dict__, "sign": torch.zeros_like(mine.sign)}),
            drive.shape[i : i + 1],
            SignStart(start.T_world_sign[i : i + 1], start.size[i : i + 1]),
            facing(1),
            ones[:1],
            CONFIG,
        )
        # Both stop when their own cost no longer falls: to a hundredth of a millimetre the same.
        torch.testing.assert_close(both.T_world_sign[i], alone.T_world_sign[0], rtol=0, atol=1e-5)


def test_errors_are_as_large_as_the_covariance_says(generator):
    """White noise and drift of the poses, two hundred drives past one sign: consistent, and not off to one side."""
    n, poses = 200, straight_poses(60)
    one = drive_past(poses, signs_at([(3.5, 60.0, 2.5)]), noise_px=0.0)
    views = views_of(one)
    order = torch.argsort(views.frame)
    views = views[order]
    m = len(views)
    many = views[torch.arange(m).repeat(n)]
    noise = 0.6 * torch.randn(n * m, 8, 2, dtype=F64, generator=generator)
    box = (many.corners_px.amax(1) - many.corners_px.amin(1)).amax(-1)
    noise = noise * (1 + (12.0 / box).square()).sqrt()[:, None, None]
    px = polygon.pad(many.corners_px + noise, torch.full((n * m,), 4))
    ideal, _ = cameras.unproject(CAMERA, px)
    walk = 0.8**0.5 * torch.randn(n, m, 6, dtype=F64, generator=generator)
    walk[:, -1] = 0
    # Summed backwards from the closest view, the last one.
    walk = walk.flip(1).cumsum(1).flip(1)
    sigma = torch.tensor([CONFIG.drift.sigma_m] * 3 + [CONFIG.drift.sigma_rad] * 3, dtype=F64)
    white = torch.tensor([CONFIG.pose_sigma_m] * 3 + [CONFIG.pose_sigma_rad] * 3, dtype=F64)
    error = walk * sigma + white * torch.randn(n, m, 6, dtype=F64, generator=generator)
    T = se3.retract(many.T_world_camera, error.reshape(n * m, 6))
    noisy = SignViews(
        sign=torch.arange(n).repeat_interleave(m),
        frame=many.frame,
        corners_px=px,
        corners_ideal=ideal,
        observation=cameras.observation_matrix(CAMERA, px, ideal),
        T_world_camera=T,
    )
    start = SignStart(one.T_world_sign.expand(n, 4, 4), one.size.expand(n, 2))
    shape = one.shape.expand(n)
    fit = fit_signs(noisy, shape, start, facing(n), torch.ones(n, dtype=F64), CONFIG)
    offset = (fit.T_world_sign - one.T_world_sign)[:, :3, 3]
    ray = torch.nn.functional.normalize(
        one.T_world_sign[0, :3, 3] - views.T_world_camera[-1, :3, 3], dim=0
    )
    along = offset @ ray
    predicted = (ray @ fit.covariance @ ray).sqrt()
    # 200 draws: the spread of z is known to 5 percent, its mean to 0.07; the closest pose's own noise is on top.
    assert 0.8 < float((along / predicted).std()) < 1.2
    assert abs(float((along / predicted).mean())) < 0.3


def test_gross_outliers_have_no_say(generator):
    drive = drive_past(straight_poses(60), signs_at([(3.5, 60.0, 2.5)]), noise_px=0.3)
    views, one = views_of(drive), torch.ones(1, dtype=F64)
    px = views.corners_px.clone()
    px[::10] += 40.0
    ideal, _ = cameras.unproject(CAMERA, px)
    bad = SignViews(
        **{
            **views.__dict__,
            "corners_px": px,
            "corners_ideal": ideal,
            "observation": cameras.observation_matrix(CAMERA, px, ideal),
        }
    )
    keep = torch.ones(len(views), dtype=torch.bool)
    keep[::10] = False
    start = start_of(drive, generator, push=0.02)
    robust = fit_signs(bad, drive.shape, start, facing(1), one, CONFIG)
    clean = fit_signs(views[keep], drive.shape, start, facing(1), one, CONFIG)
    assert bool((robust.error_sq[~keep] > CONFIG.tukey**2).all())
    offset = robust.T_world_sign[:, :3, 3] - clean.T_world_sign[:, :3, 3]
    assert float(offset.norm()) < 2e-3


def test_boxes_place_signs_by_their_centres(generator):
    """A box that is drawn a third too large must not bring the sign nearer."""
    drive = drive_past(straight_poses(60), signs_at([(3.5, 60.0, 2.5)]))
    views = views_of(drive)
    low, high = views.corners_px.amin(1), views.corners_px.amax(1)
    middle, half = (low + high) / 2, (high - low) / 2
    # Drawn the larger, the nearer it is.
    half = half * (1 + 0.006 * (half.amax(-1, keepdim=True)))
    side = torch.tensor([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=F64)
    px = polygon.pad(
        torch.nn.functional.pad(
            (middle[:, None] + side * half[:, None]).mT, (0, 4)
        ).mT.contiguous(),
        torch.full((len(views),), 4),
    )
    ideal, _ = cameras.unproject(CAMERA, px)
    boxes = SignViews(
        **{
            **views.__dict__,
            "corners_px": px,
            "corners_ideal": ideal,
            "observation": cameras.observation_matrix(CAMERA, px, ideal),
        }
    )
    start = SignStart(drive.T_world_sign, drive.size)
    fit = fit_signs(boxes, drive.shape, start, facing(1), torch.ones(1, dtype=F64), CONFIG)
    assert float((fit.T_world_sign - drive.T_world_sign)[:, :3, 3].norm()) < 0.25


def test_the_noise_scale_is_the_median_of_each_sign():
    error_sq = torch.tensor([4.0, 900.0, 4.0, 0.1, 0.2, 0.3, 1e6], dtype=F64)
    sign = torch.tensor([0, 0, 0, 1, 1, 1, 2])
    assert robust_noise_scale(error_sq, sign, 3, 4.0).tolist() == [2.0, 1.0, 4.0]
