from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.func import vmap
from worlds.drives import make_journey
from worlds.small_world import Builder

from crowdmap_torch.adjustment.observations import (
    corner_observations,
    frame_offsets,
    lane_point_observations,
    spaced_frames,
)
from crowdmap_torch.geometry import camera, polygon, se3
from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.geometry.polygon import SHAPES
from crowdmap_torch.geometry.trajectory import station
from crowdmap_torch.residuals.reprojection import pixel_error, sign_reprojection
from crowdmap_torch.tables import (
    Association,
    Journey,
    LaneDetections,
    LanePoints,
    Rig,
    RoadEstimate,
    SignDetections,
    Signs,
)

EAST = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
"""A camera that looks east."""
LENS = [-0.2, 0.05, 0.001, -0.001, 0.0]


def make_rig(distortion: list[float] | None = None) -> Rig:
    K = torch.tensor([[900.0, 0, 639.5], [0, 900, 399.5], [0, 0, 1]], dtype=torch.float64)
    lens = torch.tensor(distortion or [], dtype=torch.float64)
    return Rig(
        rig_id="rig",
        camera=Camera("brown_conrady", 1280, 800, K, lens),
        T_link_camera=torch.eye(4, dtype=torch.float64),
        road_normal_camera=torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64),
        camera_height=1.5,
    )


def driving_east(x: Tensor) -> Tensor:
    """Camera poses at these places along the x axis, 1.5 m up."""
    zero = torch.zeros_like(x)
    position = torch.stack((x, zero, zero + 1.5), dim=-1)
    return se3.make(EAST.expand(len(x), 3, 3), position)


def metres(count: int, step: float) -> Tensor:
    return torch.arange(count, dtype=torch.float64) * step


# Distance travelled.


@pytest.mark.parametrize("count", [1, 2, 5, 60])
def test_station_of_even_travel_is_exact(count: int):
    x = metres(count, 0.8)
    assert torch.allclose(station(driving_east(x)), x)


def test_station_of_a_standing_car_hardly_grows(generator):
    # 20 s at 15 Hz with 1.5 cm of white noise: added up as it stands it would be more than 7 m.
    T = driving_east(torch.zeros(300, dtype=torch.float64))
    T[:, :3, 3] += 0.015 * torch.randn(300, 3, generator=generator, dtype=torch.float64)
    way = station(T)
    assert T[:, :3, 3].diff(dim=0).norm(dim=1).sum() > 7
    assert way[-1] < 1.0
    assert (way.diff() >= 0).all() and way[0] == 0


def test_spaced_frames_are_used_ones_and_one_per_stretch():
    x = torch.cat((metres(40, 0.1), torch.full((50,), 3.9), 3.9 + metres(20, 1.0)))
    used = torch.ones(len(x), dtype=torch.bool)
    used[::3] = False
    journey = make_journey(make_rig(), driving_east(x.double()))
    kept = spaced_frames(journey, used, 0.5)
    way = station(journey.T_world_camera)
    assert not (kept & ~used).any()
    assert torch.equal((way[kept] / 0.5).floor(), (way[used] / 0.5).floor().unique())
    # At the light a handful of pictures is left of fifty, on the open road every used one.
    assert kept[45:85].sum() <= 6
    assert torch.equal(kept[-10:], used[-10:])


def test_spaced_frames_of_nothing_are_none():
    journey = make_journey(make_rig(), driving_east(metres(5, 1.0)))
    assert not spaced_frames(journey, torch.zeros(5, dtype=torch.bool), 0.5).any()


def test_frame_offsets_count_the_frames_before():
    journeys = [make_journey(make_rig(), driving_east(metres(n, 1.0))) for n in (3, 1, 4)]
    assert frame_offsets(journeys) == [0, 3, 4, 8]


# Sign corners.


