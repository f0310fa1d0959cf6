"""Graphs: rows, components and parts, beside networks that are looked at node by node."""

from __future__ import annotations

import pytest
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components as scipy_components
from torch import Tensor
from worlds.graphs import KINDS, path, scattered

from crowdmap_torch.clustering.graph import connected_components, parts, symmetric_graph


def components(edge: Tensor, n: int) -> Tensor:
    """Components of the graph with these edges."""
    graph = symmetric_graph(edge, torch.ones(len(edge)).double(), n)
    return connected_components(graph.row, graph.column, n)


@pytest.mark.parametrize("edges", [0, 60, 150, 400])
def test_components_are_those_of_scipy(edges: int):
    g = torch.Generator().manual_seed(edges)
    n = 300
    edge = torch.randint(n, (edges, 2), generator=g).unique(dim=0)
    ones = torch.ones(len(edge))
    matrix = coo_matrix((ones.numpy(), tuple(edge.T.numpy())), shape=(n, n))
    expected = scipy_components(matrix, directed=False)[1]
    assert components(edge, n).tolist() == expected.tolist()


def test_a_long_path_in_any_order_is_one_component():
    edge, _, n = path(5000)
    order = torch.randperm(n, generator=torch.Generator().manual_seed(0))
    assert not components(order[edge], n).any()
    assert components(order[edge[edge[:, 0] != 2500]], n).unique().tolist() == [0, 1]


def test_no_node_and_one_node_are_graphs():
    none = torch.zeros(0, 2, dtype=torch.int64)
    assert components(none, 0).tolist() == []
    assert components(none, 1).tolist() == [0]
    assert list(parts(symmetric_graph(none, torch.zeros(0), 0), none[:, 0])) == []


@pytest.mark.parametrize("kind", KINDS)
def test_degrees_are_sums_over_rows(kind: str):
    edge, similarity, n = KINDS[kind]()
    graph = symmetric_graph(edge, similarity, n)
    dense = torch.eye(n, dtype=torch.float64)
    dense[edge[:, 0], edge[:, 1]] = dense[edge[:, 1], edge[:, 0]] = similarity
    assert torch.allclose(graph.degree(), dense.sum(1), rtol=1e-14)
    assert len(graph.row) == int((dense != 0).sum())


def test_edges_of_zero_are_none():
    edge = torch.tensor([[0, 1], [1, 2], [2, 2]])
    graph = symmetric_graph(edge, torch.tensor([0.0, 0.5, 0.3]).double(), 3)
    assert graph.row.tolist() == [0, 1, 1, 2, 2]
    assert graph.column.tolist() == [0, 1, 2, 1, 2]
    assert graph.weight.tolist() == [1, 1, 0.5, 0.5, 1]


def test_parts_are_what_is_within_each_label():
    edge, similarity, n = scattered(60, 6)
    graph = symmetric_graph(edge, similarity, n)
    label = torch.arange(n) % 4 - 1
    dense = torch.zeros(n, n, dtype=torch.float64)
    dense[graph.row, graph.column] = graph.weight
    for number, part in enumerate(parts(graph, label)):
        nodes = torch.nonzero(label == number)[:, 0]
        assert torch.equal(part.node, nodes)
        own = torch.zeros(len(nodes), len(nodes), dtype=torch.float64)
        own[part.row, part.column] = part.weight
        assert torch.equal(own, dense[nodes][:, nodes])
        # Sorted, as products by rows need it.
        assert (part.row * n + part.column).diff().min() > 0
