from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from worlds.drives import make_journey
from worlds.small_world import Builder

from crowdmap_torch.adjustment.detection_lanes import detection_lanes
from crowdmap_torch.adjustment.lane_matching import (
    LaneMatches,
    Shifts,
    follow,
    nearest_lanes,
    sample_parameters,
    supported_lanes,
)
from crowdmap_torch.adjustment.lenses import seen_points
from crowdmap_torch.adjustment.observations import LanePointObservations
from crowdmap_torch.crowd_lanes.table import LaneSupport
from crowdmap_torch.geometry import camera, se3, spline_basis
from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.tables import (
    Journey,
    LaneDetections,
    LanePoints,
    Lanes,
    Rig,
    RoadEstimate,
    Tracklets,
)

HEIGHT = 1.5
K = torch.tensor([[900.0, 0, 639.5], [0, 900, 399.5], [0, 0, 1]], dtype=torch.float64)
RIG = Rig(
    rig_id="rig",
    camera=Camera(
        "brown_conrady",
        1280,
        800,
        K,
        torch.tensor([-0.1, 0.02, 0.0, 0.0, 0.0], dtype=torch.float64),
    ),
    T_link_camera=torch.eye(4, dtype=torch.float64),
    road_normal_camera=torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64),
    camera_height=HEIGHT,
)


@pytest.fixture
def lanes() -> Lanes:
    """Two straight markers 3.5 m apart and one that bends away, along the x axis."""
    make = Builder()
    x = torch.linspace(0, 60, 9, dtype=torch.float64)
    bend = torch.stack((x, 7 + 0.004 * x.square(), 0 * x), dim=-1)
    return make.lanes([make.straight(0.0, end=60), make.straight(3.5, end=60), bend])


def camera_at(x: float, y: float = 1.75) -> Tensor:
    """A camera over the road that looks east."""
    R = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]], dtype=torch.float64)
    return se3.make(R, torch.tensor([x, y, HEIGHT], dtype=torch.float64))


# Nearest lanes.


def test_the_nearest_lane_is_found_within_the_gate(lanes: Lanes):
    points = [[10.0, 0.3, 0], [10, 3.1, 0.2], [40, 13.6, 0], [10, 1.75, 0], [10, -5, 0], [90, 0, 0]]
    lane, t = nearest_lanes(torch.tensor(points, dtype=torch.float64), lanes, gate=0.9)
    assert lane.tolist() == [0, 1, 2, -1, -1, -1]
    at = spline_basis.evaluate_flat(lanes.control.point_world, lanes.control_count, t[:3], lane[:3])
    # Samples are half a metre apart.
    assert ((at[:, 0] - torch.tensor([10.0, 10, 40])).abs() < 0.3).all()


def test_a_bridge_is_another_place_but_a_wrong_height_is_not(lanes: Lanes):
    points = torch.tensor([[10.0, 0, 1.0], [10, 0, 5.0]], dtype=torch.float64)
    assert nearest_lanes(points, lanes, gate=0.9)[0].tolist() == [0, -1]


def test_nothing_is_near_where_there_are_no_lanes_or_no_points(lanes: Lanes):
    point = torch.zeros(3, 3, dtype=torch.float64)
    assert nearest_lanes(point, Builder().lanes([]), gate=0.9)[0].tolist() == [-1, -1, -1]
    assert len(nearest_lanes(point[:0], lanes, gate=0.9)[0]) == 0


def test_lanes_that_are_asked_for_are_taken_though_others_are_nearer(lanes: Lanes):
    points = torch.tensor([[10.0, 1.6, 0], [10, 1.6, 0], [10, 1.6, 0], [10, 1.6, 0]]).double()
    asked = torch.tensor([1, 0, 2, -1])
    lane, t = nearest_lanes(points, lanes, gate=2.0, of=asked)
    assert lane.tolist() == [1, 0, -1, -1]
    at = spline_basis.evaluate_flat(
        lanes.control.point_world, lanes.control_count, t[:2], asked[:2]
    )
    assert ((at[:, 0] - 10).abs() < 0.3).all()


