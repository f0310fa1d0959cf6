"""Spectral clustering of a sparse similarity graph, component by component (V-A; von Luxburg 2007).

Nothing is ever dense over the whole graph. Connected components are independent, so each has its own Laplacian and its
own eigenvalue gap: small ones are padded to common sizes and decomposed in batches, large ones through their leading
eigenpairs only, and a large one with more clusters than those can tell is first cut in two along its Fiedler vector.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import eigsh
from sklearn.cluster import KMeans
from torch import Tensor

from crowdmap_torch.ranges import Count, RoundsOrNone, Settings, Share

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
    leading: Count = 48
    """Eigenpairs computed of larger components."""
    cut_below: Share = 0.02
    """A larger component is cut in two while even its last leading eigenvalue is below this: too many."""

    def __post_init__(self) -> None:
        """Refuses an unknown way to label."""
        super().__post_init__()
        if self.labels not in LABEL_METHODS:
            raise ValueError(f"labels: expected one of {LABEL_METHODS}, found {self.labels!r}")


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
) -> SpectralClusters:
    """Clusters of the `n` nodes of a graph with symmetric similarities in (0, 1] on its edges (V-A).

    Each pair of nodes may appear once, in either order; a node is similar to itself by 1. Edges of similarity zero are
    no edges. The number of clusters of each connected component comes from the gap of its own eigenvalues.
    """
    device, dtype = edge.device, similarity.dtype
    matrix = _symmetric(edge, similarity, n)
    _, component = connected_components(matrix, directed=False)
    spectra: list[Tensor] = []
    label = torch.zeros(n, dtype=torch.int64)
    piece = torch.from_numpy(component.astype(np.int64))
    free = 0  # the first label not yet used

    small, large = _by_size(component, config.dense_limit)
    pieces = int(piece.max()) + 1 if n else 0
    while large:
        nodes = large.pop()
        values, vectors = _leading_pairs(matrix[nodes][:, nodes], config.leading)
        if values[-1] < config.cut_below:
            for part in _fiedler_cut(matrix, nodes, vectors[:, 1]):
                piece[torch.from_numpy(part)] = pieces
                pieces += 1
                (small if len(part) <= config.dense_limit else large).append(part)
            continue
        spectra.append(torch.from_numpy(values).to(dtype))
        # The value behind the last leading one is not known, so ending there is no answer.
        count = int(np.argmax(np.diff(values))) + 1
        found = _labels(torch.from_numpy(vectors[:, :count]), config, generator)
        label[torch.from_numpy(nodes)] = free + found
        free += int(found.max()) + 1
    for members in _batches(sorted(small, key=len)):
        laplacian, size = _padded_laplacians(matrix, members, device=device, dtype=dtype)
        values, vectors = torch.linalg.eigh(laplacian)
        counts = eigengap(values, size)
        spectra.append(values[values < 0.5 * (_PADDING + 2)].cpu())
        for b, nodes in enumerate(members):
            found = _labels(vectors[b, : len(nodes), : int(counts[b])], config, generator)
            label[torch.from_numpy(nodes)] = free + found.cpu()
            free += int(found.max()) + 1
    label = renumber(label)
    eigenvalues = torch.cat(spectra).sort().values if spectra else similarity.new_zeros(0)
    return SpectralClusters(
        label=label.to(device),
        count=int(label.max()) + 1 if n else 0,
        component=renumber(piece).to(device),
        eigenvalues=eigenvalues.to(device),
    )


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


def _symmetric(
    edge: Int[Tensor, "m 2"], similarity: Float[Tensor, " m"], n: int
) -> sparse.csr_matrix:
    i, j = edge.detach().cpu().numpy().T
    weight = similarity.detach().cpu().numpy()
    keep = (weight > 0) & (i != j)
    i, j, weight = i[keep], j[keep], weight[keep]
    diagonal = np.arange(n)
    rows = np.concatenate((i, j, diagonal))
    columns = np.concatenate((j, i, diagonal))
    values = np.concatenate((weight, weight, np.ones(n, dtype=weight.dtype)))
    return sparse.csr_matrix((values, (rows, columns)), shape=(n, n))


def _by_size(component: np.ndarray, dense_limit: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Nodes of each component: those small enough for a dense decomposition, and the others."""
    order = np.argsort(component, kind="stable")
    sizes = np.bincount(component) if len(component) else np.zeros(0, dtype=np.int64)
    groups = np.split(order, np.cumsum(sizes)[:-1]) if len(sizes) else []
    return (
        [nodes for nodes in groups if len(nodes) <= dense_limit],
        [nodes for nodes in groups if len(nodes) > dense_limit],
    )


