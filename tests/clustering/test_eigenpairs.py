"""The first eigenpairs of large graphs: those of a dense decomposition, however degenerate the spectrum is."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from worlds.graphs import KINDS, Edges, cliques, grid, path, scattered
from worlds.pretend_device import DEVICE, pretend_device

from crowdmap_torch.clustering import eigenpairs
from crowdmap_torch.clustering.eigenpairs import leading_eigenpairs
from crowdmap_torch.clustering.graph import Graph, symmetric_graph
from crowdmap_torch.clustering.spectral import SpectralConfig, cluster_graph, normalized_laplacian

COUNT = 20
EQUAL_GAPS = ("clique", "star", "cliques connected by next to nothing")
"""Kinds of graphs whose widest gap is as wide as rounding says."""
EQUAL_CUTS = ("equal pieces, weakly tied",)
"""Kinds of graphs whose second eigenvalue is there several times: which of the equal cuts is made, rounding says."""


def laplacian(graph: Graph) -> Tensor:
    """The normalised Laplacian, dense."""
    weight = torch.zeros(graph.size, graph.size, dtype=torch.float64)
    weight[graph.row, graph.column] = graph.weight.double()
    return normalized_laplacian(weight)


@pytest.mark.parametrize("kind", KINDS)
def test_pairs_are_those_of_a_dense_decomposition(kind: str):
    graph = symmetric_graph(*KINDS[kind]())
    assert graph.size > 3 * (COUNT + 16)  # below, it is decomposed whole
    found = leading_eigenpairs(graph, COUNT, crowded_below=0)
    dense = laplacian(graph)
    expected = torch.linalg.eigvalsh(dense)[:COUNT]
    # Behind the gap: as long as residuals may be; in a crowd one eigenvalue may stand for the next.
    assert torch.allclose(found.values, expected, rtol=0, atol=2e-4)
    # Before the gap an eigenvalue errs by the square of its vector's residual over the gap, and by rounding.
    exact = found.vectors.shape[1]
    assert torch.allclose(found.values[:exact], expected[:exact], rtol=0, atol=1e-12)
    residual = dense @ found.vectors - found.values[:exact] * found.vectors
    assert residual.norm(dim=0).max() <= 1.1e-8
    inner = found.vectors.T @ found.vectors
    assert torch.allclose(inner, torch.eye(exact).double(), rtol=0, atol=1e-10)
    assert not found.crowded
    assert exact == int(expected.diff().argmax()) + 1 or kind in EQUAL_GAPS


@pytest.mark.parametrize("link", [1e-2, 1e-4, 1e-6])
def test_a_crowd_behind_the_gap_does_not_hold_up_the_vectors_before_it(
    link: float, monkeypatch: pytest.MonkeyPatch
):
    # Behind twelve clusters come 228 eigenvalues within a few times `link`.
    monkeypatch.setattr(eigenpairs, "_MOST_ROUNDS", 40)
    graph = symmetric_graph(*cliques(12, 20, link=link))
    found = leading_eigenpairs(graph, COUNT, crowded_below=0)
    assert found.vectors.shape[1] == 12
    expected = torch.linalg.eigvalsh(laplacian(graph))[:COUNT]
    assert torch.allclose(found.values, expected, rtol=0, atol=2e-4)


@pytest.mark.parametrize("n", [1, 2, 3, 40])
def test_small_graphs_are_decomposed_whole(n: int):
    graph = symmetric_graph(*path(n))
    found = leading_eigenpairs(graph, COUNT, crowded_below=0)
    expected = torch.linalg.eigvalsh(laplacian(graph))[:COUNT]
    assert torch.allclose(found.values, expected, rtol=0, atol=1e-12)


def test_two_vectors_are_exact_where_all_are_crowded():
    graph = symmetric_graph(*path(3000))
    found = leading_eigenpairs(graph, COUNT, crowded_below=0.02)
    assert found.crowded and found.values[-1] < 0.02
    # Applied to the two vectors row by row: too large to be dense.
    vectors = found.vectors
    assert vectors.shape == (3000, 2)
    root = graph.degree().rsqrt()
    scaled = root[graph.row] * graph.weight * root[graph.column]
    applied = vectors.index_add(0, graph.row, -scaled[:, None] * vectors[graph.column])
    assert (applied - found.values[:2] * vectors).norm(dim=0).max() <= 1.1e-8
    # One change of sign along the path: the Fiedler vector cuts it in the middle.
    assert int((vectors[:, 1] >= 0).diff().sum()) == 1
    assert abs(int((vectors[:, 1] >= 0).sum()) - 1500) <= 1


def test_the_same_graph_gives_the_same_bits():
    graph = symmetric_graph(*grid(18))
    one, two = (leading_eigenpairs(graph, COUNT, crowded_below=0) for _ in range(2))
    assert torch.equal(one.values, two.values) and torch.equal(one.vectors, two.vectors)


def test_single_precision_comes_to_its_own_rounding():
    edge, similarity, n = scattered(400, 8)
    graph = symmetric_graph(edge, similarity.float(), n)
    found = leading_eigenpairs(graph, COUNT, crowded_below=0)
    assert found.values.dtype == torch.float32
    expected = torch.linalg.eigvalsh(laplacian(graph))[:COUNT]
    # Fifty units in the last place.
    assert torch.allclose(found.values.double(), expected, rtol=0, atol=6e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_what_does_not_converge_is_decomposed_whole(kind: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(eigenpairs, "_MOST_ROUNDS", 1)
    graph = symmetric_graph(*KINDS[kind]())
    found = leading_eigenpairs(graph, COUNT, crowded_below=0)
    expected = torch.linalg.eigvalsh(laplacian(graph))[:COUNT]
    # One round is enough for a clique alone, whose spectrum has one value behind the first.
    assert torch.allclose(found.values, expected, rtol=0, atol=1e-10)


def cut_short(monkeypatch: pytest.MonkeyPatch, *, rounds: int, last_whole: int) -> list[int]:
    """Few rounds, and no graph small enough to be decomposed at once; the widths that are tried."""
    widths: list[int] = []
    iterated = eigenpairs._iterated

    def counted(graph: Graph, product: eigenpairs.Product, count: int, width: int, below: float):
        widths.append(width)
        return iterated(graph, product, count, width, below)

    monkeypatch.setattr(eigenpairs, "_iterated", counted)
    monkeypatch.setattr(eigenpairs, "_MOST_ROUNDS", rounds)
    monkeypatch.setattr(eigenpairs, "_SOON_WHOLE", 0)
    monkeypatch.setattr(eigenpairs, "_LAST_WHOLE", last_whole)
    return widths


def test_a_wider_block_converges_where_a_narrow_one_does_not(monkeypatch: pytest.MonkeyPatch):
    # Behind twelve clusters come 228 eigenvalues close together: blocks of 36 and 84 are in their midst, one of 240 is not.
    widths = cut_short(monkeypatch, rounds=4, last_whole=0)
    graph = symmetric_graph(*KINDS["cliques"]())
    found = leading_eigenpairs(graph, COUNT, crowded_below=0)
    assert found.miss == 0
    assert widths == [COUNT + 16, COUNT + 4 * 16, COUNT + 16 * 16]
    expected = torch.linalg.eigvalsh(laplacian(graph))[:COUNT]
    assert torch.allclose(found.values, expected, rtol=0, atol=2e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_the_best_vectors_of_a_graph_too_large_are_orthonormal_and_near(
    kind: str, monkeypatch: pytest.MonkeyPatch
):
    cut_short(monkeypatch, rounds=2, last_whole=0)
    graph = symmetric_graph(*KINDS[kind]())
    found = leading_eigenpairs(graph, COUNT, crowded_below=0)
    assert found.values.isfinite().all() and bool((found.values.diff() >= 0).all())
    width = found.vectors.shape[1]
    inner = found.vectors.T @ found.vectors
    assert torch.allclose(inner, torch.eye(width).double(), rtol=0, atol=1e-10)
    # How far they are from being eigenvectors is told, where one of them is further than was asked for.
    residual = laplacian(graph) @ found.vectors - found.values[:width] * found.vectors
    assert found.miss == 0 or found.miss >= residual.norm(dim=0).max() - 1e-12
    assert found.miss > 0 or residual.norm(dim=0).max() <= 1.1e-8
    # Ritz values are no smaller than the eigenvalues.
    expected = torch.linalg.eigvalsh(laplacian(graph))[:COUNT]
    assert bool((found.values >= expected - 1e-10).all())


@pytest.mark.parametrize("last_whole", [0, 1 << 13])
def test_clusters_are_found_though_no_iteration_converges(
    last_whole: int, monkeypatch: pytest.MonkeyPatch
):
    config = SpectralConfig(dense_limit=60, leading=COUNT, cut_below=1e-6)
    graphs = parted(KINDS["cliques"](), KINDS["clique"](), path(1), path(2))
    expected = cluster_graph(*graphs, config)
    assert expected.count == 12 + 1 + 1 + 1
    widths = cut_short(monkeypatch, rounds=2, last_whole=last_whole)
    found = cluster_graph(*graphs, config)
    assert len(widths) > 2
    assert torch.equal(found.label, expected.label)


@pytest.mark.parametrize(("last_whole", "is_told"), [(0, True), (1 << 13, False)])
def test_clusters_say_how_far_eigenpairs_are_from_their_tolerance(
    last_whole: int, is_told: bool, monkeypatch: pytest.MonkeyPatch
):
    config = SpectralConfig(dense_limit=60, leading=COUNT, cut_below=1e-6)
    cut_short(monkeypatch, rounds=1, last_whole=last_whole)
    found = cluster_graph(*KINDS["scattered"](), config)
    # One round of 500: eigenvalues err by hundredths.
    assert found.miss > 1e-3 if is_told else found.miss == 0


@pytest.mark.parametrize(
    "kind", ["hardly connected cliques", "equal pieces, weakly tied", "scattered"]
)
def test_a_device_gives_the_same_clusters(kind: str):
    edge, similarity, n = KINDS[kind]()
    config = SpectralConfig(dense_limit=60, leading=COUNT, cut_below=0.02)
    here = cluster_graph(edge, similarity, n, config)
    with pretend_device() as transfers:
        there = cluster_graph(edge.to(DEVICE), similarity.to(DEVICE), n, config)
        assert there.label.is_cuda and there.component.is_cuda
        assert torch.equal(there.label.cpu(), here.label)
        components, eigenvalues = there.component.cpu(), there.eigenvalues.cpu()
        # The matrix stays there: what comes back are labels, spectra and the vectors that k-means reads.
        assert all(len(shape) == 1 or shape[-1] <= 60 for shape in transfers.back)
    if kind not in EQUAL_CUTS:
        assert torch.equal(components, here.component)
        # Sums over segments and the CPU's rows add in their own order.
        assert torch.allclose(eigenvalues, here.eigenvalues, rtol=0, atol=1e-12)
    for component in (here.component, components):
        # No cut divides a cluster.
        assert torch.unique(torch.stack((here.label, component)), dim=1).shape[1] == here.count


def parted(*graphs: Edges) -> Edges:
    """Several graphs as one that is not connected, their nodes dealt out in turn."""
    offset, edge, similarity = 0, [], []
    for e, s, n in graphs:
        edge.append(e + offset)
        similarity.append(s)
        offset += n
    order = torch.randperm(offset, generator=torch.Generator().manual_seed(1))
    return order[torch.cat(edge)], torch.cat(similarity), offset


def test_components_are_clustered_as_if_they_were_alone():
    alone = [KINDS[kind]() for kind in ("clique", "star", "cliques")]
    config = SpectralConfig(dense_limit=60, leading=COUNT, cut_below=1e-6)
    counts = [cluster_graph(*g, config).count for g in alone]
    assert counts[0] == 1 and counts[2] == 12
    together = cluster_graph(*parted(*alone, path(1), path(2)), config)
    assert together.component.unique().numel() == 5
    assert together.count == sum(counts) + 2
