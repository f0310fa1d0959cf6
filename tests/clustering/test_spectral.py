"""Spectral clustering of sparse graphs: the same as dense, piece by piece, whatever the order of the rows."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from worlds.partitions import same_partition

from crowdmap_torch.clustering import spectral
from crowdmap_torch.clustering.neighbours import near_pairs
from crowdmap_torch.clustering.spectral import SpectralConfig, cluster_graph


def blobs(centers: Tensor, members: int, sigma: float, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Points about centres, and the centre of each."""
    g = torch.Generator().manual_seed(seed)
    owner = torch.arange(len(centers)).repeat_interleave(members)
    noise = torch.randn(len(owner), centers.shape[1], generator=g, dtype=torch.float64)
    order = torch.randperm(len(owner), generator=g)
    return (centers[owner] + sigma * noise)[order], owner[order]


def gaussian_graph(point: Tensor, scale: float, radius: float) -> tuple[Tensor, Tensor]:
    """Pairs within a radius and their similarity."""
    edge = near_pairs(point, radius=radius, count=len(point))
    distance = (point[edge[:, 0]] - point[edge[:, 1]]).norm(dim=1)
    return edge, torch.exp(-0.5 * (distance / scale) ** 2)


def dense(edge: Tensor, similarity: Tensor, n: int) -> Tensor:
    """The similarity matrix of a graph, ones on its diagonal."""
    S = torch.eye(n, dtype=torch.float64)
    S[edge[:, 0], edge[:, 1]] = similarity
    S[edge[:, 1], edge[:, 0]] = similarity
    return S


@pytest.fixture
def street() -> tuple[Tensor, Tensor]:
    """Three posts far apart with one, two and three signs."""
    rows = [(0, 0, 2), (50, 0, 2), (50, 0, 3.5), (100, 0, 2), (100, 0, 3.5), (100, 0, 5)]
    return blobs(torch.tensor(rows, dtype=torch.float64), members=9, sigma=0.12)


def test_perfect_clusters_have_as_many_zero_eigenvalues():
    S = torch.block_diag(*(torch.ones(k, k, dtype=torch.float64) for k in (3, 1, 4)))
    values = torch.linalg.eigvalsh(spectral.normalized_laplacian(S))
    # Rounding of a decomposition of an 8 x 8 matrix of ones.
    assert torch.allclose(values, torch.tensor([0.0] * 3 + [1.0] * 5).double(), atol=1e-12)
    assert int(spectral.eigengap(values, torch.tensor(8))) == 3


def test_eigengap_can_say_that_every_node_is_alone():
    values = torch.tensor([0.0, 0.01, 0.02, 4.0, 4.0]).double()
    assert int(spectral.eigengap(values, torch.tensor(3))) == 3


def test_two_nodes_are_one_cluster_when_they_are_similar():
    edge = torch.tensor([[0, 1]])
    counts = [
        cluster_graph(edge, torch.tensor([s]).double(), 2, SpectralConfig()).count
        for s in (0.5, 0.2)
    ]
    assert counts == [1, 2]


@pytest.mark.parametrize("labels", spectral.LABEL_METHODS)
def test_signs_on_posts_are_told_apart(street: tuple[Tensor, Tensor], labels: str):
    point, owner = street
    found = cluster_graph(
        *gaussian_graph(point, 0.5, 4.0), len(point), SpectralConfig(labels=labels)
    )
    assert same_partition(found.label, owner)
    assert found.count == 6


def test_sparse_batches_are_identical_to_the_dense_computation(street: tuple[Tensor, Tensor]):
    point, _ = street
    edge, similarity = gaussian_graph(point, 0.6, 4.0)
    found = cluster_graph(edge, similarity, len(point), SpectralConfig())
    laplacian = spectral.normalized_laplacian(dense(edge, similarity, len(point)))
    # A decomposition of the whole matrix at once rounds differently in the last digits.
    assert torch.allclose(found.eigenvalues, torch.linalg.eigvalsh(laplacian), atol=1e-10)
    for c in found.component.unique():
        nodes = torch.nonzero(found.component == c)[:, 0]
        values, vectors = torch.linalg.eigh(laplacian[nodes][:, nodes])
        count = int(spectral.eigengap(values, torch.tensor(len(nodes))))
        alone = spectral.kmeans_labels(vectors[:, :count], restarts=0, generator=None)
        assert same_partition(found.label[nodes], alone)