def test_a_point_keeps_the_lane_of_its_own_tracklet() -> None:
    """Two markers 20 cm apart, seen by two journeys: nearer to the other one is not of the other one."""
    x = torch.arange(0, 20, 2).double()
    line = torch.stack((x, torch.zeros_like(x), torch.zeros_like(x)), dim=-1)
    left = line + torch.tensor([0.0, 0.2, 0.0])
    support = LaneSupport(
        point_world=torch.cat((line, left, left)),
        journey=torch.tensor([0, 0, 1]).repeat_interleave(len(x)),
        tracklet=torch.tensor([0, 1, 0]).repeat_interleave(len(x)),
        lane=torch.tensor([4, 7, 7]).repeat_interleave(len(x)),
    )
    tracklets = [Tracklets(torch.tensor([1, 0, -1]), 2), Tracklets(torch.tensor([0]), 1)]
    px = torch.full((5, 2), 600.0).double()
    points = replace(
        observe(px), journey=torch.tensor([0, 0, 0, 1, 1]), detection=torch.tensor([0, 1, 2, 0, 0])
    )
    ground = torch.tensor([[5.0, 0.02, 0], [5, 0.18, 0], [5, 0, 0], [5, 0, 0], [30, 0.2, 0]])
    found = supported_lanes(ground.double(), points, tracklets, support, reach=3.0)
    assert found.tolist() == [7, 4, -1, 7, -1]
    nothing = support[torch.zeros(0, dtype=torch.int64)]
    assert (
        supported_lanes(ground.double(), points, tracklets, nothing, reach=3.0).tolist() == [-1] * 5
    )


def test_samples_reach_from_end_to_end_without_gaps(lanes: Lanes):
    piece, t = sample_parameters(lanes, spacing=0.5)
    at = spline_basis.evaluate_flat(lanes.control.point_world, lanes.control_count, t, piece)
    for k in range(3):
        mine = at[piece == k]
        control = lanes.control.point_world[lanes.piece_of_control == k]
        assert torch.allclose(mine[[0, -1]], control[[0, -1]])
        # Half a metre along the chords, a little more along the curve.
        assert mine.diff(dim=0).norm(dim=1).max() < 0.55


# The closest point of the projected spline.


def pixels_beside(lanes: Lanes, T: Tensor, aside: Tensor, x: Tensor, lane: int) -> Tensor:
    """Raw pixels of points `aside` metres to the left of a lane, at these x."""
    fine = torch.linspace(0, 1, 20001, dtype=torch.float64)
    t = fine * (int(lanes.control_count[lane]) - 1)
    at = spline_basis.evaluate_flat(
        lanes.control.point_world, lanes.control_count, t, torch.full((len(t),), lane)
    )
    nearest = torch.searchsorted(at[:, 0].contiguous(), x)
    point = at[nearest] + torch.stack((0 * aside, aside, 0 * aside), dim=-1)
    px, visible = camera.project(RIG.camera, se3.transform(se3.inverse(T), point))
    assert visible.all()
    return px


def observe(px: Tensor) -> LanePointObservations:
    ideal, closes = camera.unproject(RIG.camera, px)
    assert closes.all()
    zero = torch.zeros(len(px), dtype=torch.int64)
    down = RIG.road_normal_camera.expand(len(px), 3)
    one = torch.ones(len(px), dtype=torch.float64)
    return LanePointObservations(
        **seen_points(RIG.camera, 0, px, ideal),
        frame=zero,
        journey=zero,
        detection=zero,
        normal_camera=down,
        camera_height=one * HEIGHT,
        height_sigma=one * 0.05,
    )


