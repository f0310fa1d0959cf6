"""Which tiles of the landmarks' matrices hold anything: of C, what rows bind; of S, what elimination binds as well."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

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


def pairs_that_stay(
    problem: Problem, stays: LandmarkBlocks, eliminated: Collection[str]
) -> Int[Tensor, "n 2"]:
    """Landmarks, and blocks of the border, that rows bind to each other without an eliminated block."""
    found = [torch.zeros(0, 2, dtype=torch.long, device=stays.column.device)]
    for term in problem.terms.values():
        if any(name in eliminated for name, _ in term.slots):
            continue
        blocks = [at + stays.first[name] for name, at in term.slots if name in stays.first]
        found += [torch.stack(pair, dim=1) for pair in _pairs(blocks)]
    first, second = torch.cat(found).unbind(1)
    key = torch.unique(first * stays.count + second)
    return torch.stack((key // stays.count, key % stays.count), dim=1)


@dataclass(frozen=True)
class Beside:
    """Landmarks, and blocks of a variable of the border that they are bound to: pair by pair."""

    variable: str
    landmark: Int[Tensor, " n"]
    block: Int[Tensor, " n"]


def border_beside(
    keys: Int[Tensor, " keys"],
    count: int,
    owner: Int[Tensor, " e"],
    border: Mapping[str, Int[Tensor, " chains"]],
) -> tuple[Beside, ...]:
    """Each landmark with what the chains that are coupled to it have of the border, by couplings as keys."""
    own = torch.unique(owner[keys // count] * count + keys % count)
    chain, landmark = own // count, own % count
    return tuple(Beside(name, landmark, block[chain]) for name, block in border.items())


def direct_pattern(
    stays: LandmarkBlocks,
    landmarks: LandmarkBlocks,
    keys: Int[Tensor, " keys"],
    pairs: Int[Tensor, "n 2"],
    beside: Sequence[Beside],
) -> TilePattern:
    """That of C: what one eliminated block is coupled to (`keys`), and what is bound without any; the border goes last.

    `beside` landmarks is what rows of eliminated blocks have of the border as well. `stays` are landmarks and border.
    """
    device, count = stays.column.device, landmarks.count
    width = tile_width(stays.dim, device)
    present = _bound(keys // count, keys % count, stays, width)
    number = torch.arange(len(pairs), device=device)
    present |= _bound(number.repeat_interleave(2), pairs.flatten(), stays, width)
    # Every block is bound to itself, and may lie in two tiles.
    first, last = stays.column // width, (stays.column + stays.width - 1) // width
    present[first.cpu().numpy(), last.cpu().numpy()] = True
    border = stays.column[len(landmarks.column) :] // width
    if len(border):
        present[int(border.min()) :, int(border.min()) :] = True
    return TilePattern.of(stays.dim, width, present | _between(stays, beside, width), device)


def _between(stays: LandmarkBlocks, beside: Sequence[Beside], width: int) -> NDArray[np.bool_]:
    """Tiles between landmarks and what is `beside` them of the border."""
    tiles = -(-stays.dim // width)
    present = np.zeros((tiles, tiles), dtype=bool)
    for of in beside:
        # A block lies in two tiles at most.
        ends = [
            (stays.column[at] // width, (stays.column[at] + stays.width[at] - 1) // width)
            for at in (of.landmark, of.block + stays.first[of.variable])
        ]
        for row, column in product(*ends):
            pair = torch.unique(row * tiles + column).cpu().numpy()
            present[pair // tiles, pair % tiles] = True
    return present


def binds(direct: TilePattern, stays: LandmarkBlocks, pairs: Int[Tensor, "n 2"]) -> bool:
    """Whether a pattern of C has room for what binds these blocks without an eliminated one."""
    first = stays.column[pairs]
    last = first + stays.width[pairs] - 1
    corners = [
        direct.present[torch.minimum(a, b), torch.maximum(a, b)]
        for a in (first[:, 0] // direct.width, last[:, 0] // direct.width)
        for b in (first[:, 1] // direct.width, last[:, 1] // direct.width)
    ]
    return bool(torch.stack(corners).all())


def reduced_pattern(
    direct: TilePattern,
    stays: LandmarkBlocks,
    group: Int[Tensor, " n"],
    place: Int[Tensor, " n"],
    beside: Sequence[Beside],
    *,
    is_factored: bool = True,
) -> TilePattern:
    """That of S, and of its factor: windows of groups bind the landmarks at their places, in the order of columns.

    Chains bind the landmarks that they are coupled to with what they have `beside` them of the border.
    """
    present = _bound(group, stays.ordered[place], stays, direct.width)
    present |= direct.present.cpu().numpy() | _between(stays, beside, direct.width)
    found = TilePattern.of(direct.dim, direct.width, present, direct.present.device)
    return found.filled() if is_factored else found


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
