"""Which tiles of the landmarks' matrices hold anything: of C, what rows bind; of S, what elimination binds as well."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Int
from numpy.typing import NDArray
from torch import Tensor

from crowdmap_torch.optim.problem import Problem
from crowdmap_torch.optim.solvers.dissection import incidence
from crowdmap_torch.optim.solvers.layout import in_sections
from crowdmap_torch.optim.solvers.sparse_tiles import TilePattern, tile_width
from crowdmap_torch.optim.solvers.windows import LandmarkBlocks


def landmark_pairs(
    problem: Problem, landmarks: LandmarkBlocks, eliminated: Collection[str]
) -> Int[Tensor, "n 2"]:
    """Landmarks that rows bind to each other without an eliminated block."""
    found = [torch.zeros(0, 2, dtype=torch.long, device=landmarks.column.device)]
    for term in problem.terms.values():
        if any(name in eliminated for name, _ in term.slots):
            continue
        blocks = [at + landmarks.first[name] for name, at in term.slots if name in landmarks.first]
        found += [torch.stack(pair, dim=1) for pair in _pairs(blocks)]
    first, second = torch.cat(found).unbind(1)
    key = torch.unique(first * landmarks.count + second)
    return torch.stack((key // landmarks.count, key % landmarks.count), dim=1)


def direct_pattern(
    landmarks: LandmarkBlocks, keys: Int[Tensor, " keys"], pairs: Int[Tensor, "n 2"]
) -> TilePattern:
    """That of C: landmarks that one eliminated block is coupled to (`keys`), and those that are bound without any."""
    device, count = landmarks.column.device, landmarks.count
    width = tile_width(landmarks.dim, device)
    present = _bound(keys // count, keys % count, landmarks, width)
    number = torch.arange(len(pairs), device=device)
    present |= _bound(number.repeat_interleave(2), pairs.flatten(), landmarks, width)
    return TilePattern.of(landmarks.dim, width, present, device)


def binds(direct: TilePattern, landmarks: LandmarkBlocks, pairs: Int[Tensor, "n 2"]) -> bool:
    """Whether a pattern of C has room for what binds these landmarks without an eliminated block."""
    first = landmarks.column[pairs]
    last = first + landmarks.width[pairs] - 1
    corners = [
        direct.present[torch.minimum(a, b), torch.maximum(a, b)]
        for a in (first[:, 0] // direct.width, last[:, 0] // direct.width)
        for b in (first[:, 1] // direct.width, last[:, 1] // direct.width)
    ]
    return bool(torch.stack(corners).all())


def reduced_pattern(
    direct: TilePattern,
    landmarks: LandmarkBlocks,
    group: Int[Tensor, " n"],
    place: Int[Tensor, " n"],
) -> TilePattern:
    """That of S and of its factor: windows of groups bind the landmarks at their places, in the order of columns."""
    present = _bound(group, landmarks.ordered[place], landmarks, direct.width)
    present |= direct.present.cpu().numpy()
    return TilePattern.of(direct.dim, direct.width, present, direct.own.device).filled()


def tiles_of_factor(
    by: Int[Tensor, " n"],
    landmark: Int[Tensor, " n"],
    landmarks: LandmarkBlocks,
    position: Int[Tensor, " q"],
    section: Int[Tensor, " q"] | None = None,
) -> int:
    """How many tiles the factor has where landmarks have these positions, each bound to all that are bound `by` the same.

    A `section` of them begins at a border of tiles.
    """
    order, device = torch.argsort(position), position.device
    width = tile_width(landmarks.dim, device)
    begins, used = in_sections(
        landmarks.width[order], None if section is None else section[order], width
    )
    column = torch.empty_like(order)
    column[order] = begins
    placed = replace(landmarks, column=column, dim=len(used))
    present = _bound(by, landmark, placed, width)
    return TilePattern.of(placed.dim, width, present, device).filled().count


def _pairs(blocks: list[Tensor]) -> Iterator[tuple[Tensor, Tensor]]:
    return ((blocks[i], blocks[j]) for j in range(len(blocks)) for i in range(j))


def _bound(
    by: Int[Tensor, " n"], landmark: Int[Tensor, " n"], landmarks: LandmarkBlocks, width: int
) -> NDArray[np.bool_]:
    """Tiles that have anything in common: each landmark is bound to all that are bound `by` the same."""
    tiles = -(-landmarks.dim // width)
    first = landmarks.column[landmark]
    last = first + landmarks.width[landmark] - 1
    # A landmark lies in two tiles at most, one if it is as wide.
    pair = torch.stack((by * tiles + first // width, by * tiles + last // width)).flatten()
    pair = torch.unique(pair).cpu().numpy()
    if not len(pair):
        return np.zeros((tiles, tiles), dtype=bool)
    row = np.unique(pair // tiles, return_inverse=True)[1].astype(np.int64)
    holds = incidence(row, pair % tiles, tiles)
    return (holds.T @ holds).toarray() > 0
