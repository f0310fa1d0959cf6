"""Spectral clustering of a sparse similarity graph, component by component (V-A; von Luxburg 2007).

Nothing is ever dense over the whole graph. Connected components are independent, so each has its own Laplacian and its
own eigenvalue gap: small ones are padded to common sizes and decomposed in batches, large ones through their leading
eigenpairs only, and a large one with more clusters than those can tell is first cut in two along its Fiedler vector.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.eigenpairs import leading_eigenpairs
from crowdmap_torch.clustering.graph import Graph, connected_components, parts, symmetric_graph
from crowdmap_torch.ranges import Count, Range, RoundsOrNone, Settings, Share

LABEL_METHODS = ("kmeans", "sign_code")

_PADDING = 4.0
"""Diagonal of padded rows: beyond the spectrum of a normalised Laplacian, which ends at 2."""
_BATCH_ELEMENTS = 1 << 23
"""Matrix elements decomposed at once (64 MiB in float64)."""


@dataclass(frozen=True)
class SpectralConfig(Settings):
    """How a similarity graph is cut into clusters."""

    labels: str = "kmeans"
    """`kmeans` on the rows of the eigenvectors, or `sign_code`: the signs of a row's entries are its cluster's code."""
    restarts: RoundsOrNone = 3
    """Further k-means runs with random seeds, beside the one started from the most orthogonal rows."""
    dense_limit: Count = 256
    """Components up to this many nodes are decomposed whole; above, only the leading eigenpairs are computed."""
    leading: Annotated[int, Range(2, 10**4, "eigenpairs: the first alone says nothing")] = 48
    """Eigenpairs computed of larger components; those up to as many nodes are decomposed whole too."""
    cut_below: Share = 0.02
    """A larger component is cut in two while even its last leading eigenvalue is below this: too many."""

    def __post_init__(self) -> None:
        """Refuses an unknown way to label."""
        super().__post_init__()
        if self.labels not in LABEL_METHODS:
            raise ValueError(f"labels: expected one of {LABEL_METHODS}, found {self.labels!r}")

    @property
    def whole_limit(self) -> int:
        """Most nodes of a component that is decomposed whole."""
        return max(self.dense_limit, self.leading)


@dataclass(frozen=True)
class SpectralClusters:
    """Clusters of the nodes of a graph, and the spectrum they were read from."""

    label: Int[Tensor, " n"]
    """Cluster of each node, 0 .. count - 1, numbered by their first node."""
    count: int
    component: Int[Tensor, " n"]
    """Piece of the graph that was decomposed as one."""
    eigenvalues: Float[Tensor, " m"]
    """Of the normalised Laplacians of all pieces, ascending; of large pieces the leading ones."""
    miss: float
    """Largest residual of eigenpairs, where one did not come to its tolerance; else 0."""


def normalized_laplacian(similarity: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch n n"]:
    """`I - D^-1/2 S D^-1/2`; degrees must be positive, as they are when nodes are similar to themselves."""
    root = similarity.sum(-1).rsqrt()
    return (
        torch.eye(similarity.shape[-1]).to(similarity)
        - root[..., None] * similarity * root[..., None, :]
    )


def eigengap(
    eigenvalues: Float[Tensor, "*batch n"], size: Int[Tensor, " *batch"]
) -> Int[Tensor, " *batch"]:
    """The number of clusters: where the ascending eigenvalues of a normalised Laplacian jump most.

    Only the first `size` eigenvalues count. P perfect clusters have P zeros followed by ones, so a one is thought
    behind the last eigenvalue: `size` clusters of one node each are an answer too.
    """
    after = torch.cat((eigenvalues[..., 1:], torch.ones_like(eigenvalues[..., :1])), dim=-1)
    rank = torch.arange(eigenvalues.shape[-1], device=eigenvalues.device)
    is_last = rank == size[..., None] - 1
    gap = torch.where(is_last, torch.ones_like(after), after) - eigenvalues
    return gap.masked_fill(rank >= size[..., None], -torch.inf).argmax(-1) + 1


def kmeans_labels(
    vectors: Float[Tensor, "n k"], *, restarts: int, generator: torch.Generator | None
) -> Int[Tensor, " n"]:
    """K-means on the rows of the first k eigenvectors, scaled to unit length (Ng, Jordan, Weiss 2001).

    Rows of one cluster are parallel and rows of different clusters orthogonal in the ideal case, whatever the sign or
    the rotation of the eigenvectors; the first run starts from rows chosen to be as orthogonal as can be.
    """
    count = vectors.shape[1]
    if count == 1:
        return torch.zeros_like(vectors[:, 0], dtype=torch.int64)
    if count == len(vectors):
        return torch.arange(count, device=vectors.device)
    rows = torch.nn.functional.normalize(vectors, dim=1).detach().cpu().numpy()
    start = rows[_orthogonal_rows(rows, count)]
    label, misfit = _kmeans(rows, n_clusters=count, init=start, n_init=1)
    if restarts and misfit > 1e-3 * len(rows):
        seed = int(torch.randint(2**31 - 1, (), generator=generator))
        other, misfit_of_other = _kmeans(rows, n_clusters=count, n_init=restarts, random_state=seed)
        label = other if misfit_of_other < misfit else label
    return torch.from_numpy(label.astype(np.int64)).to(vectors.device)


def _kmeans(rows: np.ndarray, **options: Any) -> tuple[np.ndarray, float]:
    """Labels, and the sum of squared distances to the clusters' means."""
    # A third of a second, which every process would wait for; only the paper's clustering needs it.
    from sklearn.cluster import KMeans

    found = KMeans(**options).fit(rows)
    return np.asarray(found.labels_), float(np.asarray(found.inertia_))


