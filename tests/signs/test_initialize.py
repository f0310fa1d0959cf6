"""Where fits of signs begin: near the truth, whatever side a sign is turned to."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch
from worlds.sign_drive import F64, SignDrive, drive_past, signs_at, straight_poses

from crowdmap_torch.geometry import camera, polygon, se3
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.signs.fit import SignFitConfig
from crowdmap_torch.signs.initialize import (
    SignStartConfig,
    centre_points,
    choose_starts,
    choose_starts_again,
    choose_starts_of_drive,
    starts,
)
from crowdmap_torch.signs.triangulate import views_of
from crowdmap_torch.signs.views import SignViews
from crowdmap_torch.tables import Tracklets

NOISE, START, FIT = PositioningNoise(), SignStartConfig(), SignFitConfig()
LIMITS = (0.1, 8.0)


def seen(drive: SignDrive) -> SignViews:
    """The views of a drive, corners in the order of the signs' templates."""
    signs = drive.journey.signs
    T = se3.inverse(drive.journey.T_world_camera[signs.frame])
    exact = se3.transform(T[:, None], drive.corners_world[drive.sign])
    px, _ = camera.project(drive.journey.rig.camera, exact)
    shift, _ = polygon.best_shift(px, signs.corners_px, polygon.corner_count(signs.shape))
    tracklets = Tracklets(drive.sign, len(drive.T_world_sign), shift)
    return views_of(drive.journey, tracklets, torch.arange(len(signs)), drive.sign)


@pytest.fixture(scope="module")
def drive() -> SignDrive:
    centers = [(3.5, 60.0, 2.5), (-4.0, 75.0, 3.0), (4.5, 90.0, 2.2)]
    return drive_past(straight_poses(120), signs_at(centers, yaw_deg=[0.0, 35.0, -35.0]))


def test_mid_points_of_exact_rays_are_the_centres(drive: SignDrive):
    found = centre_points(seen(drive), 3, typical_height_m=0.7)
    # The middle of a turned sign's outline is not its middle as seen: by a centimetre or two from the side.
    assert (found - drive.T_world_sign[:, :3, 3]).norm(dim=-1).max() < 0.05


def test_starts_are_turned_by_each_yaw_and_the_last_is_the_plane(drive: SignDrive):
    views = seen(drive)
    centre = centre_points(views, 3, typical_height_m=0.7)
    yaws = (-0.5, 0.0, 0.5)
    found = starts(views, drive.shape, centre, yaws=yaws, size_limits=LIMITS)
    assert len(found) == 4
    normals = [start.T_world_sign[:, :3, 2] for start in found[:3]]
    for a, b in pairwise(normals):
        assert torch.allclose((a * b).sum(-1), torch.full((3,), math.cos(0.5), dtype=F64))
    facing = (found[3].T_world_sign[:, :3, 2] * drive.T_world_sign[:, :3, 2]).sum(-1)
    assert facing.min() > math.cos(math.radians(3.0))


def test_of_several_starts_the_nearest_to_what_was_seen_is_chosen(drive: SignDrive):
    found, scale = choose_starts(seen(drive), drive.shape, NOISE, START, FIT, size_limits=LIMITS)
    assert (found.T_world_sign - drive.T_world_sign)[:, :3, 3].norm(dim=-1).max() < 0.05
    # Nothing is noisier than usual here.
    assert torch.equal(scale, torch.ones_like(scale))


def test_starts_chosen_again_leave_the_others_alone(drive: SignDrive):
    views = seen(drive)
    first, scale = choose_starts(views, drive.shape, NOISE, START, FIT, size_limits=LIMITS)
    again = torch.tensor([False, True, False])
    moved = first.T_world_sign.clone()
    moved[:, 0, 3] += 1.0
    wrong = type(first)(moved, first.size)
    found, _ = choose_starts_again(
        views, again, drive.shape, wrong, 2 * scale, NOISE, START, FIT, size_limits=LIMITS
    )
    assert torch.equal(found.T_world_sign[~again], moved[~again])
    assert torch.allclose(found.T_world_sign[again], first.T_world_sign[again], atol=1e-6)


@pytest.mark.parametrize(("noise_px", "least", "most"), [(0.5, 1.0, 1.0), (4.0, 4.5, 9.0)])
def test_corners_are_as_noisy_as_the_drive_shows(noise_px: float, least: float, most: float):
    centers = [(3.5 * (-1) ** i, 60.0 + 5.0 * i, 2.5) for i in range(8)]
    drive = drive_past(straight_poses(120), signs_at(centers), noise_px=noise_px)
    *_, scale, fit = choose_starts_of_drive(
        seen(drive), drive.shape, NOISE, START, FIT, size_limits=LIMITS
    )
    assert least <= fit.pixels.sigma_px / FIT.pixels.sigma_px <= most
    assert scale.median() < 1.3
