from __future__ import annotations

import math

import torch

from crowdmap_torch.clustering import ridge
from crowdmap_torch.clustering.lines import LineSamples, RidgePoints, merged, owners_around
from crowdmap_torch.clustering.ridge import RidgeConfig
from crowdmap_torch.clustering.thinning import thin

CONFIG = RidgeConfig()


def straight(
    offsets: list[float], *, kind: list[int] | None = None, turned: list[int] | None = None
) -> LineSamples:
    """One owner with one straight line of 40 m along x for each offset."""
    s = torch.arange(0.0, 40.5, 1.0, dtype=torch.float64)
    n, k = len(s), len(offsets)
    owner = torch.arange(k).repeat_interleave(n)
    y = torch.tensor(offsets, dtype=torch.float64).repeat_interleave(n)
    sign = torch.tensor([-1.0 if i in (turned or []) else 1.0 for i in range(k)])
    direction = torch.stack((sign, torch.zeros(k)), 1).repeat_interleave(n, 0).double()
    return LineSamples(
        point=torch.stack((s.repeat(k), y, torch.zeros(n * k, dtype=torch.float64)), 1),
        direction=direction,
        slope=torch.zeros(n * k, dtype=torch.float64),
        kind=torch.tensor(kind or [-1] * k).repeat_interleave(n),
        track=owner,
        owner=owner,
        weight=torch.ones(n * k, dtype=torch.float64),
    )


def ridges(samples: LineSamples, bandwidth: float = 0.2) -> RidgePoints:
    config = RidgeConfig(bandwidth=bandwidth)
    start = ridge.seeds(samples, config, 4)
    return ridge.shift_to_ridges(start, samples, config, iterations=30)


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
    start = ridge.seeds(samples, CONFIG, 4)
    angle = 1.1
    R = torch.tensor(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]],
        dtype=torch.float64,
    )
    R3 = torch.block_diag(R, torch.ones(1, 1, dtype=torch.float64))

    def turned(points):
        return type(points)(
            **{
                **points.__dict__,
                "point": points.point @ R3.T,
                "direction": points.direction @ R.T,
            }
        )

    moved = ridge.shift_to_ridges(turned(start), turned(samples), CONFIG, iterations=5)
    still = ridge.shift_to_ridges(start, samples, CONFIG, iterations=5)
    torch.testing.assert_close(moved.point, still.point @ R3.T, rtol=0, atol=1e-9)


def test_dense_sampling_gives_no_more_weight() -> None:
    sparse = straight([0.0, 0.2])
    often = torch.arange(len(sparse)).repeat_interleave(torch.where(sparse.track == 0, 1, 5))
    a, b = ridges(sparse), ridges(sparse[often])
    assert abs(float(a.point[:, 1].mean() - b.point[:, 1].mean())) < 0.02


def test_thinning_leaves_one_point_a_metre() -> None:
    points = ridges(straight([-0.1, 0.0, 0.1]))
    kept = points[thin(points, along=1.0, sideways=0.25, beside_stronger=0.9, height_gate=2.0)]
    x = kept.point[:, 0].sort().values
    assert float((x[1:] - x[:-1]).min()) >= 1.0
    assert float((x[1:] - x[:-1]).max()) < 3.5


def test_merging_keeps_the_line_of_a_track() -> None:
    samples = straight([0.0, 3.5])
    twice = samples[torch.arange(len(samples)).repeat_interleave(2)]
    fewer, went = merged(twice, 2.0)
    assert len(fewer) < len(samples)
    assert (fewer.track[went] == twice.track).all()
    across = fewer.point[:, 1] - 3.5 * fewer.track
    assert float(across.abs().max()) < 1e-12


def test_owners_around_counts_each_once() -> None:
    samples = straight([0.0, 3.5, 40.0])
    count = owners_around(samples.point[:1], samples, 8.0)
    assert count.tolist() == [2]