def sign_code_labels(vectors: Float[Tensor, "n k"]) -> Int[Tensor, " n"]:
    """Nodes whose rows of the eigenvectors have the same signs are one cluster (V-A: a cluster's binary code)."""
    _, label = torch.unique(vectors >= 0, dim=0, return_inverse=True)
    return label


def cluster_graph(
    edge: Int[Tensor, "m 2"],
    similarity: Float[Tensor, " m"],
    n: int,
    config: SpectralConfig,
    *,
    generator: torch.Generator | None = None,
    whole: Int[Tensor, " n"] | None = None,
) -> SpectralClusters:
    """Clusters of the `n` nodes of a graph with symmetric similarities in (0, 1] on its edges (V-A).

    Each pair of nodes may appear once, in either order; a node is similar to itself by 1. Edges of similarity zero are
    no edges. The number of clusters of each connected component comes from the gap of its own eigenvalues; or, with
    `whole`, from the one gap of all components whose nodes have the same number there, 0 and up, as it does where a
    matrix that falls into blocks is decomposed as one.
    """
    graph = symmetric_graph(edge, similarity, n)
    piece = connected_components(graph.row, graph.column, n)
    cut = _decompose_large(graph, piece, config)
    found = [*cut.decomposed, *_decompose_small(graph, cut.piece, cut.count, config)]
    if whole is not None:
        found = _counted_together(found, whole.cpu())
    label = _labels_of(found, n, config, generator)
    eigenvalues = torch.cat([similarity[:0].cpu(), *(p.eigenvalues for p in found)]).sort().values
    return SpectralClusters(
        label=label.to(edge.device),
        count=int(label.max()) + 1 if n else 0,
        component=renumber(cut.piece),
        eigenvalues=eigenvalues.to(edge.device),
        miss=cut.miss,
    )


