"""Tracklets to signs: exact where views are exact, robust where they are not, pruned with a reason, rejoined after gaps."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from worlds.drives import turn_about_up
from worlds.sign_drive import (
    ALL_SHAPES,
    F64,
    NOISE,
    SignDrive,
    by_truth,
    corner_errors,
    drive_past,
    mapped,
    mixed_street,
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
from crowdmap_torch.signs.pruning import KEPT, REASONS, REJOINED, SignTriangulationConfig
from crowdmap_torch.signs.triangulate import SignReport, triangulate_signs
from crowdmap_torch.tables import Dataset, Journey, Signs, SurveySigns, Tracklets
from crowdmap_torch.tracking.sign_features import SignAssociationConfig
from crowdmap_torch.tracking.signs import associate_signs

CONFIG = SignTriangulationConfig()


@pytest.fixture(scope="module")
def street() -> SignDrive:
    return mixed_street()


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