@pytest.fixture
def signs() -> Signs:
    """One sign of each shape, side by side, turned a little from the west: from straight ahead outlines would be boxes."""
    n = len(polygon.SHAPES)
    center = torch.stack((torch.full((n,), 30.0), 2.0 * torch.arange(n) - 5, torch.full((n,), 2.5)))
    facing = Builder().signs(center.T.double(), shape=torch.arange(n))
    turned = torch.tensor([0, 0, 0, 0, 0.2, 0], dtype=torch.float64)
    return replace(facing, T_world_sign=facing.T_world_sign @ se3.exp(turned))


def seen(signs: Signs, rig: Rig, x: Tensor, shift: Tensor) -> tuple[Journey, Association]:
    """A drive that sees every sign in every frame; corner k of a sign is corner `k + shift` of its detection."""
    n, T = len(signs), driving_east(x)
    frame = torch.arange(len(x)).repeat_interleave(n)
    row = torch.arange(n).repeat(len(x))
    corners_camera = se3.transform(se3.inverse(T[frame])[:, None], signs.corners_world[row])
    px, visible = camera.project(rig.camera, corners_camera)
    assert visible.all()
    shape = signs.shape[row]
    slot = torch.arange(polygon.MAX_CORNERS)
    count = polygon.corner_count(shape)[:, None]
    # Past the last corner it is repeated, as io does.
    of_detection = (slot.minimum(count - 1) - shift[row][:, None]) % count
    px = px.gather(1, of_detection[..., None].expand(-1, -1, 2))
    ideal, closes = camera.unproject(rig.camera, px)
    assert closes.all()
    unknown = torch.full((len(row),), -1)
    detections = SignDetections(
        row=torch.arange(len(row)),
        frame=frame,
        shape=shape,
        corners_px=px,
        corners_ideal=ideal,
        type=unknown,
        score=torch.ones(len(row), dtype=torch.float64),
        track=unknown,
    )
    association = Association(sign=row, sign_shift=shift[row], lane=unknown[:0])
    return make_journey(rig, T, signs=detections), association


def corner_residuals(signs: Signs, journeys, associations) -> tuple[Tensor, Tensor]:
    """Pixel errors of all corner rows, and the sign of each."""
    rows = corner_observations(journeys, associations, signs, box_sigma=0.5)
    T = torch.cat([j.T_world_camera for j in journeys])[rows.frame]
    of_sign = signs[rows.sign]
    error = vmap(sign_reprojection)(
        T, of_sign.T_world_sign, of_sign.size, rows.template, rows.matrix
    )
    return error, rows.sign


@pytest.mark.parametrize("distortion", [None, LENS], ids=["pinhole", "distorted"])
def test_corners_at_the_truth_have_no_residual_wherever_detections_start(signs: Signs, distortion):
    rig = make_rig(distortion)
    shift = torch.tensor([1, 2, 3, 0, 4, 7])
    journeys, associations = zip(
        seen(signs, rig, metres(3, 2.0), shift),
        seen(signs, rig, metres(2, 4.0), shift),
        strict=True,
    )
    error, row = corner_residuals(signs, journeys, associations)
    # Undistortion closes to well below a thousandth of a pixel.
    assert error.abs().max() < 1e-3
    assert torch.equal(torch.bincount(row), 5 * polygon.CORNER_COUNT)


def test_a_wrong_shift_shows(signs: Signs):
    journey, association = seen(signs, make_rig(), metres(1, 1.0), torch.zeros(6).long())
    turned = replace(association, sign_shift=association.sign_shift + 1)
    error, _ = corner_residuals(signs, [journey], [turned])
    assert (error.norm(dim=-1) > 5).all()


def test_detections_of_another_shape_or_of_no_sign_are_left_out(signs: Signs):
    journey, association = seen(signs, make_rig(), metres(1, 1.0), torch.zeros(6).long())
    shape = journey.signs.shape.clone()
    shape[2] = 3
    sign = association.sign.clone()
    sign[4] = -1
    journey = replace(journey, signs=replace(journey.signs, shape=shape))
    rows = corner_observations([journey], [replace(association, sign=sign)], signs, box_sigma=0.5)
    assert rows.sign.unique().tolist() == [0, 1, 3, 5]


