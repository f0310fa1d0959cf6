from __future__ import annotations

import pytest
import torch

from crowdmap_torch.pixel_noise import noise_by_box, shared_error

F64 = torch.float64
M = 20_000


def lengths(box, large, small, generator, outliers=0.0):
    """Lengths of two-dimensional residuals in units of their median's expectation."""
    sigma = large * (1 + (small / box).square()).sqrt()
    error = sigma[:, None] * torch.randn(len(box), 2, dtype=F64, generator=generator)
    far = torch.rand(len(box), generator=generator) < outliers
    error[far] += 30
    return error.norm(dim=-1) / 1.1774


@pytest.mark.parametrize("small", [0.0, 12.0, 30.0])
@pytest.mark.parametrize("outliers", [0.0, 0.03])
def test_noise_of_small_boxes_is_found_among_outliers(generator, small, outliers):
    box = 12 + 60 * torch.rand(M, dtype=F64, generator=generator).square()
    noise = noise_by_box(lengths(box, 0.55, small, generator, outliers), box)
    for size in (12.0, 20.0, 50.0):
        true = 0.55 * (1 + (small / size) ** 2) ** 0.5
        found = noise.large_px * (1 + (noise.small_box_px / size) ** 2) ** 0.5
        # The median of a class of 2500 scatters by 1.5 %, and 3 % of outliers move it by as much.
        assert float(found) == pytest.approx(true, rel=0.06)


def test_large_boxes_are_never_worse_than_small_ones(generator):
    box = 12 + 60 * torch.rand(M, dtype=F64, generator=generator)
    noise = noise_by_box(lengths(box, 0.02, 0.0, generator) * box, box)
    assert noise.small_box_px == 0
    assert 0.4 < noise.large_px < 1.2


def test_few_corners_have_one_noise():
    length, box = torch.tensor([0.4, 0.6], dtype=F64), torch.tensor([20.0, 20.0], dtype=F64)
    noise = noise_by_box(length, box)
    assert noise.large_px.isfinite() and noise.small_box_px.isfinite()
    assert 0.3 < noise.large_px < 0.7


@pytest.mark.parametrize("common", [0.0, 0.3, 1.0])
def test_points_of_one_detection_that_err_together_are_found_out(generator, common):
    points, detections = 5, 4000
    residual = torch.randn(detections, points, dtype=F64, generator=generator)
    residual += common * torch.randn(detections, 1, dtype=F64, generator=generator)
    frame = torch.arange(detections) // 4
    detection = torch.arange(detections) % 7
    factor = shared_error(
        residual.flatten(), frame.repeat_interleave(points), detection.repeat_interleave(points)
    )
    expected = ((1 + points * common**2) / (1 + common**2)) ** 0.5
    assert float(factor) == pytest.approx(expected, rel=0.05)


def test_single_points_say_nothing_of_each_other():
    number = torch.arange(5)
    assert shared_error(torch.ones(5, dtype=F64), number, number) == 1
    nothing = number[:0]
    assert shared_error(torch.ones(0, dtype=F64), nothing, nothing) == 1
