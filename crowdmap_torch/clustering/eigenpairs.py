"""The first eigenpairs of the normalised Laplacian of a large graph, by Chebyshev-filtered subspace iteration.

A block of vectors is multiplied by a polynomial of the Laplacian that is small on the part of the spectrum nobody asked
for and grows fast below it, made orthonormal, and turned to the Ritz vectors it holds (Zhou, Saad, Tiago, Chelikowsky
2006). The block is wider than what is asked for, so eigenvalues may be equal as often as they like; nothing but products
of the sparse matrix with the block and small dense decompositions is needed, on any device.

Where that does not come to its tolerance the block is made wider, so that the filter's edge leaves the crowd that held it
up, and a graph that memory allows is decomposed whole. Of a larger one the best vectors count, and how far they miss is
told: they are those of a graph that differs by their residual, which k-means and a cut hardly notice.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.clustering.graph import Graph

_GUARD = 16
"""Vectors of the block beyond those that are asked for: the filter's edge lies behind them."""
_TOLERANCE = 1e-8
"""Most length of `L x - lambda x`, |x| = 1, of the vectors before the gap."""
_VALUE_TOLERANCE = 1e-4
"""Of all others: an eigenvalue is as near. Behind the gap they may crowd, and their vectors be hard to tell apart."""
_ROUNDINGS = 50.0
"""Units in the last place that no tolerance goes below (float32)."""
_MOST_DEGREE = 200
"""Of one filter: the spectrum is estimated anew after as many products."""
_MOST_ROUNDS = 500
_WIDER = (4, 16)
"""Multiples of the guard with which an iteration that does not converge is begun again."""
_SOON_WHOLE = 1 << 11
"""Graphs up to as many nodes are decomposed whole at once then: it takes seconds."""
_LAST_WHOLE = 1 << 13
"""Most nodes of a graph that is decomposed whole after all: half a gigabyte in float64, and minutes."""
_GATHERED = 1 << 26
"""Numbers gathered at once where the matrix product is made of sums over segments."""

Product = Callable[[Float[Tensor, "n k"]], Float[Tensor, "n k"]]


@dataclass(frozen=True)
class LeadingPairs:
    """The low end of the spectrum of a normalised Laplacian."""

    values: Float[Tensor, " k"]
    """The smallest eigenvalues, ascending: those before the widest gap to rounding, the others to about 1e-4."""
    crowded: bool
    """Even the last of them is small: there are more clusters than they can tell."""
    vectors: Float[Tensor, "n c"]
    """Orthonormal eigenvectors, residuals below 1e-8: those before the widest gap; the first two where all are crowded."""
    miss: float = 0.0
    """Largest residual that a value or a vector has, where one did not come to its tolerance; else 0."""


def leading_eigenpairs(graph: Graph, count: int, *, crowded_below: float) -> LeadingPairs:
    """The `count` smallest eigenvalues of the normalised Laplacian of a graph, and the vectors before their widest gap.

    They are `crowded` where even the last is below `crowded_below`; it suffices that it is certain, and the values are then
    upper bounds. The same graph gives the same bits.
    """
    scaled, laplacian = _laplacian(graph)
    if graph.size <= 3 * (count + _GUARD):
        return _whole(graph, scaled, count, crowded_below)
    found = _iterated(graph, laplacian, count, count + _GUARD, crowded_below)
    for factor in () if graph.size <= _SOON_WHOLE else _WIDER:
        if found.is_there:
            break
        wider = _iterated(graph, laplacian, count, count + factor * _GUARD, crowded_below)
        found = wider if wider.is_there or wider.miss < found.miss else found
    if not found.is_there and graph.size <= _LAST_WHOLE:
        return _whole(graph, scaled, count, crowded_below)
    return found.pairs if found.is_there else replace(found.pairs, miss=found.worst)


@dataclass(frozen=True)
class _Found:
    """Where a subspace iteration ended."""

    pairs: LeadingPairs
    is_there: bool
    """Whether it came to its tolerance."""
    miss: float
    """Largest residual of the vectors before the gap."""
    worst: float
    """Of all that were asked for."""


def _whole(
    graph: Graph, scaled: Float[Tensor, " m"], count: int, crowded_below: float
) -> LeadingPairs:
    values, vectors = torch.linalg.eigh(_dense(graph, scaled))
    return _leading(values[:count], vectors, crowded_below)


