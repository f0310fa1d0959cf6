"""Where fits of signs begin: near the truth, whatever side a sign is turned to."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from worlds.sign_drive import F64, SignDrive, drive_past, seen, signs_at, straight_poses

from crowdmap_torch.geometry import camera, polygon
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
from crowdmap_torch.signs.views import SignViews
from crowdmap_torch.tables import concatenate

NOISE, START, FIT = PositioningNoise(), SignStartConfig(), SignFitConfig()
LIMITS = (0.1, 8.0)


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


def _with_plates(drive: SignDrive, plates: int) -> tuple[SignViews, torch.Tensor]:
    """What was seen, and beside it plates of cars ahead that stay where they are in the image but for some sway."""
    views, generator = seen(drive), torch.Generator().manual_seed(3)
    n, first = len(drive.shape), views[views.sign == 0]
    first = first[torch.argsort(first.frame)]
    still = first.corners_px[:1] - first.corners_px[:1, :1] + 600.0
    every = [views]
    for i in range(plates):
        sway = torch.randn(len(first), 1, 2, dtype=F64, generator=generator).mul(10.0).cumsum(0)
        px = still + sway + 0.5 * torch.randn(len(first), 8, 2, dtype=F64, generator=generator)
        rig_camera = drive.journey.rig.camera
        corner = polygon.pad(px, polygon.corner_count(drive.shape[:1]).expand(len(px)))
        ideal, _ = camera.unproject(rig_camera, corner)
        matrix = camera.observation_matrix(rig_camera, corner, ideal)
        every.append(
            replace(
                first,
                sign=torch.full_like(first.sign, n + i),
                corners_px=corner,
                corners_ideal=ideal,
                observation=matrix,
            )
        )
    return concatenate(every), drive.shape[:1].expand(n + plates)


def test_plates_of_cars_do_not_make_a_drive_noisy():
    centers = [(3.5 * (-1) ** i, 60.0 + 5.0 * i, 2.5) for i in range(4)]
    drive = drive_past(straight_poses(120), signs_at(centers), noise_px=0.5)
    views, shape = _with_plates(drive, 24)
    *_, scale, fit = choose_starts_of_drive(views, shape, NOISE, START, FIT, size_limits=LIMITS)
    assert scale[4:].median() > 3.0, "most tracks misfit"
    assert fit.pixels.sigma_px == FIT.pixels.sigma_px
    assert scale[:4].max() < 1.3


def test_two_signs_show_that_their_corners_are_noisy():
    centers = [(3.5, 60.0, 2.5), (-4.0, 75.0, 3.0)]
    drive = drive_past(straight_poses(120), signs_at(centers), noise_px=4.0)
    *_, scale, fit = choose_starts_of_drive(
        seen(drive), drive.shape, NOISE, START, FIT, size_limits=LIMITS
    )
    assert 4.5 <= fit.pixels.sigma_px / FIT.pixels.sigma_px <= 9.0
    assert scale.max() < 1.3
