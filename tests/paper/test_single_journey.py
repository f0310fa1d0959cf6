"""Section IV of the paper: its formulas in plain Python beside ours."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from worlds import scalars as s
from worlds.road_drives import blind_journey, poses_on_plane
from worlds.sign_drive import CAMERA, RIG, SignDrive, drive_past, signs_at, straight_poses

from crowdmap_torch.clustering.assignment import matching_of_near
from crowdmap_torch.geometry import camera as cameras
from crowdmap_torch.geometry import polygon, se3, spline_basis
from crowdmap_torch.geometry.correspondence import vertex_costs
from crowdmap_torch.geometry.epipolar import epipolar_cost, fundamental
from crowdmap_torch.geometry.plane import ground_points, scatter, smallest_singular_value
from crowdmap_torch.lanes.pieces import cut_by_number, fit_pieces
from crowdmap_torch.optim.linearize import term_costs
from crowdmap_torch.road.coplanarity import CoplanarityConfig, coplanar_normals, pick_nodes
from crowdmap_torch.road.ego_motion import motion_of_poses
from crowdmap_torch.road.ground_projection import project_to_planes
from crowdmap_torch.signs.fit_alone import center_axis_size, mid_points, reprojection_problem
from crowdmap_torch.signs.views import SignViews
from crowdmap_torch.tables import LaneDetections, LanePoints, RoadEstimate
from crowdmap_torch.tracking.lane_features import (
    LaneAssociationConfig,
    lane_features,
    lane_pair_costs,
)
from crowdmap_torch.tracking.sign_features import (
    SignAssociationConfig,
    sign_features,
    sign_pair_costs,
)

F64 = torch.float64
K = CAMERA.K.tolist()


def printed_cost(T_i: s.Matrix, T_j: s.Matrix, p: s.Vector, q: s.Vector) -> float:
    """|p^T F_ij q|^2 / (|F_ij^T p|^2 + |F_ij q|^2), F_ij of the two poses."""
    R_i, c_i = s.rotation_and_place(T_i)
    R_j, c_j = s.rotation_and_place(T_j)
    t = s.times(s.transposed(R_i), s.minus(c_j, c_i))
    F = s.product(s.cross_matrix(t), s.product(s.transposed(R_i), R_j))
    Fq, Fp = s.times(F, q), s.times(s.transposed(F), p)
    return s.dot(p, Fq) ** 2 / (s.dot(Fp, Fp) + s.dot(Fq, Fq))


def posed(generator: torch.Generator, n: int) -> torch.Tensor:
    xi = torch.randn(n, 6, dtype=F64, generator=generator)
    return se3.retract(torch.eye(4, dtype=F64).expand(n, 4, 4), xi * 0.3)


def test_matching_takes_measurements_near_a_tracklet_and_assigns_them_at_the_least_sum(generator):
    for _ in range(20):
        cost = 10 * torch.rand(4, 3, dtype=F64, generator=generator)
        C, gate = cost.tolist(), 3.0
        J = [j for j in range(3) if min(C[i][j] for i in range(4)) <= gate]
        ways = itertools.permutations(range(4), len(J))
        least = min(sum(C[i][j] for i, j in zip(way, J, strict=True)) for way in ways)
        row, column = matching_of_near(np.array(C), gate)
        assert sorted(column.tolist()) == J
        assert float(cost[row, column].sum()) == pytest.approx(least)


def test_epipolar_cost_is_as_printed(generator):
    T_i, T_j = posed(generator, 8), posed(generator, 8)
    p, q = torch.randn(2, 8, 2, dtype=F64, generator=generator).unbind(0)
    F = fundamental(T_i, T_j)
    found = epipolar_cost(F, p, q, components=3)
    pairs = vertex_costs(F, p[:, None], q[:, None], components=3)[:, 0, 0]
    for k in range(8):
        points = [*p[k].tolist(), 1.0], [*q[k].tolist(), 1.0]
        expected = printed_cost(T_i[k].tolist(), T_j[k].tolist(), *points)
        assert float(found[k]) == pytest.approx(expected, rel=1e-9)
        assert float(pairs[k]) == pytest.approx(expected, rel=1e-9)


def test_cost_of_signs_is_the_sum_over_the_best_matching_of_vertices():
    poses = straight_poses(8)
    drive = drive_past(poses, signs_at([(4.0, 40.0, 2.0)]), shape=[3], noise_px=1.0)
    signs = drive.journey.signs[drive.journey.signs.frame.argsort()]
    config = SignAssociationConfig(method="paper2017")
    features = sign_features(signs, poses[signs.frame], config)
    n = int(polygon.corner_count(signs.shape[:1]))
    a, b = features[torch.tensor([0, 2])], features[torch.tensor([5, 7])]
    found = sign_pair_costs(a, b, config)
    for k in range(2):
        T_a, T_b = a.T_world_camera[k].tolist(), b.T_world_camera[k].tolist()
        P, Q = ([[*v, 1.0] for v in f.corners[k, :n].tolist()] for f in (a, b))
        cost = [[printed_cost(T_a, T_b, p, q) for q in Q] for p in P]
        ways = itertools.permutations(range(n))
        least = min(sum(cost[v][way[v]] for v in range(n)) for way in ways)
        # Without distortion a focal length of 1,000 pixels everywhere.
        assert float(found[k]) == pytest.approx(least * 1000.0**2, rel=1e-6)


def test_cost_of_lanes_is_the_sum_over_pairs_of_points_of_their_lines():
    poses = straight_poses(4)[[0, 3]]
    ahead = torch.linspace(5, 40, 12, dtype=F64)
    ideal = torch.stack((-1.75 / ahead + 0.002 * ahead.sin(), 1.45 / ahead), dim=-1).repeat(2, 1)
    owner = torch.arange(2).repeat_interleave(12)
    points = LanePoints(owner, 1000 * ideal, ideal)
    two = torch.arange(2)
    detections = LaneDetections(two, two, -torch.ones_like(two), torch.ones(2, dtype=F64))
    config = LaneAssociationConfig(method="paper2017")
    features = lane_features(detections, points, RIG, poses, config)
    first, second = features[two[:1]], features[two[1:]]
    total = 0.0
    for p in first.line_ideal[0].tolist():
        for q in second.line_ideal[0].tolist():
            total += printed_cost(poses[0].tolist(), poses[1].tolist(), [*p, 1.0], [*q, 1.0])
    found = lane_pair_costs(first, second, config)
    assert float(found) == pytest.approx(total * 1000.0**2, rel=1e-6)


@pytest.fixture(scope="module")
def drive() -> SignDrive:
    T = signs_at([(4.0, 40.0, 2.0), (-3.0, 45.0, 3.0)], yaw_deg=[10.0, -5.0])
    return drive_past(straight_poses(30), T, shape=[0, 5], noise_px=1.0)


@pytest.fixture(scope="module")
def views(drive: SignDrive) -> SignViews:
    """The detections in the corners' true order."""
    signs = drive.journey.signs
    T = drive.journey.T_world_camera[signs.frame]
    exact = se3.transform(se3.inverse(T)[:, None], drive.corners_world[drive.sign])
    count = polygon.corner_count(signs.shape)
    shift, _ = polygon.best_shift(cameras.project(CAMERA, exact)[0], signs.corners_px, count)
    px = polygon.roll(signs.corners_px, shift, count)
    ideal = polygon.roll(signs.corners_ideal, shift, count)
    M = cameras.observation_matrix(CAMERA, px, ideal)
    return SignViews(drive.sign, signs.frame, px, ideal, M, T)


