from __future__ import annotations

import math

import torch
from worlds.lines import ridges, straight

from crowdmap_torch.crowd_lanes.density_ridge import RidgeConfig, seed_points, shift_to_ridges

CONFIG = RidgeConfig()


def test_points_move_to_the_mean_of_lines_that_are_one() -> None:
    points = ridges(straight([-0.1, 0.0, 0.1]))
    assert float(points.point[:, 1].abs().max()) < 0.02
    assert int(points.owners.min()) == 3


def test_a_line_that_is_off_pulls_little() -> None:
    points = ridges(straight([-0.05, 0.0, 0.05, 0.0, 0.7]))
    near = points.point[:, 1] < 0.4
    assert float(points.point[near, 1].abs().max()) < 0.02


def test_lines_half_a_metre_apart_stay_two() -> None:
    points = ridges(straight([0.0, 0.0, 0.5, 0.5]), bandwidth=0.15)
    across = points.point[:, 1]
    assert float(torch.minimum(across.abs(), (across - 0.5).abs()).max()) < 0.05


def test_kinds_keep_lines_apart_that_places_do_not() -> None:
    points = ridges(straight([0.0, 0.02, 0.3, 0.32], kind=[0, 0, 3, 3]))
    assert float(points.point[points.kind == 0, 1].mean()) < 0.08
    assert float(points.point[points.kind == 3, 1].mean()) > 0.24


def test_lines_against_each_other_are_one_ridge() -> None:
    points = ridges(straight([0.0, 0.1], turned=[1]))
    assert float((points.point[:, 1] - 0.05).abs().max()) < 0.02
    assert int(points.owners.min()) == 2


def test_ridges_turn_with_the_world() -> None:
    samples = straight([-0.1, 0.0, 0.1])
    start = seed_points(samples, CONFIG, 4)
    angle = 1.1
    R = torch.tensor(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]],
        dtype=torch.float64,
    )
    R3 = torch.block_diag(R, torch.ones(1, 1, dtype=torch.float64))

    def turned(points):
        return type(points)(
            **{**points.__dict__, "point": points.point @ R3.T, "direction": points.direction @ R.T}
        )

    moved = shift_to_ridges(turned(start), turned(samples), CONFIG, iterations=5)
    still = shift_to_ridges(start, samples, CONFIG, iterations=5)
    torch.testing.assert_close(moved.point, still.point @ R3.T, rtol=0, atol=1e-9)


def test_dense_sampling_gives_no_more_weight() -> None:
    sparse = straight([0.0, 0.2])
    often = torch.arange(len(sparse)).repeat_interleave(torch.where(sparse.track == 0, 1, 5))
    a, b = ridges(sparse), ridges(sparse[often])
    assert abs(float(a.point[:, 1].mean() - b.point[:, 1].mean())) < 0.02


def test_points_far_from_all_samples_stay_where_they_are() -> None:
    samples = straight([0.0, 0.1])
    start = seed_points(samples, CONFIG, 4)
    far = type(start)(**{**start.__dict__, "point": start.point + 100.0})
    still = shift_to_ridges(far, samples, CONFIG, iterations=3)
    assert torch.equal(still.point, far.point)
    assert float(still.density.max()) == 0.0
    assert len(shift_to_ridges(start[torch.arange(0)], samples, CONFIG, iterations=3)) == 0


def test_votes_count_the_kinds_that_support_a_point() -> None:
    points = ridges(straight([0.0, 0.02, 0.04], kind=[1, 1, -1]))
    assert (points.votes.argmax(1) == 1).all()
    assert float(points.votes[:, [0, 2, 3]].abs().max()) == 0.0
