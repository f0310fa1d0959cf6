"""Weighted graphs as sorted edge lists, on the device of their edges: rows, connected components, parts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Graph:
    """Nodes that are similar to themselves by 1, and to each other as their edges say."""

    node: Int[Tensor, " n"]
    """What each node is called in the graph that this one is a part of."""
    row: Int[Tensor, " m"]
    """Edges in both directions and from each node to itself, sorted by row, then by column."""
    column: Int[Tensor, " m"]
    weight: Float[Tensor, " m"]

    @property
    def size(self) -> int:
        """The number of nodes."""
        return len(self.node)

    def degree(self) -> Float[Tensor, " n"]:
        """The sum of each node's weights, its own among them: at least 1."""
        return torch.segment_reduce(self.weight, "sum", offsets=self.offsets())

    def offsets(self) -> Int[Tensor, " _"]:
        """Where the edges of each row begin, and where the last ones end."""
        number = torch.bincount(self.row, minlength=self.size)
        return torch.cat((number.new_zeros(1), number.cumsum(0)))


def symmetric_graph(edge: Int[Tensor, "m 2"], similarity: Float[Tensor, " m"], n: int) -> Graph:
    """The graph of `n` nodes; edges of similarity zero, and from a node to itself, count for none."""
    keep = (similarity > 0) & (edge[:, 0] != edge[:, 1])
    (i, j), weight = edge[keep].T, similarity[keep].detach()
    node = torch.arange(n, device=edge.device)
    row, column = torch.cat((i, j, node)), torch.cat((j, i, node))
    order = (row * n + column).argsort(stable=True)
    weight = torch.cat((weight, weight, weight.new_ones(n)))
    return Graph(node, row[order], column[order], weight[order])


def connected_components(
    row: Int[Tensor, " m"], column: Int[Tensor, " m"], n: int
) -> Int[Tensor, " n"]:
    """The component of each node, numbered by their first nodes; edges must be there in both directions.

    Trees of parents are hooked onto smaller neighbours and flattened until none moves (FastSV: Zhang, Azad, Buluc 2020):
    about log n rounds of minima over all edges.
    """
    parent = torch.arange(n, device=row.device)
    while True:
        grand = parent[parent]
        near = grand[column]
        hooked = grand.scatter_reduce(0, parent[row], near, "amin")
        hooked = hooked.scatter_reduce(0, row, near, "amin")
        if torch.equal(hooked, parent):
            return torch.unique(parent, return_inverse=True)[1]
        parent = hooked


def parts(graph: Graph, label: Int[Tensor, " n"]) -> Iterator[Graph]:
    """The part of a graph within each label 0, 1, ...; nodes labelled -1 are in none. Nodes keep their order."""
    count = int(label.max()) + 1 if len(label) else 0
    if not count:
        return
    used = torch.nonzero(label >= 0)[:, 0]
    nodes = used[label[used].argsort(stable=True)]
    sizes = torch.bincount(label[used], minlength=count)
    inner = torch.nonzero((label[graph.row] == label[graph.column]) & (label[graph.row] >= 0))[:, 0]
    owner = label[graph.row[inner]]
    edges = inner[owner.argsort(stable=True)]
    place = torch.zeros_like(label)
    start = sizes.cumsum(0) - sizes
    place[nodes] = torch.arange(len(nodes), device=nodes.device) - start[label[nodes]]
    numbers = torch.bincount(owner, minlength=count).tolist()
    for own, edge in zip(nodes.split(sizes.tolist()), edges.split(numbers), strict=True):
        yield Graph(
            graph.node[own], place[graph.row[edge]], place[graph.column[edge]], graph.weight[edge]
        )
