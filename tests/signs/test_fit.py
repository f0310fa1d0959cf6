"""Fits of signs: Jacobians against autograd, the noise model, and what a fit must not be led astray by."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.drives import make_journey
from worlds.sign_drive import CAMERA, F64, RIG, drive_past, signs_at, straight_poses

from crowdmap_torch.geometry import camera as cameras
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.road.nonholonomic import DrivePath, drive_path
from crowdmap_torch.signs.fit import (
    SignFitConfig,
    fit_signs,
    fit_signs_coarsely,
    robust_noise_scale,
)
from crowdmap_torch.signs.fit_alone import fit_signs_alone
from crowdmap_torch.signs.views import SignFit, SignStart, SignViews

NOISE = PositioningNoise()

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


def path_of(poses: torch.Tensor) -> DrivePath:
    return drive_path(make_journey(RIG, poses), NOISE, CONFIG.nonholonomic, CONFIG.drift)


def fitted(views: SignViews, drive, start: SignStart, scale: torch.Tensor) -> SignFit:
    """The fit of a drive's signs to views with its poses."""
    path = path_of(drive.journey.T_world_camera)
    return fit_signs(views, drive.shape, start, facing(len(scale)), scale, path, NOISE, CONFIG)


def facing(n: int) -> torch.Tensor:
    return FACING_SOUTH.expand(n, 3)


@pytest.mark.parametrize("coarsely", [False, True])
def test_exact_views_give_exact_signs(coarsely, generator):
    centers = [(3.5 * (-1) ** i, 50.0 + 3.0 * i, 2.0 + 0.2 * i) for i in range(6)]
    drive = drive_past(straight_poses(60), signs_at(centers, yaw_deg=10.0), shape=list(range(6)))
    start, views = start_of(drive, generator), views_of(drive)
    if coarsely:
        found = fit_signs_coarsely(views, drive.shape, start, facing(6), NOISE, CONFIG).start
    else:
        found = fitted(views, drive, start, torch.ones(6, dtype=F64))
    # What signs are usually like pulls along the line of sight, by a tenth of the standard deviation there.
    error = se3.transform(found.T_world_sign[:, None], polygon.corners(drive.shape, found.size))
    tolerance = 0.05 if coarsely else 0.02
    assert float((error - drive.corners_world).norm(dim=-1).max()) < tolerance


def test_signs_of_different_stretches_are_fitted_as_if_alone(generator):
    centers = [(4.0, 50.0, 2.0), (-4.0, 420.0, 2.5)]
    drive = drive_past(straight_poses(540), signs_at(centers), shape=[2, 5], noise_px=0.5)
    start, views = start_of(drive, generator, push=0.02), views_of(drive)
    ones = torch.ones(2, dtype=F64)
    both = fitted(views, drive, start, ones)
    path = path_of(drive.journey.T_world_camera)
    for i in range(2):
        mine = views[views.sign == i]
        alone = fit_signs(
            SignViews(**{**mine.__dict__, "sign": torch.zeros_like(mine.sign)}),
            drive.shape[i : i + 1],
            SignStart(start.T_world_sign[i : i + 1], start.size[i : i + 1]),
            facing(1),
            ones[:1],
            path,
            NOISE,
            CONFIG,
        )
        assert both.drift_scale == alone.drift_scale
        # 300 m apart a tenth of a drift is still in common, and both stop within the solver's tolerance.
        torch.testing.assert_close(both.T_world_sign[i], alone.T_world_sign[0], rtol=0, atol=5e-3)
        sigma, own = both.covariance[i].diagonal().sqrt(), alone.covariance[0].diagonal().sqrt()
        torch.testing.assert_close(sigma, own, rtol=0.05, atol=0)