def _batches(groups: list[np.ndarray]) -> Iterator[list[np.ndarray]]:
    """Runs of groups (ascending in size) whose padding stays within a quarter and whose matrices fit the batch."""
    start = 0
    while start < len(groups):
        stop, widest = start, len(groups[start]) + max(1, len(groups[start]) // 4)
        while (
            stop < len(groups)
            and len(groups[stop]) <= widest
            and (stop - start) * len(groups[stop]) ** 2 < _BATCH_ELEMENTS
        ):
            stop += 1
        yield groups[start:stop]
        start = stop


def _padded_laplacians(
    matrix: sparse.csr_matrix,
    members: list[np.ndarray],
    *,
    device: torch.device,
    dtype: torch.dtype,
) -> tuple[Float[Tensor, "b p p"], Int[Tensor, " b"]]:
    """Normalised Laplacians of several components; padded rows are alone, their eigenvalue lies behind all others."""
    size = torch.tensor([len(nodes) for nodes in members])
    width = int(size.max())
    nodes = np.concatenate(members)
    batch = np.repeat(np.arange(len(members)), size.numpy())
    place = np.arange(len(nodes)) - np.repeat(np.cumsum(size.numpy()) - size.numpy(), size.numpy())
    where = np.full(len(matrix.indptr) - 1, -1, dtype=np.int64)
    where[nodes] = np.arange(len(nodes))
    block = sparse.coo_matrix(matrix[nodes])
    i, j = block.row, where[block.col]
    # A piece cut out of a larger component has edges that lead out of it.
    inside = (j >= 0) & (batch[i] == batch[j])
    i, j = i[inside], j[inside]
    dense = torch.zeros(len(members), width, width, dtype=dtype)
    dense[batch[i], place[i], place[j]] = torch.from_numpy(block.data[inside]).to(dtype)
    rank = torch.arange(width)
    is_padding: Bool[Tensor, "b p"] = rank >= size[:, None]
    dense[:, rank, rank] = torch.where(is_padding, 1.0, dense[:, rank, rank])
    laplacian = normalized_laplacian(dense)
    laplacian[:, rank, rank] = torch.where(is_padding, _PADDING, laplacian[:, rank, rank])
    return laplacian.to(device), size.to(device)


def _leading_pairs(block: sparse.csr_matrix, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The smallest eigenvalues of the normalised Laplacian of one component, ascending, and their vectors."""
    root = 1 / np.sqrt(np.asarray(block.sum(1)).ravel())
    scaled = sparse.diags(root) @ block @ sparse.diags(root)
    # A fixed start makes the answer repeatable; it must not be the first eigenvector itself.
    start = root * (1 + 0.5 * np.cos(np.arange(len(root)) * 2.399963))
    pairs: dict[str, Any] = {"k": min(count, len(root) - 1), "which": "LA", "tol": 1e-8}
    values, vectors = eigsh(scaled, v0=start, **pairs)
    order = np.argsort(-values)
    return 1 - values[order], vectors[:, order]


def _fiedler_cut(
    matrix: sparse.csr_matrix, nodes: np.ndarray, fiedler: np.ndarray
) -> Iterator[np.ndarray]:
    """The connected parts of a component after it was cut where its second eigenvector changes sign."""
    for side in (fiedler >= 0, fiedler < 0):
        half = nodes[side]
        if len(half):
            _, part = connected_components(matrix[half][:, half], directed=False)
            for p in range(part.max() + 1):
                yield half[part == p]


def _orthogonal_rows(rows: np.ndarray, count: int) -> np.ndarray:
    """Rows that are as orthogonal to each other as can be, chosen one by one."""
    mean = rows.mean(0)
    chosen = [int(np.argmax(rows @ mean))]
    nearest = np.abs(rows @ rows[chosen[0]])
    for _ in range(count - 1):
        chosen.append(int(np.argmin(nearest)))
        nearest = np.maximum(nearest, np.abs(rows @ rows[chosen[-1]]))
    return np.array(chosen)
