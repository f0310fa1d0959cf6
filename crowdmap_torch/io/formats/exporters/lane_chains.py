"""Pieces of lane markers joined end to end: what formats with lanes stand on.

A chain is a polyline through the points of pieces that meet. Where they leave a gap it runs straight on; where
they overlap, the points of the later piece that the earlier one has passed are left aside as a stub.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

MAX_GAP_M = 1.5
"""Ends of pieces that meet are nearer than this: they overlap by a metre at the most [m]."""
_SAME_M = 1e-3
_MAX_ASIDE_M = 0.5
_MAX_STEP_M = 0.5
_MIN_ALONG = 0.8
"""Cosine of the angle between pieces that go on into one another."""


@dataclass(frozen=True)
class Chain:
    """Markers that go on into one another, in the direction of the first."""

    point_world: Float[np.ndarray, "n 3"]
    piece: Int[np.ndarray, " n"]
    """The piece that the stretch before each point belongs to; of the first point, that after it."""
    node: Int[np.ndarray, " n"]
    """Number of each point among those of all pieces; the first and the last are the same where a chain is closed."""

    def __len__(self) -> int:
        return len(self.node)

    @property
    def joints(self) -> Int[np.ndarray, " j"]:
        """Points at which another piece begins."""
        inner = np.flatnonzero(self.piece[2:] != self.piece[1:-1]) + 1
        return inner

    @property
    def tangent_world(self) -> Float[np.ndarray, "n 2"]:
        """Unit direction in the plane at every point."""
        step = np.gradient(self.point_world[:, :2], axis=0)
        return step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-12)


def chains(
    points_world: list[Float[np.ndarray, "_ 3"]],
) -> tuple[list[Chain], list[tuple[int, Int[np.ndarray, " s"]]]]:
    """Chains of pieces, each piece in one of them, and stubs: a piece, and the numbers of its points there.

    Points are numbered as they lie one after another in `points_world`.
    """
    first_node = np.cumsum([0, *(len(points) for points in points_world)])
    mate = _mates(points_world)
    found: list[Chain] = []
    stubs: list[tuple[int, np.ndarray]] = []
    used = np.zeros(len(points_world), dtype=bool)
    # Open chains first: they begin at an end that meets nothing.
    starts = sorted(range(2 * len(points_world)), key=lambda end: (end in mate, end))
    for start in starts:
        if used[start // 2]:
            continue
        pieces, end, is_closed = [], start, False
        while True:
            # An even end is a piece's first point, an odd one its last.
            pieces.append((end // 2, bool(end % 2)))
            used[end // 2] = True
            out = end ^ 1
            if out not in mate:
                break
            if used[mate[out] // 2]:
                is_closed = mate[out] == start
                break
            end = mate[out]
        chain, left = _joined(points_world, first_node, pieces, is_closed)
        found.append(chain)
        stubs += left
    return found, stubs


def _joined(
    points_world: list[np.ndarray],
    first_node: np.ndarray,
    pieces: list[tuple[int, bool]],
    is_closed: bool,
) -> tuple[Chain, list[tuple[int, np.ndarray]]]:
    """One chain of pieces (reversed or not), and the stubs of those that overlap the one before."""
    every, owner, stubs = [], [], []
    flat = np.concatenate(points_world)
    for piece, is_reversed in pieces:
        node = np.arange(first_node[piece], first_node[piece + 1])
        node = node[::-1] if is_reversed else node
        if every:
            tip = flat[every[-1][-2:], :2]
            ahead = (flat[node, :2] - tip[-1]) @ (tip[-1] - tip[0])
            passed = int(np.argmax(ahead > 0)) if (ahead > 0).any() else 0
            passed = min(passed, len(node) - 2)
            if (np.linalg.norm(flat[node[:passed]] - flat[every[-1][-1]], axis=1) > _SAME_M).any():
                stubs.append((piece, node[: passed + 1]))
            node = node[passed:]
        every.append(node)
        owner.append(np.full(len(node), piece))
    if is_closed:
        every.append(every[0][:1])
        owner.append(owner[-1][:1])
    node = np.concatenate(every)
    return Chain(flat[node], np.concatenate(owner), node), stubs


def _mates(points_world: list[np.ndarray]) -> dict[int, int]:
    """Which end of a piece goes on into which other; ends are numbered 2 piece, and 2 piece + 1 for the last."""
    if not points_world:
        return {}
    tips = np.array([p[k] for p in points_world for k in (0, -1)])
    inward = np.array([(p[1] - p[0], p[-2] - p[-1]) for p in points_world]).reshape(-1, 3)[:, :2]
    inward = inward / np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-12)
    one, two = KDTree(tips[:, :2]).query_pairs(MAX_GAP_M, output_type="ndarray").T
    between = tips[two] - tips[one]
    aside = np.abs(between[:, 0] * inward[one, 1] - between[:, 1] * inward[one, 0])
    fits = (
        (np.sum(inward[one] * inward[two], axis=1) < -_MIN_ALONG)
        & (aside < _MAX_ASIDE_M)
        & (np.abs(between[:, 2]) < _MAX_STEP_M)
        & (one // 2 != two // 2)
    )
    distance = np.linalg.norm(between, axis=1)
    mate: dict[int, int] = {}
    for k in np.flatnonzero(fits)[np.argsort(distance[fits], kind="stable")].tolist():
        a, b = int(one[k]), int(two[k])
        if a not in mate and b not in mate:
            mate[a], mate[b] = b, a
    return mate
