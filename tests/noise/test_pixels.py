from __future__ import annotations

import pytest
import torch

from crowdmap_torch.geometry import polygon
from crowdmap_torch.noise import pixels
from crowdmap_torch.noise.pixels import (
    _CLASSES,
    DetectionNoise,
    PixelNoiseConfig,
    box_scales,
    detection_noise,
    noise_by_box,
    shared_error,
)

CONFIG, F64 = PixelNoiseConfig(), torch.float64
RECTANGLES = torch.tensor([polygon.RECTANGLE])
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


def box_of(side_px: float) -> torch.Tensor:
    corners = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]], dtype=F64)[[0, 1, 2, 3, 3, 3, 3, 3]]
    return 200 + side_px * corners[None]


def noise_of(corners_px: torch.Tensor, factor: float, sigma_m: float) -> DetectionNoise:
    """The noise of a detection that the pose's first component moves as a whole, ten pixels a metre."""
    by_pose = torch.zeros(1, 16, 6, dtype=F64)
    by_pose[:, ::2, 0] = 10.0
    variance = torch.zeros(1, 6, dtype=F64)
    variance[:, 0] = sigma_m**2
    scale = torch.full((1,), factor, dtype=F64)
    return detection_noise(corners_px, RECTANGLES, scale, by_pose, variance, 0 * variance, CONFIG)


def test_covariances_are_those_of_pixels_boxes_and_poses():
    corners = box_of(CONFIG.small_box_px)
    whitening = noise_of(corners, 2.0, 0.3).whitening[0]
    covariance = torch.linalg.inv(whitening.mT @ whitening)
    # A box as small as this has twice the variance of a large one, and twice the scale four times that.
    pixel = 8 * CONFIG.sigma_px**2
    side = CONFIG.box_sigma * CONFIG.small_box_px / 2
    assert float(covariance[0, 0]) == pytest.approx(pixel + side**2 + (10 * 0.3) ** 2)
    assert float(covariance[1, 1]) == pytest.approx(pixel + side**2)
    # Left and right sides of a box part, the pose moves them alike.
    assert float(covariance[0, 2]) == pytest.approx(-(side**2) + (10 * 0.3) ** 2)


def test_many_detections_have_the_noise_of_each(monkeypatch, generator):
    by_pose = torch.randn(10, 16, 6, dtype=F64, generator=generator)
    corners = torch.cat([box_of(side) for side in range(5, 55, 5)])
    factor = torch.linspace(1, 3, 10, dtype=F64)
    variance = torch.rand(10, 6, dtype=F64, generator=generator)

    def found(some: slice) -> torch.Tensor:
        known = corners[some], RECTANGLES.expand(10)[some], factor[some], by_pose[some]
        return detection_noise(*known, variance[some], variance[some], CONFIG).whitening

    monkeypatch.setattr(pixels, "_LOT", 4)
    of_all = found(slice(None))
    for i in range(10):
        torch.testing.assert_close(
            of_all[i : i + 1], found(slice(i, i + 1)), rtol=1e-12, atol=1e-12
        )
    assert found(slice(0)).shape == (0, 16, 16)


def test_outlines_that_are_no_boxes_have_no_error_of_their_sides():
    tilted = box_of(40.0)
    tilted[..., 1] += 0.3 * tilted[..., 0]
    assert box_scales(tilted, RECTANGLES).count_nonzero() == 0
    assert box_scales(box_of(40.0), RECTANGLES).count_nonzero() == 16


def test_shapes_drawn_into_boxes_have_the_errors_of_the_boxes():
    octagon = torch.tensor([polygon.OCTAGON])
    low, high = torch.tensor([[300.0, 200.0]], dtype=F64), torch.tensor([[340.0, 230.0]], dtype=F64)
    across, up = box_scales(polygon.in_box(low, high, octagon), octagon)[0].unbind(-1)
    # A box 1 % wider, its middle where it was, has the corners that these derivatives say.
    wider = torch.tensor([[0.2, 0.0]], dtype=F64)
    moved = polygon.in_box(low - wider, high + wider, octagon)
    moved = (moved - polygon.in_box(low, high, octagon)).flatten()
    torch.testing.assert_close(0.01 * across, moved, rtol=0, atol=1e-9)
    assert not up[::2].any() and up[1::2].abs().max() == 15.0


def test_a_detection_moved_as_a_whole_is_its_poses_error():
    noise = noise_of(box_of(40.0), 1.0, 0.3)
    moved = torch.zeros(1, 16, dtype=F64)
    moved[:, ::2] = 10.0 * 0.2
    found = noise.likely_pose_error((noise.whitening @ moved[..., None])[..., 0])
    # The prior's share is small beside what sixteen pixels say.
    assert float(found[0, 0]) == pytest.approx(-0.2, rel=0.05)
    assert found[0, 1:].count_nonzero() == 0


def test_noise_by_box_is_the_least_squares_of_the_classes(generator):
    box = 10 + 90 * torch.rand(4000, dtype=torch.float64, generator=generator)
    length = lengths(box, 0.55, 12.0, generator)
    classes = torch.argsort(box, stable=True).tensor_split(_CLASSES)
    variance = torch.stack([length[c].median().square() for c in classes])
    inverse = torch.stack([box[c].median() for c in classes]).pow(-2)
    A = torch.stack((torch.ones_like(inverse), inverse), dim=1) / variance[:, None]
    large, small = torch.linalg.lstsq(A, torch.ones_like(variance)).solution
    found = noise_by_box(length, box)
    assert float(found.large_px) == pytest.approx(float(large.sqrt()), rel=1e-9)
    assert float(found.small_box_px) == pytest.approx(float((small / large).sqrt()), rel=1e-9)