def test_frames_are_counted_over_all_journeys(signs: Signs):
    one = seen(signs, make_rig(), metres(2, 1.0), torch.zeros(6).long())
    rows = corner_observations([one[0], one[0]], [one[1], one[1]], signs, box_sigma=0.5)
    assert rows.frame.unique().tolist() == [0, 1, 2, 3]


def test_corners_of_a_detection_are_adjacent_and_numbered_over_all_journeys(signs: Signs):
    one = seen(signs, make_rig(), metres(2, 1.0), torch.zeros(6).long())
    rows = corner_observations([one[0], one[0]], [one[1], one[1]], signs, box_sigma=0.5)
    label, count = torch.unique_consecutive(rows.detection, return_counts=True)
    assert len(label) == len(label.unique())
    begins = torch.cat((torch.zeros(1).long(), count.cumsum(0)[:-1]))
    for column in (rows.frame, rows.sign):
        assert torch.equal(column[begins].repeat_interleave(count), column)
    assert torch.equal(count, polygon.CORNER_COUNT[signs.shape[rows.sign[begins]]])


def test_journeys_without_signs_give_no_rows(signs: Signs):
    journey = make_journey(make_rig(), driving_east(metres(3, 1.0)))
    none = torch.zeros(0, dtype=torch.int64)
    assert (
        len(corner_observations([journey], [Association(none, none, none)], signs, box_sigma=0.5))
        == 0
    )


