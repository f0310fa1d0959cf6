"""V-A.1: clusters of triangulated signs, the paper's rounds and ours, and the sign that heads each cluster."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from worlds.crowd_world import World, make_world, pair_scores, shuffled
from worlds.partitions import same_partition

from crowdmap_torch.clustering.spectral import SpectralConfig
from crowdmap_torch.crowd_signs.cluster import SignClusterConfig, cluster_signs, moved, sign_heads
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.tables import Signs

PAPER = SignClusterConfig(method="paper2017")


@pytest.fixture(scope="module")
def aligned() -> World:
    """A street whose journeys have no bias and hardly any noise; signs of one post far apart."""
    return make_world(
        1, journeys=6, bias_m=0.02, drift_m=0.02, spacing_m=2.5, ghosts=0.0, fragments=0.0
    )


@pytest.mark.parametrize("labels", ["kmeans", "sign_code"])
def test_paper_finds_the_signs_of_aligned_journeys(aligned: World, labels: str):
    config = replace(PAPER, spectral=SpectralConfig(labels=labels))
    found = cluster_signs(aligned.crowd.signs, config)
    precision, recall = pair_scores(aligned, found.label)
    assert precision > 0.97
    assert recall > 0.97
    assert len(found.spectra) == 2


def test_paper_never_links_signs_of_one_journey(aligned: World):
    one = aligned.crowd.signs[aligned.crowd.signs.journey == 0]
    found = cluster_signs(one, PAPER)
    assert found.count == 0
    assert (found.label < 0).all()


def test_paper_never_links_signs_of_different_shapes(aligned: World):
    signs = aligned.crowd.signs
    shape = torch.where(signs.journey % 2 == 0, 0, 2)
    found = cluster_signs(replace(signs, shape=shape), PAPER).label
    assert found.max() >= 0
    for cluster in range(int(found.max()) + 1):
        assert len(shape[found == cluster].unique()) == 1


def test_second_round_only_divides_the_clusters_of_the_first(aligned: World):
    signs = aligned.crowd.signs
    first = cluster_signs(signs, replace(PAPER, scales_m=(4.0,), min_signs=1)).label
    both = cluster_signs(signs, replace(PAPER, min_signs=1)).label
    pairs = torch.unique(torch.stack((both, first), dim=1), dim=0)
    assert len(pairs) == int(both.max()) + 1


def test_ours_finds_the_signs_of_aligned_journeys(aligned: World):
    sigma = torch.full((3,), 0.1, dtype=torch.float64)
    found = cluster_signs(aligned.crowd.signs, SignClusterConfig(), shift_sigma=sigma)
    precision, recall = pair_scores(aligned, found.label)
    assert precision > 0.99
    assert recall > 0.97


@pytest.mark.parametrize("config", [PAPER, SignClusterConfig()], ids=["paper2017", "joint"])
def test_clusters_do_not_depend_on_row_order(aligned: World, config: SignClusterConfig):
    other, order = shuffled(aligned, seed=4)
    a = cluster_signs(aligned.crowd.signs, config).label
    b = cluster_signs(other.crowd.signs, config).label
    assert same_partition(a[order], b)


def test_spectrum_starts_with_a_zero_for_every_component(aligned: World):
    spectrum = cluster_signs(aligned.crowd.signs, PAPER).spectra[0]
    values = spectrum.eigenvalues
    assert len(values) == len(aligned.crowd.signs)
    assert (values[1:] >= values[:-1]).all()
    posts = int(aligned.post.max()) + 1
    # Posts are 20 m apart and more, out of reach at d_c = 4 m.
    assert int((values < 1e-9).sum()) >= posts


def test_unknown_method_is_refused():
    with pytest.raises(ValueError, match="method: expected one of"):
        SignClusterConfig(method="dbscan")


def copies(n: int, noise: float = 0.0, seed: int = 0) -> tuple[Signs, torch.Tensor]:
    """One inverted triangle as n journeys triangulate it, and its true corners."""
    g = torch.Generator().manual_seed(seed)
    z = torch.tensor([-1.0, 0.2, 0.05], dtype=torch.float64)
    T, size, _ = polygon.canonical_with_shift(
        _pose(torch.tensor([[10.0, -4.0, 3.0]]).double(), z[None]),
        torch.tensor([[0.9, 0.7]]).double(),
        torch.tensor([polygon.INVERTED_TRIANGLE]),
    )
    xi = noise * torch.randn(n, 6, generator=g, dtype=torch.float64)
    one = torch.ones(n, dtype=torch.int64)
    signs = Signs(
        shape=one * polygon.INVERTED_TRIANGLE,
        type=one * 3,
        T_world_sign=se3.retract(T.expand(n, 4, 4), xi),
        size=size * (1 + 0.3 * noise * torch.randn(n, 2, generator=g, dtype=torch.float64)),
        covariance=0.01 * torch.eye(3).double().expand(n, 3, 3),
        journey=torch.arange(n),
        tracklet=0 * one,
        frame=0 * one,
        n_journeys=one,
        n_observations=10 * one,
        first_seen_ns=100 + torch.arange(n),
        last_seen_ns=200 + torch.arange(n),
        confidence=one.double(),
    )
    truth = se3.transform(T[:, None], polygon.corners(signs.shape[:1], size))
    return signs, truth[0]


def _pose(center: torch.Tensor, normal: torch.Tensor) -> torch.Tensor:
    z = torch.nn.functional.normalize(normal, dim=1)
    up = torch.tensor([[0.0, 0.0, 1.0]]).double()
    x = torch.nn.functional.normalize(torch.linalg.cross(up.expand_as(z), z), dim=1)
    return se3.make(torch.stack((x, torch.linalg.cross(z, x), z), dim=2), center)


@pytest.mark.parametrize("method", ["paper2017", "joint"])
def test_head_of_equal_signs_is_that_sign(method: str):
    signs, truth = copies(5)
    head = sign_heads(signs, torch.zeros(5, dtype=torch.int64), method=method)
    # A closed-form fit of exact corners.
    assert torch.allclose(head.corners_world[0], truth, atol=1e-7)
    assert int(head.n_journeys) == 5
    assert int(head.n_observations) == 50
    assert (int(head.first_seen_ns), int(head.last_seen_ns)) == (100, 204)
    assert (head.type == 3).all()
    assert (head.journey == -1).all()


def test_paper_head_is_the_mean_of_corners():
    signs, _ = copies(7, noise=0.05)
    head = sign_heads(signs, torch.zeros(7, dtype=torch.int64), method="paper2017")
    mean = signs.corners_world[:, :3].mean(0)
    # Refitted to a symmetric triangle: the mean of turned triangles is one to second order.
    assert (head.corners_world[0, :3] - mean).norm(dim=1).max() < 0.01
    assert torch.allclose(head.center_world[0], mean.mean(0), atol=1e-9)


def test_our_head_ignores_an_outlier():
    signs, truth = copies(9, noise=0.02)
    offset = torch.zeros(9, 3, dtype=torch.float64)
    offset[4, 0] = 2.5
    heads = [
        sign_heads(moved(signs, offset), torch.zeros(9, dtype=torch.int64), method=m)
        for m in ("joint", "paper2017")
    ]
    errors = [(h.corners_world[0, :3] - truth[:3]).norm(dim=1).mean() for h in heads]
    # Eight signs with 2 cm of noise, against a ninth of 2.5 m.
    assert errors[0] < 0.03
    assert errors[1] > 0.2


def test_a_sign_without_weight_has_no_say():
    signs, _ = copies(4, noise=0.02)
    offset = torch.zeros(4, 3, dtype=torch.float64)
    offset[0, 1] = 0.3
    weight = torch.tensor([0.0, 1, 1, 1]).double()
    label = torch.zeros(4, dtype=torch.int64)
    without = sign_heads(signs[torch.arange(1, 4)], label[1:])
    with_it = sign_heads(moved(signs, offset), label, weight=weight)
    assert torch.allclose(without.center_world, with_it.center_world, atol=1e-5)


def test_the_most_frequent_shape_wins_and_corner_order_does_not_matter():
    signs, truth = copies(5)
    shape = signs.shape.clone()
    shape[1] = polygon.RECTANGLE
    head = sign_heads(replace(signs, shape=shape), torch.zeros(5, dtype=torch.int64))
    assert int(head.shape) == polygon.INVERTED_TRIANGLE
    # The rectangle's box sits a little off the triangle's corners; its centre counts.
    assert (head.corners_world[0, :3] - truth[:3]).norm(dim=1).max() < 0.02


def test_no_signs_have_no_heads():
    signs, _ = copies(3)
    empty = signs[torch.zeros(0, dtype=torch.int64)]
    found = cluster_signs(empty, SignClusterConfig())
    assert found.count == 0
    assert len(sign_heads(empty, found.label)) == 0
    assert cluster_signs(empty, PAPER).count == 0