def test_mid_points_are_nearest_to_the_rays_of_their_corner(drive: SignDrive, views: SignViews):
    found = mid_points(views, 2)
    for sign, corner in ((0, 0), (0, 3), (1, 7)):
        mine = [k for k in range(len(views)) if int(views.sign[k]) == sign]
        rays = []
        for k in mine:
            R, c = s.rotation_and_place(views.T_world_camera[k].tolist())
            d = s.times(R, [*views.corners_ideal[k, corner].tolist(), 1.0])
            rays.append((c, [x / s.norm(d) for x in d]))

        def distance_sq(point: s.Vector, rays: list = rays) -> float:
            total = 0.0
            for c, d in rays:
                off = s.minus(point, c)
                total += s.dot(off, off) - s.dot(off, d) ** 2
            return total

        point = found[sign, corner].tolist()
        for axis, step in itertools.product(range(3), (-1e-3, 1e-3)):
            moved = [x + step * (k == axis) for k, x in enumerate(point)]
            assert distance_sq(moved) > distance_sq(point)


def test_center_is_the_centroid_axis_that_of_the_best_plane_and_sizes_follow(
    drive: SignDrive, views: SignViews
):
    corners = mid_points(views, 2)
    start = center_axis_size(corners, drive.shape, views)
    for k in range(2):
        number = int(polygon.corner_count(drive.shape[k : k + 1]))
        points = corners[k, :number].tolist()
        centroid = s.mean(points)
        assert start.T_world_sign[k, :3, 3].tolist() == pytest.approx(centroid, abs=1e-9)
        off = [s.minus(p, centroid) for p in points]
        S = [[sum(o[i] * o[j] for o in off) for j in range(3)] for i in range(3)]
        normal = start.T_world_sign[k, :3, 2].tolist()
        flat = sum(s.dot(o, normal) ** 2 for o in off)
        assert flat == pytest.approx(s.smallest_eigenvalue(S), rel=1e-6, abs=1e-9)
    exact = center_axis_size(drive.corners_world, drive.shape, views)
    torch.testing.assert_close(exact.size, drive.size, rtol=0, atol=1e-9)