def projected_errors(rows: LanePointObservations, T: Tensor, point: Tensor) -> Tensor:
    """Pixel errors of world points [m, s, 3] held against each observation."""
    y = (rows.matrix[:, None] @ se3.transform(se3.inverse(T), point)[..., None])[..., 0]
    return y[..., :2] / y[..., 2:]


@pytest.mark.parametrize("lane", [0, 1, 2])
def test_follow_ends_at_the_closest_point_of_the_projected_spline(lanes: Lanes, lane: int):
    T = camera_at(5.0)
    x = torch.linspace(16, 40, 15, dtype=torch.float64)
    aside = 0.25 * torch.sin(3 * x)
    rows = observe(pixels_beside(lanes, T, aside, x, lane))
    count = lanes.control_count
    last = int(count[lane]) - 1
    # From half a knot beside, several metres along the marker.
    start = LaneMatches(
        lane=torch.full((15,), lane),
        t=(x / 60 * last + 0.5 * torch.cos(x)).clamp(0, last),
        normal_px=torch.zeros(15, 2, dtype=torch.float64),
        valid=torch.zeros(15, dtype=torch.bool),
    )
    coefficient = spline_basis.to_coefficients_flat(lanes.control.point_world, count)
    found = follow(start, rows, T.expand(15, 4, 4), coefficient, count)
    assert found.valid.all() and torch.equal(found.lane, start.lane)

    fine = torch.linspace(0, last, 24001, dtype=torch.float64)
    at = spline_basis.evaluate_flat(
        lanes.control.point_world, count, fine, torch.full((len(fine),), lane)
    )
    ahead = se3.transform(se3.inverse(T), at)[:, 2] > 1
    error = projected_errors(rows, T, at[ahead].expand(15, -1, 3))
    brute, index = error.norm(dim=-1).min(dim=1)
    own = spline_basis.evaluate_flat(lanes.control.point_world, count, found.t, found.lane)
    distance = projected_errors(rows, T, own[:, None])[:, 0]
    # Gauss-Newton ends within a hundredth of a pixel; the samples are about that far apart.
    assert (distance.norm(dim=-1) - brute).abs().max() < 0.01
    assert (found.t - fine[ahead][index]).abs().max() < 0.01
    # What is left lies along the normal.
    across = (distance * found.normal_px).sum(-1).abs()
    assert torch.allclose(across, distance.norm(dim=-1), atol=0.01)
    assert torch.allclose(found.normal_px.norm(dim=-1), torch.ones(15, dtype=torch.float64))


def test_follow_stays_where_the_match_is_right_already(lanes: Lanes):
    T = camera_at(5.0)
    x = torch.linspace(16, 40, 10, dtype=torch.float64)
    rows = observe(pixels_beside(lanes, T, 0.1 + 0 * x, x, 2))
    count = lanes.control_count
    coefficient = spline_basis.to_coefficients_flat(lanes.control.point_world, count)
    nothing = torch.zeros(10, 2, dtype=torch.float64)
    start = LaneMatches(torch.full((10,), 2), x / 60 * 8, nothing, nothing[:, 0] > 0)
    once = follow(start, rows, T.expand(10, 4, 4), coefficient, count)
    twice = follow(once, rows, T.expand(10, 4, 4), coefficient, count)
    assert (twice.t - once.t).abs().max() < 1e-3