def singles_behind(label: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
    """Labels in which every row that has none has one of its own, behind all others."""
    if not len(label):
        return label
    is_single = label < 0
    return torch.where(is_single, int(label.max()) + is_single.cumsum(0), label)


def renumber(label: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
    """The same partition with labels 0, 1, ... in the order of their first member; negative labels stay -1."""
    used = label >= 0
    values, inverse = torch.unique(label[used], return_inverse=True)
    first = torch.full_like(values, len(label)).scatter_reduce(
        0, inverse, torch.arange(len(inverse), device=label.device), "amin"
    )
    rank = torch.empty_like(first)
    rank[first.argsort()] = torch.arange(len(first), device=label.device)
    result = torch.full_like(label, -1)
    result[used] = rank[inverse]
    return result


def _labels(
    vectors: Float[Tensor, "n k"], config: SpectralConfig, generator: torch.Generator | None
) -> Int[Tensor, " n"]:
    if config.labels == "sign_code":
        return sign_code_labels(vectors)
    return kmeans_labels(vectors, restarts=config.restarts, generator=generator)


@dataclass(frozen=True)
class _Piece:
    """A piece of a graph that was decomposed as one, on the CPU."""

    nodes: Int[Tensor, " m"]
    eigenvalues: Float[Tensor, " k"]
    """Ascending."""
    vectors: Float[Tensor, "m l"]
    count: int
    """Clusters in it, by its own gap."""


@dataclass(frozen=True)
class _Large:
    """A graph whose large components were cut and decomposed."""

    piece: Int[Tensor, " n"]
    """Of each node; some numbers have none."""
    count: int
    decomposed: list[_Piece]
    """The large ones."""
    miss: float
    """Largest residual of eigenpairs, where one did not come to its tolerance; else 0."""


def _counted_together(pieces: list[_Piece], whole: Int[Tensor, " n"]) -> list[_Piece]:
    """The pieces with as many clusters each as it has eigenvalues below the gap in those of its whole."""
    of = [int(whole[piece.nodes[0]]) for piece in pieces]
    below = {}
    for number in set(of):
        of_whole = [p.eigenvalues for p, w in zip(pieces, of, strict=True) if w == number]
        values = torch.cat(of_whole).sort().values
        below[number] = values[eigengap(values, torch.tensor(len(values))) - 1]
    counted = []
    for piece, number in zip(pieces, of, strict=True):
        # The null vector of a piece is of its own: no piece is less than one cluster. Of a large one few are known.
        count = max(int((piece.eigenvalues <= below[number]).sum()), 1)
        counted.append(replace(piece, count=min(count, piece.vectors.shape[1])))
    return counted


def _labels_of(
    pieces: list[_Piece], n: int, config: SpectralConfig, generator: torch.Generator | None
) -> Int[Tensor, " n"]:
    """Clusters of all pieces, numbered by their first node."""
    label, free = torch.zeros(n, dtype=torch.int64), 0
    for piece in pieces:
        own = _labels(piece.vectors[:, : piece.count], config, generator)
        label[piece.nodes] = free + own
        free += int(own.max()) + 1
    return renumber(label)


def _decompose_large(graph: Graph, piece: Int[Tensor, " n"], config: SpectralConfig) -> _Large:
    """Large components cut until the leading eigenpairs of what is left tell its clusters."""
    piece, most = piece.clone(), config.whole_limit
    size = torch.bincount(piece)
    pieces = len(size)
    large = list(parts(graph, renumber(piece.masked_fill(size[piece] <= most, -1))))
    found, miss = [], 0.0
    while large:
        part = large.pop()
        pairs = leading_eigenpairs(part, config.leading, crowded_below=config.cut_below)
        miss = max(miss, pairs.miss)
        if pairs.crowded:
            for half in _fiedler_cut(part, pairs.vectors):
                piece[half.node] = pieces
                pieces += 1
                if half.size > most:
                    large.append(half)
            continue
        vectors = pairs.vectors.cpu()
        found.append(_Piece(part.node.cpu(), pairs.values.cpu(), vectors, vectors.shape[1]))
    return _Large(piece, pieces, found, miss)


def _decompose_small(
    graph: Graph, piece: Int[Tensor, " n"], pieces: int, config: SpectralConfig
) -> Iterator[_Piece]:
    """The small pieces, decomposed whole in batches of like size."""
    sizes = torch.bincount(piece, minlength=pieces)
    # A number that was cut up has no nodes left.
    small = torch.nonzero((sizes > 0) & (sizes <= config.whole_limit))[:, 0]
    small = small[sizes[small].argsort(stable=True)]
    rank = torch.full_like(sizes, -1)
    rank[small] = torch.arange(len(small), device=small.device)
    batches = _Batches.of(graph, rank[piece], sizes[small])
    node, size = batches.node.cpu(), sizes[small].tolist()
    first = 0
    for start, stop in _runs(size):
        laplacian, own = batches.laplacians(start, stop)
        values, vectors = torch.linalg.eigh(laplacian)
        counts = eigengap(values, own).tolist()
        values, vectors = values.cpu(), vectors.cpu()
        for b, (n, count) in enumerate(zip(size[start:stop], counts, strict=True)):
            yield _Piece(node[first : first + n], values[b, :n], vectors[b, :n, :n], count)
            first += n


def _runs(size: list[int]) -> Iterator[tuple[int, int]]:
    """Ranges of pieces (ascending in size) whose padding stays within a quarter and whose matrices fit the batch."""
    start = 0
    while start < len(size):
        stop, widest = start, size[start] + max(1, size[start] // 4)
        while (
            stop < len(size)
            and size[stop] <= widest
            and (stop - start) * size[stop] ** 2 < _BATCH_ELEMENTS
        ):
            stop += 1
        yield start, stop
        start = stop


@dataclass(frozen=True)
class _Batches:
    """Pieces of a graph side by side, ascending in size."""

    size: Int[Tensor, " p"]
    node: Int[Tensor, " n"]
    """Nodes, piece by piece."""
    piece: Int[Tensor, " m"]
    """Piece of each edge within one, ascending."""
    row: Int[Tensor, " m"]
    """Place of its row within the piece."""
    column: Int[Tensor, " m"]
    weight: Float[Tensor, " m"]

    @staticmethod
    def of(graph: Graph, rank: Int[Tensor, " n"], size: Int[Tensor, " p"]) -> _Batches:
        """`rank` is each node's piece, -1 for none, and `size` the nodes of each."""
        node = rank.argsort(stable=True)[int((rank < 0).sum()) :]
        place = torch.zeros_like(rank)
        start = size.cumsum(0) - size
        place[node] = torch.arange(len(node), device=node.device) - start[rank[node]]
        # A piece cut out of a larger component has edges that lead out of it.
        here = rank[graph.row]
        inner = torch.nonzero((here == rank[graph.column]) & (here >= 0))[:, 0]
        inner = inner[here[inner].argsort(stable=True)]
        row, column = place[graph.row[inner]], place[graph.column[inner]]
        return _Batches(size, node, here[inner], row, column, graph.weight[inner])

    def laplacians(self, start: int, stop: int) -> tuple[Float[Tensor, "b p p"], Int[Tensor, " b"]]:
        """Normalised Laplacians of a range of pieces, and their sizes.

        Padded rows are alone, their eigenvalue lies behind all others.
        """
        size = self.size[start:stop]
        width = int(size[-1])
        low, high = torch.searchsorted(self.piece, size.new_tensor([start, stop])).tolist()
        batch, i, j = (self.piece[low:high] - start, self.row[low:high], self.column[low:high])
        dense = self.weight.new_zeros(stop - start, width, width)
        dense[batch, i, j] = self.weight[low:high]
        rank = torch.arange(width, device=size.device)
        is_padding: Bool[Tensor, "b p"] = rank >= size[:, None]
        diagonal = dense.diagonal(dim1=1, dim2=2)
        diagonal.masked_fill_(is_padding, 1)
        laplacian = normalized_laplacian(dense)
        laplacian.diagonal(dim1=1, dim2=2).masked_fill_(is_padding, _PADDING)
        return laplacian, size


def _fiedler_cut(part: Graph, vectors: Float[Tensor, "n 2"]) -> Iterator[Graph]:
    """The connected parts of a component after it was cut where its second eigenvector changes sign."""
    # The first eigenvector is known; where the second value is as small, the two that were found may be any mixture.
    known = torch.nn.functional.normalize(part.degree().sqrt(), dim=0)
    rest = vectors - known[:, None] * (known @ vectors)
    side = rest[:, rest.norm(dim=0).argmax()] >= 0
    kept = side[part.row] == side[part.column]
    yield from parts(part, connected_components(part.row[kept], part.column[kept], part.size))


def _orthogonal_rows(rows: np.ndarray, count: int) -> np.ndarray:
    """Rows that are as orthogonal to each other as can be, chosen one by one."""
    mean = rows.mean(0)
    chosen = [int(np.argmax(rows @ mean))]
    nearest = np.abs(rows @ rows[chosen[0]])
    for _ in range(count - 1):
        chosen.append(int(np.argmin(nearest)))
        nearest = np.maximum(nearest, np.abs(rows @ rows[chosen[-1]]))
    return np.array(chosen)