def test_reprojection_metric_is_tukeys_of_each_corners_pixel_error(
    drive: SignDrive, views: SignViews
):
    scale, c = [1.5, 0.8], 3.0
    problem = reprojection_problem(views, drive.shape, torch.tensor(scale, dtype=F64), tukey=c)
    T = drive.T_world_sign.clone()
    T[:, :3, 3] += 0.02
    total = 0.0
    for k in range(len(views)):
        sign = int(views.sign[k])
        R, center = s.rotation_and_place(T[sign].tolist())
        outline = polygon.corners(drive.shape[sign][None], drive.size[sign][None])[0].tolist()
        for corner in range(int(polygon.corner_count(drive.shape[sign]))):
            point = s.plus(center, s.times(R, outline[corner]))
            px = s.pinhole(s.seen_from(views.T_world_camera[k].tolist(), point), K)
            error = s.minus(px, views.corners_px[k, corner].tolist())
            total += s.tukey(s.dot(error, error) / scale[sign] ** 2, c) / 2
    costs = term_costs(problem, {"sign": T, "size": drive.size})
    assert float(costs["corners"].sum()) == pytest.approx(total, rel=1e-6)


def test_inverse_perspective_mapping_is_eq_ipm(generator):
    T = posed(generator, 5)
    u = torch.randn(5, 3, dtype=F64, generator=generator).abs()
    h_hat = torch.nn.functional.normalize(torch.tensor([0.05, 1.0, 0.02], dtype=F64), dim=0)
    height = 1.45
    w = ground_points(u, h_hat * height, T)
    for n in range(5):
        R, c = s.rotation_and_place(T[n].tolist())
        ray = s.times(R, u[n].tolist())
        expected = s.plus(c, ray, height / s.dot(h_hat.tolist(), u[n].tolist()))
        assert w[n].tolist() == pytest.approx(expected, rel=1e-9)


def test_co_planarity_is_the_smallest_singular_value_of_the_scatter(generator):
    W = torch.randn(12, 3, dtype=F64, generator=generator) * torch.tensor([5.0, 3.0, 0.2])
    points = W.tolist()
    mu = s.mean(points)
    S = [[0.0] * 3 for _ in range(3)]
    for w in points:
        off = s.minus(w, mu)
        for i, j in itertools.product(range(3), range(3)):
            S[i][j] += off[i] * off[j]
    found = smallest_singular_value(scatter(W)[1])
    assert float(found) == pytest.approx(s.smallest_eigenvalue(S), rel=1e-9)


