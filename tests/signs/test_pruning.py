"""Which tracklets are no signs, each with its reason, and which of others are kept all the same."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.sign_drive import (
    ALL_SHAPES,
    ALONG_THE_ROAD,
    F64,
    NOISE,
    by_truth,
    corner_errors,
    drive_past,
    mapped,
    mixed_street,
    moved_corners,
    signs_at,
    straight_poses,
    with_rows,
)

from crowdmap_torch.signs.pruning import (
    FEW_FRAMES,
    KEPT,
    NO_PARALLAX,
    REASONS,
    SignTriangulationConfig,
)
from crowdmap_torch.signs.triangulate import triangulate_signs

CONFIG = SignTriangulationConfig()


def test_signs_fitted_one_by_one_need_more_parallax():
    drive = drive_past(straight_poses(50), signs_at([(3.5, 70.0, 2.2)]))
    drive = with_rows(drive, (drive.journey.signs.frame < 37).nonzero()[:, 0])
    frames = drive.journey.signs.frame.sort().values
    at = drive.journey.T_world_camera[frames[[0, -1]], :3, 3]
    ray = torch.nn.functional.normalize(drive.T_world_sign[0, :3, 3] - at, dim=1)
    parallax_deg = float(torch.rad2deg((ray[0] @ ray[1]).acos()))
    tracklets = by_truth(drive)
    kept, _ = triangulate_signs(drive.journey, tracklets, NOISE, SignTriangulationConfig())
    assert len(kept) == 1
    for share, reason in ((0.9, KEPT), (1.1, NO_PARALLAX)):
        config = SignTriangulationConfig(
            method="paper2017", min_parallax_alone_deg=share * parallax_deg
        )
        _, report = triangulate_signs(drive.journey, tracklets, NOISE, config)
        assert report.reason.tolist() == [reason]


def test_an_unknown_method_is_refused():
    with pytest.raises(ValueError, match="method: expected one of"):
        SignTriangulationConfig(method="best")


def test_few_frames_are_pruned_and_counted():
    street = mixed_street()
    few = (street.journey.signs.frame < 2).nonzero()[:, 0]
    signs, report = mapped(with_rows(street, few).journey)
    assert len(signs) == 0
    assert report.pruned["too few frames"] == len(report.reason) > 0
    assert bool((report.reason == FEW_FRAMES).all())


@pytest.mark.parametrize("noise_px", [2.5, 5.0])
def test_a_noisy_detector_costs_no_sign(noise_px: float):
    """As of a camera of many pixels: by a bound in multiples of 0.6 px half of the signs, or all, were pruned."""
    drive = drive_past(
        straight_poses(80),
        signs_at(ALONG_THE_ROAD, yaw_deg=8.0),
        shape=ALL_SHAPES,
        noise_px=noise_px,
    )
    signs, _ = triangulate_signs(drive.journey, by_truth(drive), NOISE, CONFIG)
    assert len(signs) == len(ALL_SHAPES)
    assert float(corner_errors(signs, drive).mean()) < 0.05 * noise_px


def test_a_sign_much_noisier_than_the_others_is_pruned():
    """It would be a false one: what is usual follows the others."""
    street = mixed_street()
    noisy = street.sign == 2
    generator = torch.Generator().manual_seed(5)
    noise = 6.0 * torch.randn(int(noisy.sum()), 8, 2, dtype=F64, generator=generator)
    drive = moved_corners(street, noisy.nonzero()[:, 0], noise)
    _, report = triangulate_signs(drive.journey, by_truth(street), NOISE, CONFIG)
    assert REASONS[int(report.reason[2])] == "residual too large"
    assert report.pruned["kept"] == len(ALL_SHAPES) - 1


def test_signs_that_are_seen_a_few_times_each_are_mapped():
    """As by a slow camera: less well placed than long tracklets, of which short runs are taken for false."""
    places = [(3.5 * (-1) ** i, 60.0 + 25.0 * i, 2.5) for i in range(8)]
    slow, fast = (
        drive_past(
            straight_poses(round(320 / step_m), step_m=step_m),
            signs_at(places, yaw_deg=8.0),
            noise_px=1.0,
            depth_m=(20.0, 50.0),
        )
        for step_m in (8.0, 1.0)
    )
    signs, report = triangulate_signs(slow.journey, by_truth(slow), NOISE, CONFIG)
    assert report.pruned["kept"] == len(places)
    assert int(torch.bincount(slow.sign).max()) <= 4
    sigma = torch.linalg.eigvalsh(signs.covariance)[:, -1].sqrt()
    assert float(sigma.min()) > CONFIG.max_doubtful_sigma_m
    assert float(corner_errors(signs, slow).mean()) < 1.0
    # Beside signs that are seen thirty times the same four views are a short run.
    run = (fast.sign != 3) | (fast.journey.signs.frame % 8 == 0)
    short = with_rows(fast, run.nonzero()[:, 0])
    signs, report = triangulate_signs(short.journey, by_truth(short), NOISE, CONFIG)
    assert REASONS[int(report.reason[3])] == "position too uncertain"
    assert report.pruned["kept"] == len(signs) == len(places) - 1
    # It is no sign of this drive's, but may be one of other drives'.
    assert report.doubtful.tracklet.tolist() == [3]


def test_signs_that_are_only_seen_from_afar_are_rays_to_those_of_others():
    """Too far away, or placed too badly, for a sign of this drive; too short a run tells nothing of others either."""
    places = [(3.5 * (-1) ** i, 60.0 + 25.0 * i, 2.5) for i in range(8)]
    drive = drive_past(
        straight_poses(320), signs_at(places, yaw_deg=8.0), noise_px=1.0, depth_m=(20.0, 100.0)
    )
    depth = drive.T_world_sign[drive.sign, 1, 3] - 0.8 * drive.journey.signs.frame
    far = with_rows(drive, ((drive.sign != 3) | (depth > 70.0)).nonzero()[:, 0])
    narrow = replace(CONFIG, max_distance_m=60.0)
    signs, report = triangulate_signs(far.journey, by_truth(far), NOISE, narrow)
    assert REASONS[int(report.reason[3])] == "too far away"
    assert report.from_afar.tracklet.tolist() == [3] and len(report.doubtful) == 0
    off = report.from_afar.center_world[0] - far.T_world_sign[3, :3, 3]
    assert float(off[[0, 2]].norm()) < 0.3
    # As near as that it is allowed to be, but no better placed than it is.
    sigma = float(torch.linalg.eigvalsh(report.from_afar.covariance[0])[-1].sqrt())
    strict = replace(CONFIG, max_sigma_m=sigma / 2)
    signs, report = triangulate_signs(far.journey, by_truth(far), NOISE, strict)
    assert REASONS[int(report.reason[3])] == "position too uncertain"
    assert 3 in report.from_afar.tracklet and 3 not in signs.tracklet
    stricter = replace(strict, max_afar_sigma_m=sigma / 2)
    _, report = triangulate_signs(far.journey, by_truth(far), NOISE, stricter)
    assert 3 not in report.from_afar.tracklet
    # Four views of it beside signs that are seen for hundreds of frames.
    glance = (far.sign != 3) | (far.journey.signs.frame % 9 == 0)
    short = with_rows(far, glance.nonzero()[:, 0])
    _, report = triangulate_signs(short.journey, by_truth(short), NOISE, narrow)
    assert int((short.sign == 3).sum()) <= 5 and not len(report.from_afar)


def test_a_standing_car_maps_nothing_new():
    """No parallax, no place: whatever was seen from one spot is pruned, and no error is raised."""
    drive = drive_past(straight_poses(1).expand(60, 4, 4), signs_at(ALONG_THE_ROAD), noise_px=0.5)
    signs, report = mapped(drive.journey)
    assert len(signs) == 0
    assert report.pruned["kept"] == 0
    assert sum(report.pruned.values()) == len(report.reason) == len(ALONG_THE_ROAD)


def test_a_false_run_before_a_creeping_car_is_no_sign():
    """Detections that slide through the image while the car hardly moves look like a tiny plate before the lens."""
    poses = straight_poses(20, step_m=0.08)
    drive = drive_past(
        poses, signs_at([(0.35, 2.4, 1.7)]), size=(0.15, 0.15), depth_m=(0.3, 10.0), noise_px=0.5
    )
    signs, report = mapped(drive.journey)
    assert len(signs) == 0
    assert report.pruned["implausible size"] == 1


def test_a_sticker_on_the_car_ahead_is_no_sign(generator):
    """A detection that stands still in the image while the car drives."""
    poses = straight_poses(60)
    drive = drive_past(poses[:1].expand(60, 4, 4), signs_at([(1.0, 15.0, 1.0)]), noise_px=0.5)
    signs, _ = mapped(replace(drive.journey, T_world_camera=poses))
    assert len(signs) == 0