@pytest.mark.parametrize("distortion", [None, LENS], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("shape", SHAPES)
def test_of_boxes_the_centre_counts_and_the_corners_hardly(signs: Signs, shape: str, distortion):
    rig = make_rig(distortion)
    journey, association = seen(signs, rig, metres(1, 1.0), torch.zeros(6).long())
    k = signs.shape.tolist().index(SHAPES.index(shape))
    c = int(polygon.CORNER_COUNT[SHAPES.index(shape)])
    px = journey.signs.corners_px.clone()
    low, high = px[k].amin(0), px[k].amax(0)
    px[k] = polygon.in_box(low, high, signs.shape[k])
    ideal, _ = camera.unproject(rig.camera, px)
    boxed = replace(journey.signs, corners_px=px, corners_ideal=ideal)
    rows = corner_observations([replace(journey, signs=boxed)], [association], signs, box_sigma=0.5)
    mine = rows[rows.sign == k]
    assert len(mine) == c + 1
    torch.testing.assert_close(mine.loose_px[:c], (high - low).max() / 4 * torch.ones(c).double())
    assert mine.loose_px[c] == 0
    # Taken for outlines they are corners like any other.
    alike = corner_observations(
        [replace(journey, signs=boxed)], [association], signs, box_sigma=0.0
    )
    assert len(alike[alike.sign == k]) == c and not alike.loose_px.any()
    torch.testing.assert_close(mine.template[c], torch.zeros(2).double(), rtol=0, atol=1e-12)
    # On the ray between those of the box's corners the error is zero.
    ray = torch.cat((ideal[k, :c].mean(0), torch.ones(1).double()))
    error = pixel_error(7 * ray, mine.matrix[c])
    torch.testing.assert_close(error, torch.zeros(2).double(), rtol=0, atol=1e-9)
    others = rows[rows.sign != k]
    assert (others.loose_px == 0).all()


# Lane points.


def lane_drive(x: Tensor, counts: list[int]) -> Journey:
    """A drive that sees in every frame detections of so many points, on a marker 1.8 m to the left."""
    T = driving_east(x)
    per_frame = torch.tensor(counts)
    detections = len(x) * len(counts)
    of_point = torch.repeat_interleave(torch.arange(detections), per_frame.repeat(len(x)))
    ahead = torch.cat([torch.linspace(6, 20, c, dtype=torch.float64) for c in counts])
    point = torch.stack((0 * ahead - 1.8, 0 * ahead + 1.5, ahead), dim=-1).repeat(len(x), 1)
    rig = make_rig()
    px, _ = camera.project(rig.camera, point)
    frame = torch.arange(len(x)).repeat_interleave(len(counts))
    none = torch.full_like(frame, -1)
    return make_journey(
        rig,
        T,
        lanes=LaneDetections(torch.arange(detections), frame, none, none.double()),
        lane_points=LanePoints(of_point, px, point[:, :2] / point[:, 2:]),
    )


def flat_road(frames: int) -> RoadEstimate:
    normal = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    height = torch.full((frames,), 1.5, dtype=torch.float64)
    return RoadEstimate(normal.expand(frames, 3), height, torch.full_like(height, 1e-3))


@pytest.mark.parametrize("most", [1, 2, 6, 100])
def test_thinning_keeps_so_many_points_evenly_spread(most: int):
    counts = [2, 5, 6, 7, 13, 40]
    journey = lane_drive(metres(1, 1.0), counts)
    rows = lane_point_observations(
        [journey],
        [flat_road(1)],
        keyframe_spacing=1.0,
        points_per_detection=most,
        height_sigma=0.05,
    )
    for detection, count in enumerate(counts):
        all_points = journey.lane_points.ideal[journey.lane_points.detection == detection]
        kept = rows.ideal[rows.detection == detection]
        assert len(kept) == min(count, most)
        rank = torch.cdist(kept, all_points).argmin(1)
        edges = torch.cat((torch.tensor([0]), rank, torch.tensor([count])))
        # From the first point on, no stretch is left out that is longer than the spacing.
        assert rank[0] == 0 and edges.diff().max() <= -(-count // min(count, most))


def test_lane_points_come_from_frames_apart():
    journey = lane_drive(metres(20, 0.5), [4, 4])
    rows = lane_point_observations(
        [journey, journey],
        [flat_road(20)] * 2,
        keyframe_spacing=2.0,
        points_per_detection=3,
        height_sigma=0.05,
    )
    assert rows.frame.unique().tolist() == [0, 4, 8, 12, 16, 20, 24, 28, 32, 36]
    assert torch.equal(rows.journey, (rows.frame >= 20).long())


def test_the_height_of_far_points_is_trusted_less():
    rows = lane_point_observations(
        [lane_drive(metres(1, 1.0), [8])],
        [flat_road(1)],
        keyframe_spacing=1.0,
        points_per_detection=8,
        height_sigma=0.05,
    )
    by_distance = rows.height_sigma[rows.ideal[:, 1].argsort(descending=True)]
    assert (by_distance.diff() > 0).all() and by_distance[0] >= 0.05


def test_planes_lead_through_the_road_where_the_car_drove_it_later():
    journey = lane_drive(metres(60, 0.5), [8])
    # From 10 m on the road leans by 0.02 to the right of the upright car.
    lean = 0.02 * (journey.T_world_camera[:, 0, 3] > 10).to(torch.float64)
    normal = torch.stack((lean, torch.ones_like(lean), torch.zeros_like(lean)), dim=1)
    normal = torch.nn.functional.normalize(normal, dim=1)
    road = RoadEstimate(normal, torch.full_like(lean, 1.5), torch.full_like(lean, 1e-3))
    rows = lane_point_observations(
        [journey], [road], keyframe_spacing=1.0, points_per_detection=8, height_sigma=0.05
    )
    first = rows[rows.frame == 0]
    ray = torch.nn.functional.pad(first.ideal, (0, 1), value=1.0)
    at = ray * (first.camera_height / (first.normal_camera * ray).sum(1))[:, None]
    leaning = at[:, 2] > 12
    assert leaning.any() and (at[:, 2] < 9).any()
    height = torch.where(leaning, 1.5 - 0.02 * at[:, 0], 1.5)
    # Half a metre to either side of 10 m the lean is interpolated.
    known = leaning | (at[:, 2] < 9)
    torch.testing.assert_close(at[known, 1], height[known], atol=2e-3, rtol=0)


def test_a_journey_without_lanes_gives_no_rows():
    journey = make_journey(make_rig(), driving_east(metres(3, 1.0)))
    rows = lane_point_observations(
        [journey], [flat_road(3)], keyframe_spacing=1.0, points_per_detection=6, height_sigma=0.05
    )
    assert len(rows) == 0