def _iterated(
    graph: Graph, laplacian: Product, count: int, width: int, crowded_below: float
) -> _Found:
    """What a block of some width comes to."""
    block = _start(graph, min(width, graph.size))
    eps = torch.finfo(block.dtype).eps
    least = _ROUNDINGS * eps
    best = None
    for number in range(_MOST_ROUNDS):
        values, block, image = _ritz(block, laplacian)
        pairs = _leading(values[:count].clamp_min(0), block, crowded_below)
        miss = (image - values * block)[:, :count].norm(dim=0)
        exact = float(miss[: pairs.vectors.shape[1]].max())
        is_there = exact <= max(_TOLERANCE, least) and (
            pairs.crowded or bool((miss <= max(_VALUE_TOLERANCE, least)).all())
        )
        worst = exact if pairs.crowded else max(exact, float(miss.max()))
        best = _Found(pairs, is_there, exact, worst)
        if is_there:
            break
        # Beyond eps^-0.6 the last vectors of the block would be lost in the rounding of the first.
        block = _filtered(
            block, image, laplacian, edge=float(values[-1]), contrast=eps**-0.6, number=number
        )
    assert best is not None
    return best


def _leading(
    values: Float[Tensor, " k"], vectors: Float[Tensor, "n _"], crowded_below: float
) -> LeadingPairs:
    crowded = bool(values[-1] < crowded_below)
    # The value behind the last one is not known, so ending there is no answer.
    before = 2 if crowded or len(values) < 2 else int(values.diff().argmax()) + 1
    return LeadingPairs(values, crowded, vectors[:, :before])


def _ritz(
    block: Float[Tensor, "n k"], laplacian: Product
) -> tuple[Float[Tensor, " k"], Float[Tensor, "n k"], Float[Tensor, "n k"]]:
    """The Ritz values of the space that a block spans, ascending, its Ritz vectors and what the Laplacian makes of them."""
    block = torch.linalg.qr(block).Q
    image = laplacian(block)
    inner = block.mT @ image
    values, turn = torch.linalg.eigh(0.5 * (inner + inner.mT))
    return values, block @ turn, image @ turn


def _filtered(
    block: Float[Tensor, "n k"],
    image: Float[Tensor, "n k"],
    laplacian: Product,
    *,
    edge: float,
    contrast: float,
    number: int,
) -> Float[Tensor, "n k"]:
    """A block times the Chebyshev polynomial that is 1 at 0 and about 1 / `contrast` between `edge` and 2, by recurrence."""
    low = min(max(edge, 1e-9), 1.8)
    half, center = (2 - low) / 2, (2 + low) / 2
    degree = min(int(math.acosh(contrast) / math.acosh(center / half)), _MOST_DEGREE)
    # Two eigenvalues behind the edge may be damped alike by one degree, hardly by three.
    degree = max(degree - number % 3, 3)
    ratio = first = -half / center
    before, now = block, (image - center * block) * (ratio / half)
    for _ in range(degree - 1):
        following = 1 / (2 / first - ratio)
        image = laplacian(now)
        before, now = (
            now,
            (image - center * now) * (2 * following / half) - (ratio * following) * before,
        )
        ratio = following
    return now


def _start(graph: Graph, width: int) -> Float[Tensor, "n k"]:
    """The first eigenvector of a connected graph, which is known, and numbers drawn alike on every device."""
    drawn = torch.randn(
        graph.size, width - 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    first = graph.degree().sqrt()
    return torch.cat((first[:, None], drawn.to(first)), dim=1)


def _laplacian(graph: Graph) -> tuple[Float[Tensor, " m"], Product]:
    """The weights divided by the roots of both ends' degrees, and the product of the normalised Laplacian with a block."""
    root = graph.degree().rsqrt()
    scaled = root[graph.row] * graph.weight * root[graph.column]
    offsets = graph.offsets()
    if not scaled.is_cuda:
        with warnings.catch_warnings():
            # That the layout is in beta is said once a process.
            warnings.simplefilter("ignore", UserWarning)
            matrix = torch.sparse_csr_tensor(
                offsets, graph.column, scaled, (graph.size, graph.size)
            )
        return scaled, lambda block: block - matrix @ block
    # cuSPARSE adds in no fixed order; a segment is summed from its first number to its last.
    columns = max(_GATHERED // max(len(scaled), 1), 1)

    def product(block: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        sums = [
            torch.segment_reduce(
                scaled[:, None] * some[graph.column], "sum", offsets=offsets, axis=0
            )
            for some in block.split(columns, dim=1)
        ]
        return block - torch.cat(sums, dim=1)

    return scaled, product


def _dense(graph: Graph, scaled: Float[Tensor, " m"]) -> Float[Tensor, "n n"]:
    matrix = scaled.new_zeros(graph.size, graph.size)
    matrix[graph.row, graph.column] = -scaled
    matrix.diagonal().add_(1)
    return matrix