def noisy_drive(centers, generator, *, scale: float = 1.0):
    """A drive past signs with the noise and the drift that the configuration says, the drift `scale` times that."""
    drive = drive_past(straight_poses(120), signs_at(centers))
    poses = drive.journey.T_world_camera
    f, m = len(poses), len(drive.sign)
    views = views_of(drive)
    noise = CONFIG.pixels.sigma_px * torch.randn(m, 8, 2, dtype=F64, generator=generator)
    box = (views.corners_px.amax(1) - views.corners_px.amin(1)).amax(-1)
    noise = noise * (1 + (CONFIG.pixels.small_box_px / box).square()).sqrt()[:, None, None]
    px = polygon.pad(views.corners_px + noise, torch.full((m,), 4))
    ideal, _ = cameras.unproject(CAMERA, px)
    sigma = torch.tensor([NOISE.walk_m] * 3 + [NOISE.walk_rad] * 3, dtype=F64)
    walk = scale * sigma * (0.8**0.5 * torch.randn(f, 6, dtype=F64, generator=generator)).cumsum(0)
    white = torch.tensor([NOISE.white_sigma_m] * 3 + [NOISE.white_sigma_rad] * 3, dtype=F64)
    error = walk + white * torch.randn(f, 6, dtype=F64, generator=generator)
    given = se3.retract(poses, error)
    noisy = SignViews(
        sign=views.sign,
        frame=views.frame,
        corners_px=px,
        corners_ideal=ideal,
        observation=cameras.observation_matrix(CAMERA, px, ideal),
        T_world_camera=given[views.frame],
    )
    return drive, given, noisy


def test_errors_are_as_large_as_the_covariance_says():
    """White noise and drift of the poses, forty drives past six signs: consistent, and not off to one side."""
    centers = [(3.5 * (-1) ** i, 50.0 + 8.0 * i, 2.5) for i in range(6)]
    n, found = len(centers), []
    for seed in range(40):
        generator = torch.Generator().manual_seed(seed)
        drive, given, views = noisy_drive(centers, generator)
        start = SignStart(drive.T_world_sign, drive.size)
        one = torch.ones(n, dtype=F64)
        fit = fit_signs(views, drive.shape, start, facing(n), one, path_of(given), NOISE, CONFIG)
        # What is left when the pose error at the closest approach is taken off.
        true = drive.journey.T_world_camera[fit.frame]
        moved = se3.transform(true @ se3.inverse(given[fit.frame]), fit.T_world_sign[:, :3, 3])
        error = moved - drive.T_world_sign[:, :3, 3]
        nees = (error * torch.linalg.solve(fit.covariance, error[..., None])[..., 0]).sum(-1)
        found.append(
            torch.cat((error / fit.covariance.diagonal(dim1=1, dim2=2).sqrt(), nees[:, None]), -1)
        )
    z = torch.cat(found)
    # Six signs of a drive share its drift: the mean of 240 squares of three is known to about a tenth.
    assert 2.4 < float(z[:, 3].mean()) < 3.9
    assert float(z[:, :3].mean(0).abs().max()) < 0.3


def test_signs_fitted_alone_are_exact_where_poses_are(generator):
    centers = [(3.5 * (-1) ** i, 50.0 + 3.0 * i, 2.0 + 0.2 * i) for i in range(6)]
    drive = drive_past(straight_poses(60), signs_at(centers, yaw_deg=10.0), shape=list(range(6)))
    path = path_of(drive.journey.T_world_camera)
    start, views = start_of(drive, generator), views_of(drive)
    found = fit_signs_alone(views, drive.shape, start, path, CONFIG)
    error = se3.transform(found.T_world_sign[:, None], polygon.corners(drive.shape, found.size))
    assert float((error - drive.corners_world).norm(dim=-1).max()) < 0.005


def test_signs_fitted_alone_take_drift_for_parallax(generator):
    """Positions that lag by a hundredth of the way make a stretched drive, and signs on it further on."""
    drive = drive_past(straight_poses(60), signs_at([(3.5, 60.0, 2.5)]))
    poses = drive.journey.T_world_camera.clone()
    poses[:, 1, 3] *= 1.01
    views = views_of(drive)
    views = replace(views, T_world_camera=poses[views.frame])
    start = start_of(drive, generator, push=0.02)
    found = fit_signs_alone(views, drive.shape, start, path_of(poses), CONFIG)
    assert found.T_world_sign[0, 1, 3] - drive.T_world_sign[0, 1, 3] == pytest.approx(0.6, abs=0.1)