def test_follow_looks_for_what_the_true_camera_sees(lanes: Lanes):
    T = camera_at(5.0)
    x = torch.linspace(16, 40, 10, dtype=torch.float64)
    px = pixels_beside(lanes, T, 0.2 * torch.sin(x), x, 2)
    count = lanes.control_count
    coefficient = spline_basis.to_coefficients_flat(lanes.control.point_world, count)
    nothing = torch.zeros(10, 2, dtype=torch.float64)
    start = LaneMatches(torch.full((10,), 2), x / 60 * 8, nothing, nothing[:, 0] > 0)
    shift_px = torch.stack((3 * torch.cos(x), 5 * torch.sin(2 * x)), dim=-1)
    shift = 0.3 * torch.stack((torch.cos(x), torch.sin(x), torch.cos(3 * x)), dim=-1)

    # Seen beside where it should be, a point is where it would have been seen there.
    rows, where = observe(px), (T.expand(10, 4, 4), coefficient, count)
    found = follow(start, rows, *where, shifts=Shifts(torch.zeros_like(shift), shift_px))
    expected = follow(start, observe(px - shift_px), *where)
    # The lens there is a little different.
    assert (found.t - expected.t).abs().max() < 2e-4
    assert (found.t - follow(start, rows, *where).t).abs().max() > 0.1

    # The spline to one side of the camera, or the camera to the other.
    found = follow(start, rows, *where, shifts=Shifts(shift, nothing))
    moved = T.expand(10, 4, 4).clone()
    moved[:, :3, 3] -= shift
    expected = follow(start, rows, moved, coefficient, count)
    torch.testing.assert_close(found.t, expected.t)
    torch.testing.assert_close(found.normal_px, expected.normal_px)


def test_points_beyond_the_end_or_behind_the_camera_are_not_valid(lanes: Lanes):
    make = Builder()
    short = make.lanes([make.straight(0.0, start=15, end=25, points=3)])
    T = camera_at(5.0)
    x = torch.tensor([10.0, 20.0, 35.0], dtype=torch.float64)
    rows = observe(pixels_beside(lanes, T, 0 * x, x, 0))
    count = short.control_count
    coefficient = spline_basis.to_coefficients_flat(short.control.point_world, count)
    nothing = torch.zeros(3, 2, dtype=torch.float64)
    start = LaneMatches(torch.zeros(3, dtype=torch.int64), nothing[:, 0] + 1, nothing, x > 0)
    found = follow(start, rows, T.expand(3, 4, 4), coefficient, count)
    assert found.valid.tolist() == [False, True, False]
    behind = follow(start, rows, camera_at(60.0).expand(3, 4, 4), coefficient, count)
    assert (
        not behind.valid.any() and behind.t.isfinite().all() and behind.normal_px.isfinite().all()
    )


def test_a_match_at_the_end_of_a_spline_does_not_come_and_go(lanes: Lanes):
    make = Builder()
    T = camera_at(5.0)
    x = torch.tensor([20.0], dtype=torch.float64)
    rows = observe(pixels_beside(lanes, T, 0 * x, x, 0))
    nothing = torch.zeros(1, 2, dtype=torch.float64)
    valid = torch.ones(1, dtype=torch.bool)
    # A step moves the end a few centimetres to and fro across the point; then it moves away, and back.
    seen = []
    for end in (20.03, 19.97, 20.03, 19.97, 19.0, 19.97, 20.03, 21.0):
        lane = make.lanes([make.straight(0.0, start=0, end=end, points=3)])
        coefficient = spline_basis.to_coefficients_flat(
            lane.control.point_world, lane.control_count
        )
        start = LaneMatches(torch.zeros(1, dtype=torch.int64), nothing[:, 0] + 1, nothing, valid)
        valid = follow(start, rows, T[None], coefficient, lane.control_count).valid
        seen.append(bool(valid))
    assert seen == [True, True, True, True, False, False, False, True]


# Lanes of detections.


def detections_of(points_world: list[list[list[float]]], T: Tensor) -> Journey:
    """One frame whose lane detections show these world points."""
    detection = np.repeat(np.arange(len(points_world)), [len(p) for p in points_world])
    point = torch.tensor([q for p in points_world for q in p], dtype=torch.float64).reshape(-1, 3)
    point_camera = se3.transform(se3.inverse(T), point)
    px, _ = camera.project(RIG.camera, point_camera)
    n = torch.arange(len(points_world))
    return make_journey(
        RIG,
        T[None],
        lanes=LaneDetections(n, torch.zeros_like(n), torch.full_like(n, -1), n.double()),
        lane_points=LanePoints(
            torch.as_tensor(detection), px, point_camera[:, :2] / point_camera[:, 2:]
        ),
    )


