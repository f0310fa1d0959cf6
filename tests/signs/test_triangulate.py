"""Tracklets to signs: exact where views are exact, robust where they are not, pruned with a reason, rejoined after gaps."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from worlds.drives import turn_about_up
from worlds.sign_drive import (
    F64,
    SignDrive,
    drive_past,
    moved_corners,
    signs_at,
    straight_poses,
    taken_for,
    with_rows,
)

from crowdmap_torch.clustering.assignment import gated_matching
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.signs.pruning import (
    FEW_FRAMES,
    KEPT,
    NO_PARALLAX,
    REASONS,
    REJOINED,
    SignTriangulationConfig,
)
from crowdmap_torch.signs.triangulate import SignReport, triangulate_signs
from crowdmap_torch.tables import Dataset, Journey, Signs, SurveySigns, Tracklets
from crowdmap_torch.tracking.sign_features import SignAssociationConfig
from crowdmap_torch.tracking.signs import associate_signs

NOISE = PositioningNoise()

CONFIG = SignTriangulationConfig()
ALL_SHAPES = list(range(len(polygon.SHAPES)))
ALONG_THE_ROAD = [(3.5 * (-1) ** i, 45.0 + 4.0 * i, 2.0 + 0.3 * i) for i in ALL_SHAPES]


def mapped(journey: Journey) -> tuple[Signs, SignReport]:
    return triangulate_signs(
        journey, associate_signs(journey, NOISE, SignAssociationConfig()), NOISE, CONFIG
    )


def by_truth(drive: SignDrive) -> Tracklets:
    """Tracklets as the truth has them; shifts from association."""
    found = associate_signs(drive.journey, NOISE, SignAssociationConfig())
    return Tracklets(drive.sign, len(drive.T_world_sign), found.shift)


def corner_errors(signs: Signs, drive: SignDrive) -> torch.Tensor:
    """Mean corner error of every true sign against the nearest mapped one [m]."""
    nearest = torch.cdist(drive.T_world_sign[:, :3, 3], signs.center_world).argmin(-1)
    difference = signs.corners_world[nearest] - drive.corners_world
    return difference.norm(dim=-1).mean(-1)


@pytest.fixture(scope="module")
def street() -> SignDrive:
    return drive_past(
        straight_poses(80), signs_at(ALONG_THE_ROAD, yaw_deg=8.0), shape=ALL_SHAPES, noise_px=0.5
    )


@pytest.fixture(scope="module")
def street_map(street) -> tuple[Signs, SignReport]:
    return mapped(street.journey)


@pytest.mark.parametrize("width", [12.0, 15.0])
def test_a_board_above_all_lanes_is_a_sign_of_its_own_size(width: float):
    poses = straight_poses(120)
    drive = drive_past(
        poses, signs_at([(0.0, 110.0, 7.5)]), size=(width, 3.5), noise_px=0.5, depth_m=(16.0, 110.0)
    )
    signs, report = mapped(drive.journey)
    assert report.pruned["kept"] == 1
    # What signs usually measure, less than a metre, draws it by less than what the pixels leave open.
    assert signs.size[0].tolist() == pytest.approx([width, 3.5], rel=0.01)


def test_poses_that_leap_and_leap_back_leave_nothing_but_open_signs(tiny: Dataset):
    """Positioning that is 500 km off for a while: the drift's normal equations have no inverse."""
    drive = tiny.journeys[0]
    T, n = drive.T_world_camera.clone(), drive.frame_count
    T[3 * n // 10 : 6 * n // 10, 0, 3] += 5e5
    signs, report = mapped(replace(drive, T_world_camera=T))
    assert report.pruned["position too uncertain"] > 0
    assert bool(signs.covariance.isfinite().all())
    assert bool((signs.covariance.diagonal(dim1=1, dim2=2) < CONFIG.max_sigma_m**2).all())


def test_every_shape_is_mapped(street, street_map):
    signs, report = street_map
    assert len(signs) == len(ALL_SHAPES)
    assert sorted(signs.shape.tolist()) == ALL_SHAPES
    # Along the line of sight the fit is 10 to 20 cm unsure: poses might drift, and half a pixel is a percent of a sign.
    assert float(corner_errors(signs, street).max()) < 0.4
    assert float(corner_errors(signs, street).median()) < 0.1
    assert report.pruned["kept"] == len(signs) == int((report.reason == KEPT).sum())
    assert set(report.pruned) == set(REASONS)


def test_the_table_says_where_it_comes_from(street, street_map):
    signs, _ = street_map
    nearest = torch.cdist(signs.center_world, street.T_world_sign[:, :3, 3]).argmin(-1)
    p = street.journey.T_world_camera[:, :3, 3]
    for i, sign in enumerate(nearest.tolist()):
        frames = street.journey.signs.frame[street.sign == sign]
        away = (p - signs.center_world[i]).norm(dim=-1)
        # The closest approach is seen, if not detected: the car goes on for a few metres after the last detection.
        assert frames.max() <= signs.frame[i] <= frames.max() + 12
        assert away[signs.frame[i]] <= away[frames].min()
        assert int(signs.first_seen_ns[i]) == int(street.journey.t_ns[frames.min()])
        assert int(signs.last_seen_ns[i]) == int(street.journey.t_ns[frames.max()])
        assert int(signs.type[i]) == sign % 3
        assert int(signs.n_observations[i]) <= len(frames)
    assert bool((signs.confidence > 0.9).all())
    assert bool((torch.linalg.eigvalsh(signs.covariance) > 0).all())
    assert bool((signs.n_journeys == 1).all()) and bool((signs.journey == -1).all())


def test_detections_with_their_shifts_are_the_signs_corners(street, street_map):
    signs, report = street_map
    detections = street.journey.signs
    assert report.tracklets.shift is not None
    row_of = torch.full((report.tracklets.count,), -1).index_put(
        (signs.tracklet,), torch.arange(len(signs))
    )
    row = row_of[report.tracklets.label]
    T = se3.inverse(street.journey.T_world_camera[detections.frame])
    in_camera = se3.transform(T[:, None], signs.corners_world[row])
    ordered = polygon.roll(
        detections.corners_ideal, report.tracklets.shift, polygon.corner_count(detections.shape)
    )
    error_px = (in_camera[..., :2] / in_camera[..., 2:] - ordered).norm(dim=-1) * 1000
    # Noise of half a pixel; a wrong order would be off by the side of a sign.
    assert float(error_px.max()) < 4.0


def test_the_map_moves_with_the_world(street, street_map):
    T = turn_about_up(1.0, (100.0, -50.0, 7.0))
    moved = replace(street.journey, T_world_camera=T @ street.journey.T_world_camera)
    signs, _ = mapped(moved)
    expected = se3.transform(T, street_map[0].center_world)
    # Both stop within the solver's tolerance, a hundredth of a standard deviation.
    assert float((signs.center_world - expected).norm(dim=-1).max()) < 5e-3


def test_row_order_does_not_matter(street, street_map, generator):
    order = torch.randperm(len(street.sign), generator=generator)
    signs, _ = mapped(with_rows(street, order).journey)
    distance = torch.cdist(street_map[0].center_world, signs.center_world)
    assert float(distance.amin(-1).max()) < 1e-3


def test_outliers_and_wrong_shapes_do_no_harm(street, street_map):
    drive, frame = street, street.journey.signs.frame
    for sign in ALL_SHAPES:
        rows = ((street.sign == sign) & (frame % 7 == sign)).nonzero()[:, 0].tolist()
        drive = moved_corners(drive, rows[0], (12.0, -9.0))
        drive = taken_for(drive, rows[1], (sign + 2) % len(ALL_SHAPES))
    # Given to the sign's tracklet on purpose: the fit must do without them.
    signs, _ = triangulate_signs(drive.journey, by_truth(drive), NOISE, CONFIG)
    assert signs.shape.tolist() == ALL_SHAPES
    assert float(corner_errors(signs, street).max()) < 0.4


def test_a_small_far_plane_is_turned_the_right_way():
    """Seen from 80 to 40 m only, a sign turned to either side looks nearly the same."""
    poses = straight_poses(50)
    for yaw in (-25.0, 25.0):
        drive = drive_past(poses, signs_at([(6.0, 80.0, 3.0)], yaw_deg=yaw), size=(1.2, 1.2))
        signs, _ = mapped(drive.journey)
        assert len(signs) == 1
        cosine = (signs.normal_world[0] * drive.T_world_sign[0, :3, 2]).sum().clamp(-1, 1)
        assert float(torch.rad2deg(cosine.acos())) < 10.0


def test_the_paper_fits_each_sign_by_itself(street):
    config = SignTriangulationConfig(method="paper2017")
    tracklets = by_truth(street)
    every, _ = triangulate_signs(street.journey, tracklets, NOISE, config)
    assert len(every) == len(ALL_SHAPES)
    # Noise of half a pixel and exact poses: a few centimetres along the line of sight.
    assert float(corner_errors(every, street).max()) < 0.15
    odd = (street.sign % 2 == 1).nonzero()[:, 0]
    few = with_rows(street, odd)
    alone, _ = triangulate_signs(few.journey, by_truth(few), NOISE, config)
    torch.testing.assert_close(alone.T_world_sign, every.T_world_sign[1::2], rtol=0, atol=1e-6)


def test_the_paper_does_not_rejoin_tracklets():
    drive = drive_past(straight_poses(80), signs_at([(3.5, 70.0, 2.2)]))
    frame = drive.journey.signs.frame
    drive = with_rows(drive, ((frame < 25) | (frame > 60)).nonzero()[:, 0])
    tracklets = associate_signs(drive.journey, NOISE, SignAssociationConfig(window_frames=15))
    config = SignTriangulationConfig(
        method="paper2017", max_sigma_m=5.0, min_parallax_alone_deg=0.7
    )
    signs, report = triangulate_signs(drive.journey, tracklets, NOISE, config)
    assert len(signs) == tracklets.count == 2
    assert not bool((report.reason == REJOINED).any())


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


def test_few_frames_are_pruned_and_counted(street):
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


def test_a_sign_much_noisier_than_the_others_is_pruned(street):
    """It would be a false one: what is usual follows the others."""
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


def out_and_back(frames: int = 90) -> torch.Tensor:
    """A drive to the north, a turn to the left on the spot of a lane's width, and back to the south."""
    out = straight_poses(frames)
    turn = torch.linspace(0, torch.pi, 24, dtype=F64)[1:-1]
    radius = 3.0
    p = out[-1, :3, 3] + radius * torch.stack(
        (turn.cos() - 1, turn.sin(), torch.zeros_like(turn)), dim=-1
    )
    zero = torch.zeros_like(turn)
    R = out[-1, :3, :3] @ se3.so3_exp(torch.stack((zero, -turn, zero), dim=-1))
    back = turn_about_up(torch.pi, (0.0, 0.0, 0.0)) @ out
    back[:, :3, 3] += out[-1, :3, 3] * 2 - back[0, :3, 3] - out[-1, :3, 3]
    back[:, 0, 3] -= 2 * radius
    return torch.cat((out, se3.make(R, p), back))


def test_a_u_turn_maps_each_sign_once():
    """Signs that face the way out, and signs that face the way back; while the car turns all of them sweep by."""
    poses = out_and_back()
    facing_south = signs_at([(4.0, 40.0, 2.2), (4.5, 62.0, 2.5)])
    facing_north = signs_at([(-10.0, 30.0, 2.2), (-10.5, 8.0, 2.4)], yaw_deg=180.0)
    signs = torch.cat((facing_south, facing_north))
    drive = drive_past(poses, signs, noise_px=0.4)
    frame = drive.journey.signs.frame
    towards = signs[drive.sign, :3, 3] - poses[frame, :3, 3]
    is_front = (towards * signs[drive.sign, :3, 2]).sum(-1) < -0.3 * towards.norm(dim=-1)
    drive = with_rows(drive, is_front.nonzero()[:, 0])
    found, _ = mapped(drive.journey)
    assert len(found) == 4
    assert float(corner_errors(found, drive).max()) < 0.4


def test_a_gap_in_the_frames_loses_no_sign():
    """Two seconds without frames, the car going on: a sign seen before and after is one."""
    poses = straight_poses(120)
    kept = torch.cat((torch.arange(38), torch.arange(58, 120)))
    drive = drive_past(poses[kept], signs_at([(3.5, 75.0, 2.2), (-4.0, 70.0, 2.0)]), noise_px=0.4)
    drive = replace(drive, journey=replace(drive.journey, t_ns=kept * 10**8))
    signs, _ = mapped(drive.journey)
    assert len(signs) == 2
    assert float(corner_errors(signs, drive).max()) < 0.4


def test_a_sticker_on_the_car_ahead_is_no_sign(generator):
    """A detection that stands still in the image while the car drives."""
    poses = straight_poses(60)
    drive = drive_past(poses[:1].expand(60, 4, 4), signs_at([(1.0, 15.0, 1.0)]), noise_px=0.5)
    signs, _ = mapped(replace(drive.journey, T_world_camera=poses))
    assert len(signs) == 0


def test_tracklets_of_one_sign_rejoin_after_a_gap():
    drive = drive_past(straight_poses(80), signs_at([(3.5, 70.0, 2.2), (-4.0, 66.0, 2.0)]))
    frame = drive.journey.signs.frame
    drive = with_rows(drive, ((frame < 25) | (frame > 60)).nonzero()[:, 0])
    tracklets = associate_signs(drive.journey, NOISE, SignAssociationConfig(window_frames=15))
    assert tracklets.count == 4
    signs, report = triangulate_signs(drive.journey, tracklets, NOISE, CONFIG)
    assert len(signs) == 2
    assert int((report.reason == REJOINED).sum()) == 2
    for sign in range(2):
        assert len(report.tracklets.label[drive.sign == sign].unique()) == 1
    assert float(corner_errors(signs, drive).max()) < 0.15


def test_signs_that_are_seen_at_once_are_never_joined():
    drive = drive_past(straight_poses(70), signs_at([(3.5, 60.0, 2.2), (3.5, 60.0, 2.85)]))
    signs, _ = mapped(drive.journey)
    assert len(signs) == 2


def test_a_sign_detected_twice_is_mapped_once():
    """The second detections of some frames make a tracklet of their own, which is given up."""
    drive = drive_past(straight_poses(70), signs_at([(3.5, 60.0, 2.2)]), noise_px=0.3)
    every = torch.arange(len(drive.sign))
    twice = with_rows(drive, torch.cat((every, every[drive.journey.signs.frame % 11 == 0])))
    second = torch.arange(len(twice.sign)) >= len(every)
    found = associate_signs(twice.journey, NOISE, SignAssociationConfig())
    tracklets = Tracklets(second.long(), 2, found.shift)
    signs, report = triangulate_signs(twice.journey, tracklets, NOISE, CONFIG)
    assert len(signs) == 1
    labels = torch.stack((report.tracklets.label, twice.journey.signs.frame), dim=-1)
    assert len(labels.unique(dim=0)) == len(labels)


def test_a_journey_without_signs_has_none():
    drive = drive_past(straight_poses(3), signs_at([(4.0, -30.0, 2.0)]))
    signs, report = mapped(drive.journey)
    assert len(signs) == 0 and len(report.reason) == 0
    assert signs.T_world_sign.shape == (0, 4, 4) and signs.T_world_sign.dtype == F64
    assert sum(report.pruned.values()) == 0


def test_detections_without_a_tracklet_are_left_alone(street):
    found = associate_signs(street.journey, NOISE, SignAssociationConfig())
    nobody = Tracklets(torch.full_like(found.label, -1), 0, found.shift)
    signs, report = triangulate_signs(street.journey, nobody, NOISE, CONFIG)
    assert len(signs) == 0 and bool((report.tracklets.label == -1).all())


@pytest.fixture(scope="module")
def real_drives(real_data) -> list[tuple[Journey, SurveySigns, torch.Tensor]]:
    """Four KITTI drives with boxes marked in real images, the survey, and which of its signs count."""
    folder = real_data("kitti-signs")
    eligible = json.loads((folder / "eligible.json").read_text())
    drives = []
    for name, wanted in eligible.items():
        (journey,) = load_dataset(folder / name).journeys
        survey = read_survey(folder / name / "survey")
        rows = torch.tensor([survey.sign_id.index(sign) for sign in wanted])
        drives.append((journey, survey.signs, rows))
    return drives


def real_errors(drives, push: list[torch.Tensor]) -> torch.Tensor:
    """Distances of mapped from surveyed signs, poses pushed about and the push at each closest approach taken off."""
    distances = []
    for (journey, survey, wanted), offset in zip(drives, push, strict=True):
        T = journey.T_world_camera.clone()
        T[:, :3, 3] += offset
        signs, _ = mapped(replace(journey, T_world_camera=T))
        distance = torch.cdist(survey.center_world, signs.center_world - offset[signs.frame])
        row, column = map(torch.from_numpy, gated_matching(distance.square().numpy(), 2.0**2))
        counts = torch.isin(row, wanted)
        distances.append(distance[row[counts], column[counts]])
    return torch.cat(distances)


def unmoved(drives) -> list[torch.Tensor]:
    return [torch.zeros(journey.frame_count, 3, dtype=F64) for journey, _, _ in drives]


def shaken(drives, seed: int, *, sigma: float = 0.2, length_m: float = 150.0) -> list[torch.Tensor]:
    """Ornstein-Uhlenbeck drift of positions over the way [m]."""
    generator = torch.Generator().manual_seed(seed)
    pushes = []
    for journey, _, _ in drives:
        p = journey.T_world_camera[:, :3, 3]
        keep = torch.exp(-(p[1:] - p[:-1]).norm(dim=-1) / length_m)[:, None]
        push = sigma * torch.randn(len(p), 3, dtype=F64, generator=generator)
        for i in range(1, len(p)):
            push[i] = keep[i - 1] * push[i - 1] + (1 - keep[i - 1] ** 2).sqrt() * push[i]
        pushes.append(push)
    return pushes


@pytest.mark.timeout(120)
def test_real_signs_are_where_lidar_found_them(real_drives):
    """At least 25 of 26, median 0.26 m, mean 0.42 m."""
    found = real_errors(real_drives, unmoved(real_drives))
    assert len(found) >= 25
    assert float(found.median()) <= 0.26
    assert float(found.mean()) <= 0.42


@pytest.mark.timeout(120)
def test_real_signs_stay_where_they_are_when_poses_drift(real_drives):
    found = real_errors(real_drives, shaken(real_drives, seed=0))
    assert len(found) >= 25
    assert float(found.median()) <= 1.1 * 0.26
    assert float(found.mean()) <= 1.1 * 0.42