def test_large_components_are_decomposed_like_small_ones():
    point, owner = blobs(torch.eye(3, dtype=torch.float64) * 3, members=60, sigma=0.4)
    graph = gaussian_graph(point, 1.0, 8.0)
    whole = cluster_graph(*graph, len(point), SpectralConfig(dense_limit=1000))
    leading = cluster_graph(*graph, len(point), SpectralConfig(dense_limit=50, leading=12))
    assert same_partition(whole.label, leading.label)
    assert same_partition(whole.label, owner)
    # Both solvers work to about 1e-8.
    assert torch.allclose(leading.eigenvalues, whole.eigenvalues[:12], atol=1e-7)


def test_a_component_with_too_many_clusters_is_cut_by_its_graph():
    centers = torch.arange(0, 40.0, 1.0).double()[:, None] * torch.tensor([[1.0, 0, 0]]).double()
    point, owner = blobs(centers, members=8, sigma=0.03)
    config = SpectralConfig(dense_limit=60, leading=8, cut_below=0.2)
    found = cluster_graph(*gaussian_graph(point, 0.3, 1.4), len(point), config)
    assert found.component.unique().numel() > 1
    assert same_partition(found.label, owner)


def test_partition_does_not_depend_on_row_order(street: tuple[Tensor, Tensor]):
    point, _ = street
    order = torch.randperm(len(point), generator=torch.Generator().manual_seed(3))
    a, b = (
        cluster_graph(*gaussian_graph(p, 0.6, 4.0), len(p), SpectralConfig()).label
        for p in (point, point[order])
    )
    assert same_partition(a[order], b)


def test_eigenvectors_are_free_in_sign(street: tuple[Tensor, Tensor]):
    point, _ = street
    edge, similarity = gaussian_graph(point, 0.6, 1000.0)
    S = dense(edge, similarity, len(point)) + 1e-3
    _, vectors = torch.linalg.eigh(spectral.normalized_laplacian(S))
    flipped = vectors[:, :6] * torch.tensor([1.0, -1, 1, -1, -1, 1])
    for label in (
        spectral.sign_code_labels,
        lambda v: spectral.kmeans_labels(v, restarts=0, generator=None),
    ):
        assert same_partition(label(vectors[:, :6]), label(flipped))


def test_same_generator_gives_the_same_clusters():
    g = torch.Generator().manual_seed(1)
    point = torch.rand(60, 2, generator=g, dtype=torch.float64) * 5
    graph = gaussian_graph(point, 0.7, 3.0)
    config = SpectralConfig()
    labels = [
        cluster_graph(*graph, 60, config, generator=torch.Generator().manual_seed(5)).label
        for _ in range(2)
    ]
    assert torch.equal(*labels)


def test_nodes_without_edges_are_clusters_of_their_own():
    none = torch.zeros(0, 2, dtype=torch.int64)
    found = cluster_graph(none, torch.zeros(0).double(), 4, SpectralConfig())
    assert found.label.tolist() == [0, 1, 2, 3]
    assert cluster_graph(none, torch.zeros(0).double(), 0, SpectralConfig()).count == 0


def test_unknown_way_to_label_is_refused():
    with pytest.raises(ValueError, match="labels: expected one of"):
        SpectralConfig(labels="median")


def test_rows_without_a_label_get_one_of_their_own_behind_all_others():
    label = torch.tensor([1, -1, 0, -1, 1])
    assert spectral.singles_behind(label).tolist() == [1, 2, 0, 3, 1]
    assert spectral.singles_behind(torch.tensor([-1, -1])).tolist() == [0, 1]
    assert spectral.singles_behind(label[:0]).tolist() == []


def test_renumber_keeps_the_partition_and_the_pruned():
    label = torch.tensor([7, -1, 3, 7, 0])
    assert spectral.renumber(label).tolist() == [0, -1, 1, 0, 2]
