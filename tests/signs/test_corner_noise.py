"""The noise of corners by themselves: what was put in comes out, of any shape, whatever else is wrong."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.sign_drive import F64, drive_past, seen, signs_at, straight_poses

from crowdmap_torch.geometry import polygon
from crowdmap_torch.noise.pixels import PixelNoiseConfig
from crowdmap_torch.signs.corner_noise import corner_noise
from crowdmap_torch.signs.views import SignViews

CONFIG = PixelNoiseConfig()


def of_shapes(shape: list[int], noise_px: float, seed: int) -> tuple[SignViews, torch.Tensor]:
    """Eight signs of these shapes beside a straight road."""
    centers = [(3.5 * (-1) ** i, 60.0 + 5.0 * i, 2.5) for i in range(8)]
    every = [shape[i % len(shape)] for i in range(8)]
    drive = drive_past(
        straight_poses(120), signs_at(centers), shape=every, noise_px=noise_px, seed=seed
    )
    return seen(drive), drive.shape


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("shape", polygon.SHAPES)
def test_of_noisy_corners_it_is_their_noise(shape: str, seed: int):
    views, code = of_shapes([polygon.SHAPES.index(shape)], 3.0, seed)
    # Small boxes are taken to be noisier.
    box = (views.corners_px.amax(1) - views.corners_px.amin(1)).amax(-1)
    assumed = CONFIG.sigma_px * (1 + (CONFIG.small_box_px / box).square().median()).sqrt()
    assert corner_noise(views, code, CONFIG) == pytest.approx(3.0 / float(assumed), rel=0.1)


def test_of_quiet_corners_it_is_what_is_assumed():
    views, code = of_shapes([polygon.RECTANGLE, polygon.TRIANGLE], 0.3, 0)
    assert corner_noise(views, code, CONFIG) == 1.0


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_of_boxes_it_is_that_of_their_sides(seed: int):
    views, code = of_shapes([polygon.RECTANGLE], 0.0, seed)
    low, high = views.corners_px.amin(1), views.corners_px.amax(1)
    generator = torch.Generator().manual_seed(seed)
    noise = 3.0 * torch.randn(2, *low.shape, dtype=F64, generator=generator)
    low, high = low + noise[0], high + noise[1]
    right = torch.tensor([0.0, 1, 1, 0, 0, 0, 0, 0], dtype=F64)
    down = torch.tensor([0.0, 0, 1, 1, 1, 1, 1, 1], dtype=F64)
    side = torch.stack((right, down), dim=-1)
    boxes = low[:, None] * (1 - side) + high[:, None] * side
    assert polygon.is_box(boxes).all()
    found = corner_noise(replace(views, corners_px=boxes), code, CONFIG)
    assert found == pytest.approx(3.0 / CONFIG.sigma_px, rel=0.25)


def test_where_signs_seem_to_go_has_no_say():
    views, code = of_shapes([polygon.RECTANGLE], 2.0, 0)
    generator = torch.Generator().manual_seed(1)
    size = (len(views.sign), 1, 2)
    moved = views.corners_px + 50.0 * torch.randn(*size, dtype=F64, generator=generator)
    of_moved = corner_noise(replace(views, corners_px=moved), code, CONFIG)
    assert of_moved == pytest.approx(corner_noise(views, code, CONFIG), rel=1e-9)


def test_few_pairs_leave_what_is_assumed():
    views, code = of_shapes([polygon.RECTANGLE], 3.0, 0)
    assert corner_noise(views[:0], code, CONFIG) == 1.0
    assert corner_noise(views[views.sign == 0][:4], code, CONFIG) == 1.0
