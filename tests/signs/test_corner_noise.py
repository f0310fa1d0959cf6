"""The noise of corners by themselves: what was put in comes out, of any shape, whatever else is wrong."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.sign_drive import F64, drive_past, seen, signs_at, straight_poses

from crowdmap_torch.geometry import polygon
from crowdmap_torch.noise.pixels import PixelNoiseConfig, corner_variance, longer_side
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


def assumed_of(views: SignViews) -> float:
    """The noise that is usual of corners of views such as these [px]: small boxes are taken to be noisier."""
    box = longer_side(views.corners_px)
    return float(corner_variance(box, CONFIG).median().sqrt())


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("shape", polygon.SHAPES)
def test_of_noisy_corners_it_is_their_noise(shape: str, seed: int):
    views, code = of_shapes([polygon.SHAPES.index(shape)], 3.0, seed)
    assert corner_noise(views, code, CONFIG) == pytest.approx(3.0 / assumed_of(views), rel=0.1)


def test_of_quiet_corners_it_is_what_is_assumed():
    views, code = of_shapes([polygon.RECTANGLE, polygon.TRIANGLE], 0.3, 0)
    assert corner_noise(views, code, CONFIG) == 1.0


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("shape", polygon.SHAPES)
def test_of_shapes_drawn_into_boxes_it_is_that_of_the_boxes_sides(shape: str, seed: int):
    views, code = of_shapes([polygon.SHAPES.index(shape)], 0.0, seed)
    # Of smaller boxes sides would change places, which makes them none.
    views = views[(views.corners_px.amax(1) - views.corners_px.amin(1)).amin(-1) > 10.0]
    low, high = views.corners_px.amin(1), views.corners_px.amax(1)
    generator = torch.Generator().manual_seed(seed)
    noise = 2.0 * torch.randn(2, *low.shape, dtype=F64, generator=generator)
    low, high = low + noise[0], high + noise[1]
    boxes = polygon.in_box(low, high, code[views.sign])
    assert polygon.is_box(boxes, code[views.sign]).all()
    found = corner_noise(replace(views, corners_px=boxes), code, CONFIG)
    assert found == pytest.approx(2.0 / assumed_of(views), rel=0.15)


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
