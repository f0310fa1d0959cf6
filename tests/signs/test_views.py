"""Views of signs: which detections count, which are kept, and where a sign was nearest."""

from __future__ import annotations

from dataclasses import replace

import torch
from worlds.drives import make_journey
from worlds.sign_drive import CAMERA, F64, RIG, drive_past, signs_at, straight_poses

from crowdmap_torch.geometry import camera, polygon, se3
from crowdmap_torch.noise.positioning import DriftPathConfig, PositioningNoise
from crowdmap_torch.road.nonholonomic import DrivePath, NonholonomicConfig, drive_path
from crowdmap_torch.signs.triangulate import shape_by_vote, usable_rows, views_of
from crowdmap_torch.signs.views import (
    UNKNOWN_M,
    SignStart,
    SignViews,
    closest_approach,
    distance_away,
    held_covariance,
    thinned,
)
from crowdmap_torch.tables import Tracklets


def test_a_covariance_that_is_not_known_is_a_large_one():
    known = torch.eye(3, dtype=F64)
    found = held_covariance(torch.stack((known, known * torch.nan, known * torch.inf)))
    assert found.diagonal(dim1=1, dim2=2).tolist() == [[1.0] * 3, [1e6] * 3, [1e6] * 3]
    assert bool((found[1:] == UNKNOWN_M**2 * known).all())


def path_of(poses: torch.Tensor) -> DrivePath:
    journey = make_journey(RIG, poses)
    return drive_path(journey, PositioningNoise(), NonholonomicConfig(), DriftPathConfig())


def one_view(poses: torch.Tensor, frame: int) -> SignViews:
    """A view of a sign from a frame, wherever its corners are."""
    corners = torch.zeros(1, polygon.MAX_CORNERS, 2, dtype=F64)
    at = torch.tensor([frame])
    observation = torch.zeros(1, polygon.MAX_CORNERS, 3, 3, dtype=F64)
    return SignViews(torch.zeros_like(at), at, corners, corners, observation, poses[at])


def test_the_closest_approach_is_the_last_frame_that_has_the_sign_in_its_image():
    poses = straight_poses(100)
    sign = SignStart(signs_at([[3.5, 60.0, 2.5]]), torch.ones(1, 2, dtype=F64))
    in_camera = se3.transform(se3.inverse(poses), sign.T_world_sign[:, :3, 3])
    _, visible = camera.project(CAMERA, in_camera)
    last = int(visible.nonzero().max())
    view = one_view(poses, last - 12)
    assert closest_approach(view, sign, path_of(poses)).tolist() == [last]
    # The car stops on its way there: the drive's last frame is as near as it came.
    assert closest_approach(view, sign, path_of(poses[: last - 5])).tolist() == [last - 6]


def test_views_have_their_corners_in_the_order_of_the_shift():
    drive = drive_past(straight_poses(40), signs_at([(3.5, 40.0, 2.5)]))
    detections = drive.journey.signs
    shift = torch.arange(len(detections)) % 4
    tracklets = Tracklets(drive.sign, 1, shift)
    rows = torch.arange(len(detections)).flip(0)
    views = views_of(drive.journey, tracklets, rows, drive.sign[rows])
    assert torch.equal(views.frame, detections.frame[rows])
    for view, row in enumerate(rows.tolist()):
        rolled = detections.corners_px[row, :4].roll(-int(shift[row]), 0)
        assert torch.equal(views.corners_px[view, :4], rolled)
    away = distance_away(views, SignStart(drive.T_world_sign, drive.size))
    assert torch.allclose(away, (views.p_world_camera - drive.T_world_sign[0, :3, 3]).norm(dim=-1))


def test_detections_of_another_shape_than_their_tracklets_do_not_count():
    drive = drive_past(straight_poses(40), signs_at([(3.5, 40.0, 2.5)]))
    shape = drive.journey.signs.shape.clone()
    shape[2] = (shape[2] + 1) % len(polygon.SHAPES)
    journey = replace(drive.journey, signs=replace(drive.journey.signs, shape=shape))
    label = drive.sign.clone()
    label[4] = -1
    tracklets = Tracklets(label, 1, torch.zeros_like(label))
    vote = shape_by_vote(journey, tracklets)
    assert vote.tolist() == [int(shape[0])]
    expected = [row for row in range(len(shape)) if row not in (2, 4)]
    assert usable_rows(journey, tracklets, vote).tolist() == expected


def test_thinned_views_are_spread_over_each_sign_and_hold_the_last(generator):
    sign = torch.arange(3).repeat_interleave(torch.tensor([40, 3, 16]))
    frame = torch.cat([torch.arange(n) for n in (40, 3, 16)])
    order = torch.randperm(len(sign), generator=generator)
    zeros = torch.zeros(len(sign), polygon.MAX_CORNERS, 2, dtype=F64)
    T = torch.eye(4, dtype=F64).expand(len(sign), 4, 4)
    views = SignViews(
        sign[order], frame[order], zeros, zeros, torch.zeros(len(sign), 8, 3, 3, dtype=F64), T
    )
    kept = thinned(views, 16)
    for number, (count, last) in enumerate([(16, 39), (3, 2), (16, 15)]):
        frames = views.frame[kept & (views.sign == number)].sort().values
        assert len(frames) == count and int(frames[-1]) == last
    assert int(views.frame[kept & (views.sign == 0)].sort().values.diff().max()) <= 3
