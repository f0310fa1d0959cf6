from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from worlds import lane_world

from crowdmap_torch.crowd_lanes.cluster import (
    LaneClusterConfig,
    LaneClusters,
    alongside,
    cluster_lanes,
    lane_similarity,
)
from crowdmap_torch.geometry import spline_length

CONFIG = LaneClusterConfig()


@pytest.fixture(scope="module")
def world() -> lane_world.LaneWorld:
    return lane_world.build(
        0, 5, length=300.0, markers=lane_world.SUBURB[:3], wrong_share=0.0, drift=0.1
    )


@pytest.fixture(scope="module")
def clusters(world: lane_world.LaneWorld) -> LaneClusters:
    return cluster_lanes(world.lanes, CONFIG, generator=torch.Generator().manual_seed(0))


def splines(*offsets: float, length: float = 40.0) -> tuple[Tensor, Tensor]:
    x = torch.linspace(0, length, 6, dtype=torch.float64)
    control = torch.cat([torch.stack((x, 0 * x + y, 0 * x), 1) for y in offsets])
    return control, torch.full((len(offsets),), 6)


def test_pairs_are_those_of_all_distances(generator: torch.Generator) -> None:
    point = 3 * torch.rand(60, 3, generator=generator, dtype=torch.float64)
    owner = torch.arange(60) // 10
    edge, number, closest = alongside(point, owner, 6, 0.8)
    distance = torch.cdist(point, point).reshape(6, 10, 6, 10).permute(0, 2, 1, 3).flatten(2)
    near = (distance < 0.8).sum(2)
    i, j = edge.T
    assert (near.triu() > 0).sum() == len(edge)
    assert (number == near[i, j]).all()
    torch.testing.assert_close(closest, distance.amin(2)[i, j], rtol=0, atol=1e-12)


def test_gaussian_similarity_is_that_of_the_paper() -> None:
    control, count = splines(0.0, 0.4)
    edge, similarity = lane_similarity(control, count, CONFIG, critical=8.0)
    point = [spline_length.sample_flat(c, count[:1], 1.0)[0] for c in control.split(6)]
    distance = torch.cdist(point[0], point[1])
    share = (distance < CONFIG.radius_m).double().mean()
    expected = torch.exp(-0.5 * (distance.min() / (8.0 * share)) ** 2)
    assert edge.tolist() == [[0, 1]]
    torch.testing.assert_close(similarity[0], expected)


def test_ratio_is_one_for_splines_that_touch_and_falls_with_distance() -> None:
    config = LaneClusterConfig(similarity="ratio")
    values = [
        float(lane_similarity(*splines(0.0, y), config, critical=1.0)[1][0])
        for y in (0.0, 0.2, 0.4, 0.8)
    ]
    assert values[0] == pytest.approx(1.0)
    assert values == sorted(values, reverse=True)


def test_markers_apart_are_not_compared() -> None:
    edge, _ = lane_similarity(*splines(0.0, 3.5), CONFIG, critical=8.0)
    assert len(edge) == 0


def test_clusters_do_not_mix_markers(world: lane_world.LaneWorld, clusters: LaneClusters) -> None:
    label = clusters.label.numpy()
    for c in range(clusters.count):
        assert len(np.unique(world.marker_of_piece[label == c])) == 1


@pytest.mark.parametrize("similarity", ["gaussian", "ratio"])
def test_heads_lie_on_the_markers(world: lane_world.LaneWorld, similarity: str) -> None:
    found = cluster_lanes(
        world.lanes,
        LaneClusterConfig(similarity=similarity),
        generator=torch.Generator().manual_seed(0),
    )
    figures = lane_world.figures(world, found.heads)
    assert figures.recall > 0.97
    assert figures.precision > 0.95
    assert figures.lateral < 0.12


def test_rounds_reduce_the_number_of_clusters(clusters: LaneClusters) -> None:
    counts = [r.clusters for r in clusters.rounds]
    assert counts == sorted(counts, reverse=True)
    assert clusters.rounds[0].splines > counts[0]
    assert clusters.count == len(clusters.heads) <= counts[-1]


def test_clusters_of_one_journey_are_discarded() -> None:
    world = lane_world.build(1, 3, length=200.0, markers=lane_world.SUBURB[:2], wrong_share=0.0)
    keep = (torch.from_numpy(world.marker_of_piece) == 0) | (world.lanes.journey == 0)
    lanes = world.lanes.select(keep.nonzero()[:, 0])
    found = cluster_lanes(lanes, CONFIG, generator=torch.Generator().manual_seed(0))
    alone = torch.from_numpy(world.marker_of_piece)[keep] == 1
    assert (found.label[alone] == -1).all()
    assert found.discarded == int(alone.sum())
    assert (found.heads.n_journeys >= 2).all()


def test_unknown_similarity_is_refused() -> None:
    with pytest.raises(ValueError, match="similarity"):
        LaneClusterConfig(similarity="cosine")