def test_signs_fitted_alone_have_no_gross_outliers(generator):
    drive = drive_past(straight_poses(60), signs_at([(3.5, 60.0, 2.5)]), noise_px=0.3)
    views, path = views_of(drive), path_of(drive.journey.T_world_camera)
    start = start_of(drive, generator, push=0.02)
    clean = fit_signs_alone(views, drive.shape, start, path, CONFIG)
    bad = pushed(views, 40.0)
    robust = fit_signs_alone(bad, drive.shape, start, path, CONFIG)
    offset = robust.T_world_sign[:, :3, 3] - clean.T_world_sign[:, :3, 3]
    # A tenth of the views are missing: less than a fifth of the standard deviation.
    assert float(offset.norm()) < 0.2 * float(clean.covariance[0].trace().sqrt())


def test_signs_of_one_stretch_hold_each_other(generator):
    centers = [(3.5 * (-1) ** i, 50.0 + 8.0 * i, 2.5) for i in range(6)]
    drive, given, views = noisy_drive(centers, generator)
    start, one = SignStart(drive.T_world_sign, drive.size), torch.ones(6, dtype=F64)
    every = fit_signs(views, drive.shape, start, facing(6), one, path_of(given), NOISE, CONFIG)
    mine = views[views.sign == 2]
    alone = fit_signs(
        SignViews(**{**mine.__dict__, "sign": torch.zeros_like(mine.sign)}),
        drive.shape[2:3],
        SignStart(start.T_world_sign[2:3], start.size[2:3]),
        facing(1),
        one[:1],
        path_of(given),
        NOISE,
        CONFIG,
    )
    assert float(every.covariance[2].trace()) < 0.8 * float(alone.covariance[0].trace())


@pytest.mark.parametrize(("scale", "likely"), [(0.05, (0.125, 0.25)), (1.0, (0.5, 1.0, 2.0))])
def test_a_journey_says_itself_how_much_it_drifts(scale, likely):
    centers = [(3.5 * (-1) ** i, 45.0 + 5.0 * i, 2.0 + 0.2 * (i % 3)) for i in range(12)]
    drive, given, views = noisy_drive(centers, torch.Generator().manual_seed(3), scale=scale)
    start, one = SignStart(drive.T_world_sign, drive.size), torch.ones(12, dtype=F64)
    fit = fit_signs(views, drive.shape, start, facing(12), one, path_of(given), NOISE, CONFIG)
    assert fit.drift_scale in likely


def pushed(views: SignViews, by_px: float) -> SignViews:
    """The same views, every tenth of them moved in the image."""
    px = views.corners_px.clone()
    px[::10] += by_px
    ideal, _ = cameras.unproject(CAMERA, px)
    return replace(
        views,
        corners_px=px,
        corners_ideal=ideal,
        observation=cameras.observation_matrix(CAMERA, px, ideal),
    )


def test_gross_outliers_have_no_say(generator):
    drive = drive_past(straight_poses(60), signs_at([(3.5, 60.0, 2.5)]), noise_px=0.3)
    views, one = views_of(drive), torch.ones(1, dtype=F64)
    bad = pushed(views, 40.0)
    keep = torch.ones(len(views), dtype=torch.bool)
    keep[::10] = False
    start = start_of(drive, generator, push=0.02)
    robust = fitted(bad, drive, start, one)
    clean = fitted(views[keep], drive, start, one)
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
    fit = fitted(boxes, drive, start, torch.ones(1, dtype=F64))
    assert float((fit.T_world_sign - drive.T_world_sign)[:, :3, 3].norm()) < 0.25


def test_the_noise_scale_is_the_median_of_each_sign():
    error_sq = torch.tensor([4.0, 900.0, 4.0, 0.1, 0.2, 0.3, 1e6], dtype=F64)
    sign = torch.tensor([0, 0, 0, 1, 1, 1, 2])
    assert robust_noise_scale(error_sq, sign, 3).tolist() == [2.0, 1.0, 1e3]
