"""Section V of the paper: its formulas in plain Python beside ours."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
import torch
from worlds import scalars as s
from worlds.crowd_world import make_world, signs_at
from worlds.sign_drive import CAMERA, straight_poses

from crowdmap_torch.adjustment.lane_matching import LaneMatches, follow
from crowdmap_torch.adjustment.lenses import seen_points
from crowdmap_torch.adjustment.observations import LanePointObservations
from crowdmap_torch.clustering.spectral import (
    SpectralConfig,
    cluster_graph,
    eigengap,
    normalized_laplacian,
)
from crowdmap_torch.crowd_lanes.cluster import LaneClusterConfig, alongside, lane_similarity
from crowdmap_torch.crowd_signs.align import AlignConfig, mean_differences, no_bias
from crowdmap_torch.crowd_signs.cluster import center_similarity, sign_heads
from crowdmap_torch.geometry import camera as cameras
from crowdmap_torch.geometry import se3, spline_basis, spline_length
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.optim.robust import Tukey
from crowdmap_torch.residuals.lane import lane_reprojection
from crowdmap_torch.residuals.reprojection import sign_reprojection

F64 = torch.float64
K = CAMERA.K.tolist()


def test_similarity_of_signs_is_a_gaussian_of_their_centers_distance():
    place = [(0.0, 0.0, 2.0), (0.5, 1.0, 2.5), (3.0, -1.0, 1.5), (0.2, 0.1, 2.0)]
    signs = signs_at(place, [0, 1, 2, 0])
    pairs = list(itertools.combinations(range(4), 2))
    found = center_similarity(signs, torch.tensor(pairs), critical_m=4.0)
    for (i, j), similarity in zip(pairs, found.tolist(), strict=True):
        d = s.norm(s.minus(list(place[i]), list(place[j])))
        same_journey = (i, j) == (0, 3)
        expected = 0.0 if same_journey else math.exp(-0.5 * (d / 4.0) ** 2)
        assert similarity == pytest.approx(expected)
    other = replace(signs, shape=(signs.shape + torch.tensor([0, 1, 1, 1])) % 6)
    assert center_similarity(other, torch.tensor([[0, 1]]), critical_m=4.0).tolist() == [0.0]


def test_clusters_are_as_many_as_eigenvalues_before_the_largest_gap(generator):
    # Three perfect clusters, and a little similarity between any two nodes.
    of, n = [0, 0, 0, 1, 1, 2, 2, 2, 2], 9
    S = [[1.0 if of[i] == of[j] else 0.05 for j in range(n)] for i in range(n)]
    degree = [sum(row) for row in S]
    L = [
        [(i == j) - S[i][j] / math.sqrt(degree[i] * degree[j]) for j in range(n)] for i in range(n)
    ]
    found = normalized_laplacian(torch.tensor(S, dtype=F64))
    torch.testing.assert_close(found, torch.tensor(L, dtype=F64), rtol=0, atol=1e-12)
    values = torch.linalg.eigvalsh(found)
    gaps = [b - a for a, b in itertools.pairwise([*values.tolist(), 1.0])]
    count = max(range(n), key=gaps.__getitem__) + 1
    assert count == 3 == int(eigengap(values, torch.tensor(n)))
    edge = torch.tensor(list(itertools.combinations(range(n), 2)))
    similarity = torch.tensor([S[i][j] for i, j in edge.tolist()], dtype=F64)
    clusters = cluster_graph(
        edge, similarity, n, SpectralConfig(), whole=torch.zeros(n).long(), generator=generator
    )
    assert clusters.label.tolist() == of


def test_blocks_of_one_matrix_have_one_gap_together(generator):
    # Two blocks; alone the second would fall in two at its own, smaller gap.
    S = torch.eye(7, dtype=F64)
    for i, j, value in ((0, 1, 1.0), (2, 3, 0.98), (3, 4, 0.6), (4, 5, 0.98), (2, 5, 0.6)):
        S[i, j] = S[j, i] = value
    edge = (S.triu(1) > 0).nonzero()
    found = cluster_graph(
        edge, S[edge[:, 0], edge[:, 1]], 7, SpectralConfig(), whole=torch.zeros(7).long()
    )
    whole = torch.linalg.eigvalsh(normalized_laplacian(S))
    torch.testing.assert_close(found.eigenvalues, whole, rtol=0, atol=1e-9)
    assert found.count == int(eigengap(whole, torch.tensor(7)))


def test_heads_have_the_mean_of_the_respective_corners():
    place = [(0.0, 0.0, 2.0), (0.4, 0.3, 2.2), (-0.1, 0.6, 1.9), (50.0, 0.0, 2.0), (50.5, 0.2, 2.1)]
    signs = signs_at(place, [0, 1, 2, 0, 1])
    label = [0, 0, 0, 1, 1]
    heads = sign_heads(signs, torch.tensor(label), method="paper2017")
    for c, corner in itertools.product(range(2), range(8)):
        corners = [signs.corners_world[k, corner].tolist() for k in range(5) if label[k] == c]
        found = heads.corners_world[c, corner].tolist()
        assert found == pytest.approx(s.mean(corners), abs=1e-9)


@pytest.mark.parametrize("kind", ["gaussian", "ratio"])
def test_similarity_of_lanes_is_of_their_nearest_points_and_the_share_alongside(kind, generator):
    x = torch.linspace(0, 24, 5, dtype=F64)
    sides = (0.0, 0.7, 1.3)
    control = torch.cat([torch.stack((x + y, 0.02 * x + y, 0.1 * x), 1) for y in sides])
    count = torch.full((3,), 5)
    config = LaneClusterConfig(similarity=kind)
    edge, found = lane_similarity(control, count, config, critical=8.0)
    point, _, owner = spline_length.sample_flat(control, count, 1.0)
    A = [point[owner == k].tolist() for k in range(3)]

    def near_and_share(i: int, j: int) -> tuple[float, float]:
        d = [s.norm(s.minus(a, b)) for a in A[i] for b in A[j]]
        return min(d), sum(one < config.radius_m for one in d) / (len(A[i]) * len(A[j]))

    def ratio(i: int, j: int) -> float:
        D_min, N = near_and_share(i, j)
        return N / max(D_min, config.touch_m)

    for (i, j), similarity in zip(edge.tolist(), found.tolist(), strict=True):
        D_min, N = near_and_share(i, j)
        expected = math.exp(-0.5 * (D_min / (8.0 * N)) ** 2)
        if kind == "ratio":
            expected = ratio(i, j) / math.sqrt(ratio(i, i) * ratio(j, j))
        assert similarity == pytest.approx(expected, rel=1e-9)
    pairs, near, closest = alongside(point, owner, 3, config.radius_m)
    for (i, j), number, least in zip(pairs.tolist(), near.tolist(), closest.tolist(), strict=True):
        D_min, N = near_and_share(i, j)
        assert least == pytest.approx(D_min, abs=1e-12)
        assert number == round(N * len(A[i]) * len(A[j]))


def test_sign_error_is_the_projection_minus_the_corner(generator):
    T_camera = straight_poses(1)[0]
    T_sign = se3.retract(
        torch.eye(4, dtype=F64), 0.2 * torch.randn(6, dtype=F64, generator=generator)
    )
    T_sign[:3, 3] += torch.tensor([4.0, 20.0, 2.5], dtype=F64)
    size, template = torch.tensor([0.8, 0.6], dtype=F64), torch.tensor([-0.5, 0.5], dtype=F64)
    R, center = s.rotation_and_place(T_sign.tolist())
    corner = s.plus(center, s.times(R, [-0.4, 0.3, 0.0]))
    px = s.pinhole(s.seen_from(T_camera.tolist(), corner), K)
    seen = s.plus(px, [1.5, -2.0])
    seen_px = torch.tensor(seen, dtype=F64)
    M = cameras.observation_matrix(CAMERA, seen_px, cameras.unproject(CAMERA, seen_px)[0])
    found = sign_reprojection(T_camera, T_sign, size, template, M)
    assert found.tolist() == pytest.approx(s.minus(px, seen), abs=1e-6)


def test_lane_error_is_the_distance_to_the_closest_projected_spline_point():
    T_camera = straight_poses(1)
    x = torch.linspace(6, 30, 5, dtype=F64)
    control = torch.stack((-1.5 + 0.002 * x * x, x, 0 * x), dim=-1)
    count = torch.tensor([5])
    seen = torch.tensor([[557.0, 521.0]], dtype=F64)
    ideal = cameras.unproject(CAMERA, seen)[0]
    one, zero = torch.ones(1, dtype=F64), torch.zeros(1).long()
    observation = LanePointObservations(
        **seen_points(CAMERA, 0, seen, ideal),
        frame=zero,
        journey=zero,
        detection=zero,
        normal_camera=torch.tensor([[0.0, 1.0, 0.0]], dtype=F64),
        camera_height=one,
        height_sigma=one,
    )
    coefficient = spline_basis.to_coefficients_flat(control, count)
    start = LaneMatches(zero, one * 1.5, ideal, torch.ones(1, dtype=torch.bool))
    match = start
    for _ in range(4):
        match = follow(match, observation, T_camera, coefficient, count)
    row, weight, _ = spline_basis.window_flat(match.t, zero, count)
    c0, c1, c2, c3 = coefficient[row[0]]
    found = lane_reprojection(
        T_camera[0], c0, c1, c2, c3, weight[0], match.normal_px[0], observation.matrix[0]
    )

    def distance(t: float) -> float:
        point = [s.natural_spline(control[:, axis].tolist(), t) for axis in range(3)]
        px = s.pinhole(s.seen_from(T_camera[0].tolist(), point), K)
        return s.norm(s.minus(px, seen[0].tolist()))

    closest = min(distance(4 * k / 20000) for k in range(20001))
    assert abs(float(found)) == pytest.approx(closest, abs=1e-3)


def test_robust_loss_is_tukeys():
    loss, c = Tukey(4.685), 4.685
    for r in (0.0, 1.0, 3.0, 4.6, 4.7, 9.0):
        squared = torch.tensor(r * r, dtype=F64)
        assert float(loss.rho(squared)) == pytest.approx(s.tukey(r * r, c))
        weight = (1 - (r / c) ** 2) ** 2 if r <= c else 0.0
        assert float(loss.weight(squared)) == pytest.approx(weight)


def test_bias_is_the_mean_difference_of_a_journeys_signs_from_everybodys():
    world = make_world(5, journeys=4)
    signs, label = world.crowd.signs, world.sign
    start = no_bias(signs, world.crowd.station, PositioningNoise(), AlignConfig(), journeys=4)
    found = mean_differences(signs, label, world.crowd.station, start)
    of, journey, place = label.tolist(), signs.journey.tolist(), signs.center_world.tolist()
    members = {c: [k for k in range(len(of)) if of[k] == c] for c in set(of) if c >= 0}
    shared = {c: m for c, m in members.items() if len({journey[k] for k in m}) >= 2}
    for j in range(4):
        differences = [
            s.minus(place[k], s.mean([place[m] for m in shared[of[k]]]))
            for k in range(len(of))
            if journey[k] == j and of[k] in shared
        ]
        assert found.translation[j].tolist() == pytest.approx(s.mean(differences), abs=1e-9)