def flat_road() -> RoadEstimate:
    one = torch.ones(1, dtype=torch.float64)
    return RoadEstimate(RIG.road_normal_camera[None], HEIGHT * one, 1e-3 * one)


def labels(journey: Journey, lanes: Lanes) -> list[int]:
    return detection_lanes(journey, flat_road(), journey.T_world_camera, lanes, gate=0.9).tolist()


def test_a_detection_is_of_the_lane_that_most_of_its_near_points_lie_on(lanes: Lanes):
    T = camera_at(0.0)
    detections = [
        [[8.0, 0.1, 0], [9, 0.1, 0], [10, -0.1, 0], [11, 3.4, 0]],
        # Only the four nearest vote: what begins on the second marker is of the second.
        [
            [25.0, 0, 0],
            [24, 0, 0],
            [23, 0, 0],
            [22, 0, 0],
            [21, 0, 0],
            *([x, 3.5, 0] for x in (6, 7, 8, 9)),
        ],
        [[8.0, 1.75, 0], [9, 1.75, 0]],
        [[50.0, 0, 0], [55, 0, 0]],
        [[8.0, 1.75, 0], [9, 3.6, 0]],
    ]
    # Between two markers; too far ahead; one point on a marker, one on none.
    assert labels(detections_of(detections, T), lanes) == [0, 1, -1, -1, 1]


def test_lanes_of_detections_do_not_depend_on_the_order_of_points(lanes: Lanes, generator):
    T = camera_at(0.0)
    lines = [
        [[x, y + 0.5 * (x > 14), 0] for x in np.linspace(6, 20, 9).tolist()]
        for y in (0.0, 3.0, 6.9)
    ]
    journey = detections_of(lines, T)
    points = journey.lane_points
    within = torch.cat([9 * k + torch.randperm(9, generator=generator) for k in range(3)])
    other = replace(journey, lane_points=points[within])
    assert labels(other, lanes) == labels(journey, lanes) == [0, 1, 2]


def test_without_lanes_or_detections_nothing_is_labelled(lanes: Lanes):
    T = camera_at(0.0)
    assert labels(detections_of([[[8.0, 0, 0], [9, 0, 0]]], T), Builder().lanes([])) == [-1]
    assert labels(detections_of([], T), lanes) == []


def test_a_match_slides_to_the_next_control_points_and_no_further(lanes: Lanes):
    T = camera_at(5.0)
    x = torch.linspace(20, 40, 15, dtype=torch.float64)
    rows = observe(pixels_beside(lanes, T, 0 * x, x, 0))
    count = lanes.control_count
    coefficient = spline_basis.to_coefficients_flat(lanes.control.point_world, count)
    nothing, last = torch.zeros(15, 2, dtype=torch.float64), int(count[0]) - 1
    right = x / 60 * last
    near = LaneMatches(torch.zeros(15, dtype=torch.int64), right, nothing, x > 0)
    free = follow(near, rows, T.expand(15, 4, 4), coefficient, count)
    for ahead in (-1.9, -0.4, 0.4, 1.9):
        begun = (right + ahead).clamp(0, last)
        found = follow(
            replace(near, t=begun), rows, T.expand(15, 4, 4), coefficient, count, begun=begun
        )
        assert ((found.t.floor() - begun.floor()).abs() <= 1).all()
        held = (free.t.floor() - begun.floor()).abs() > 1
        assert bool(held.any()) == (abs(ahead) > 1)
        assert torch.allclose(found.t[~held], free.t[~held], atol=1e-3)
        # What is held is as near to where it should be as it may be, and counts.
        assert ((found.t - free.t).abs()[held] < (begun - free.t).abs()[held]).all()
        assert found.valid.all()
