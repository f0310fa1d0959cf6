"""Graphs whose spectra are degenerate, crowded or nearly so: edges, similarities and the number of nodes."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Edges = tuple[Tensor, Tensor, int]


def clique(n: int) -> Edges:
    """All similar by 1: eigenvalues 0 and, n - 1 times, 1."""
    edge = torch.combinations(torch.arange(n))
    return edge, torch.ones(len(edge)).double(), n


def star(n: int) -> Edges:
    """One node similar to all others."""
    edge = torch.stack((torch.zeros(n - 1).long(), torch.arange(1, n)), dim=1)
    return edge, torch.linspace(0.2, 1, n - 1).double(), n


def path(n: int) -> Edges:
    """Each node similar to the next: small eigenvalues, close together."""
    edge = torch.stack((torch.arange(n - 1), torch.arange(1, n)), dim=1)
    return edge, torch.ones(n - 1).double(), n


def grid(side: int) -> Edges:
    """A square: most eigenvalues twice."""
    node = torch.arange(side * side).reshape(side, side)
    edge = torch.cat(
        (
            torch.stack((node[1:], node[:-1]), dim=2).reshape(-1, 2),
            torch.stack((node[:, 1:], node[:, :-1]), dim=2).reshape(-1, 2),
        )
    )
    return edge, torch.ones(len(edge)).double(), side * side


def cliques(count: int, size: int, *, link: float) -> Edges:
    """Cliques in a ring, each node of one as similar as `link` to a node of the next."""
    inner, weight, _ = clique(size)
    edge = [inner + k * size for k in range(count)]
    here = torch.arange(count * size)
    edge.append(torch.stack((here, (here + size) % (count * size)), dim=1))
    similarity = torch.cat((weight.repeat(count), weight.new_full((count * size,), link)))
    return torch.cat(edge), similarity, count * size


def hub(count: int, size: int, *, link: float) -> Edges:
    """One node and as many equal cliques about it: an eigenvalue `count` - 1 times."""
    inner, weight, _ = clique(size)
    edge = [1 + inner + k * size for k in range(count)]
    spokes, _, n = star(1 + count * size)
    similarity = torch.cat((weight.repeat(count), weight.new_full((n - 1,), link)))
    return torch.cat((*edge, spokes)), similarity, n


def scattered(n: int, degree: int) -> Edges:
    """Pairs at random: no clusters, a crowded spectrum behind the first eigenvalue."""
    g = torch.Generator().manual_seed(0)
    edge = torch.randint(n, (n * degree // 2, 2), generator=g).sort(dim=1).values
    edge = torch.unique(edge[edge[:, 0] != edge[:, 1]], dim=0)
    ring = torch.stack((torch.zeros(n - 1).long(), torch.arange(1, n)), dim=1)
    edge = torch.unique(torch.cat((edge, ring[::10])), dim=0)
    return edge, torch.rand(len(edge), generator=g, dtype=torch.float64), n


KINDS: dict[str, Callable[[], Edges]] = {
    "clique": lambda: clique(240),
    "star": lambda: star(300),
    "path": lambda: path(300),
    "grid": lambda: grid(18),
    "cliques": lambda: cliques(12, 20, link=0.01),
    "hardly connected cliques": lambda: cliques(12, 20, link=1e-9),
    "cliques connected by next to nothing": lambda: cliques(12, 20, link=1e-300),
    "equal pieces, more than the block": lambda: hub(60, 5, link=0.5),
    "equal pieces, weakly tied": lambda: hub(60, 5, link=0.01),
    "scattered": lambda: scattered(400, 8),
}