def test_road_normal_minimises_the_sum_of_eq_rne(generator):
    config = CoplanarityConfig(segments=3, poses=6)
    steering = 0.8 * torch.sin(torch.arange(120, dtype=F64) * 0.8 / 20)
    poses = poses_on_plane(steering, 0.8, pitch=0.02, roll=-0.015)
    noise = torch.randn(120, 6, dtype=F64, generator=generator) * 1e-3
    poses = se3.retract(poses, noise)
    motion = motion_of_poses(poses, blind_journey(poses).t_ns, torch.eye(3, dtype=F64))
    station = torch.cat((motion.station[:1], motion.station)).cummax(0)[0]
    nodes = pick_nodes(motion, station, config)
    last = torch.tensor([119])
    found = coplanar_normals(nodes, last, station[1:][last], 1.5, torch.zeros(2, dtype=F64), config)
    now = int(station[-1] / config.segment_m)
    rays = list(itertools.product(config.points_right, config.points_down))

    def J(alpha: float, beta: float) -> float:
        length = math.sqrt(alpha**2 + beta**2 + 1)
        h_hat, total = [beta / length, 1 / length, alpha / length], 0.0
        for segment in range(max(now - config.segments, 0), now):
            W = []
            for k in range(len(nodes)):
                if int(nodes.cell[k]) // config.poses != segment:
                    continue
                R, c = nodes.R_world_road[k].tolist(), nodes.position[k].tolist()
                for right, down in rays:
                    u = [right, down, 1.0]
                    W.append(s.plus(c, s.times(R, u), 1.5 / s.dot(h_hat, u)))
            off = [s.minus(w, s.mean(W)) for w in W]
            S = [[sum(o[i] * o[j] for o in off) for j in range(3)] for i in range(3)]
            total += s.smallest_eigenvalue(S)
        return total

    alpha, beta = float(found.alpha), float(found.beta)
    least = J(alpha, beta)
    for step in ((2e-4, 0), (-2e-4, 0), (0, 2e-4), (0, -2e-4)):
        assert J(alpha + step[0], beta + step[1]) > least


def test_control_points_make_a_natural_cubic_spline(generator):
    control = torch.randn(5, 3, dtype=F64, generator=generator)
    t = torch.tensor([0.0, 0.3, 1.0, 1.9, 2.5, 3.2, 4.0], dtype=F64)
    found = spline_basis.evaluate_flat(control, torch.tensor([5]), t, torch.zeros(7).long())
    for k, at in enumerate(t.tolist()):
        expected = [s.natural_spline(control[:, axis].tolist(), at) for axis in range(3)]
        assert found[k].tolist() == pytest.approx(expected, abs=1e-9)


def test_lanes_are_least_squares_splines_of_the_most_recent_points(generator):
    ahead = torch.linspace(0, 40, 30, dtype=F64)
    points = torch.stack((ahead, 2 * (ahead / 15).sin(), 0.1 * ahead.cos()), dim=-1)
    points = points + 0.1 * torch.randn(30, 3, dtype=F64, generator=generator)
    zero, frame = torch.zeros(30).long(), torch.arange(30)
    pieces = cut_by_number(zero, frame, points, number=20, control_points=5)
    assert [pieces.point[pieces.piece == k].tolist() for k in range(len(pieces))] == [
        list(range(20)),
        list(range(10, 30)),
    ]
    fit = fit_pieces(pieces, points, torch.ones(30, dtype=F64), smoothing=0.0, scales=())
    mine = (pieces.piece == 0).nonzero()[:, 0].tolist()

    def squares(control: s.Matrix) -> float:
        total = 0.0
        for row in mine:
            t, point = float(pieces.t[row]), points[pieces.point[row]].tolist()
            for axis in range(3):
                values = [c[axis] for c in control]
                total += (s.natural_spline(values, t) - point[axis]) ** 2
        return total

    control = fit.control[:5].tolist()
    least = squares(control)
    for k, axis, step in itertools.product(range(5), range(3), (-1e-3, 1e-3)):
        moved = [list(c) for c in control]
        moved[k][axis] += step
        assert squares(moved) > least


def test_lane_points_are_mapped_to_the_plane_under_their_frame(generator):
    journey = blind_journey(straight_poses(3))
    ideal = torch.tensor([[0.1, 0.2], [-0.3, 0.1], [0.05, 0.15]], dtype=F64)
    frame = torch.tensor([0, 1, 2])
    detections = LaneDetections(frame, frame, -torch.ones_like(frame), torch.ones(3, dtype=F64))
    journey = replace(journey, lanes=detections, lane_points=LanePoints(frame, 1000 * ideal, ideal))
    normal = torch.nn.functional.normalize(
        torch.tensor([[0.01, 1.0, 0.02], [0.0, 1.0, 0.01], [0.02, 1.0, 0.0]], dtype=F64), dim=-1
    )
    height = torch.full((3,), 1.45, dtype=F64)
    road = RoadEstimate(normal_camera=normal, height=height, sigma=0.01 * height)
    found = project_to_planes(journey, road)
    for k in range(3):
        R, c = s.rotation_and_place(journey.T_world_camera[k].tolist())
        u = [*ideal[k].tolist(), 1.0]
        expected = s.plus(c, s.times(R, u), 1.45 / s.dot(normal[k].tolist(), u))
        assert found.point_world[k].tolist() == pytest.approx(expected, rel=1e-9)
