"""Large symmetric matrices of which most is zero: square tiles on and above the diagonal, those alone that hold anything.

Landmarks along roads are bound to those near them, so of the tiles in a row there are a few, however long the road: memory
grows with the tiles, not with the square of the unknowns. Where everything is bound to everything all tiles are there.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from crowdmap_torch.processes.sums import add_at, lasting

_ONE_TILE = 768
"""Unknowns up to which one tile holds everything."""
_WIDTH = 96
"""Of tiles on a processor: what fits its cache, and no more zeros than need be."""
_WIDTH_CUDA = 1024
"""Of tiles on a GPU, where a call costs as much as the arithmetic of a small one."""
_ABSENT = -(1 << 31)
"""Where no tile is: no place in any memory."""


def tile_width(dim: int, device: torch.device) -> int:
    """Width of the tiles of a matrix of so many unknowns."""
    if dim <= _ONE_TILE:
        return max(dim, 1)
    return _WIDTH if device.type == "cpu" else min(_WIDTH_CUDA, dim)


@dataclass(frozen=True)
class TilePattern:
    """Which tiles there are, row by row, and where each is kept.

    Behind the tiles there is room for a right-hand side, whose row is called `dim`, and for what is to be forgotten: what
    would stand below the diagonal's tiles, and all of row or column `dim + 1`.
    """

    dim: int
    width: int
    present: Bool[Tensor, "t t"]
    """Above the diagonal, and on it; the diagonal's are all there."""
    upper: NDArray[np.bool_]
    """The same on the CPU."""

    @classmethod
    def of(
        cls, dim: int, width: int, present: NDArray[np.bool_], device: torch.device
    ) -> TilePattern:
        """That of tiles of which those above the diagonal count."""
        upper = np.triu(present)
        np.fill_diagonal(upper, val=True)
        return cls(dim, width, torch.from_numpy(upper).to(device), upper)

    @property
    def tiles(self) -> int:
        """Tiles of the diagonal."""
        return len(self.present)

    @cached_property
    def count(self) -> int:
        """All tiles."""
        return int(self.upper.sum())

    @cached_property
    def columns(self) -> tuple[tuple[int, ...], ...]:
        """By row, the columns of the tiles right of the diagonal."""
        return tuple(tuple(np.nonzero(row)[0][1:].tolist()) for row in self.upper)

    @cached_property
    def number(self) -> tuple[dict[int, int], ...]:
        """By row and column, the number of each that is there."""
        after = itertools.count()
        return tuple(
            {column: next(after) for column in (row, *right)}
            for row, right in enumerate(self.columns)
        )

    @cached_property
    def own(self) -> Int[Tensor, " t"]:
        """Numbers of the diagonal's."""
        return self.present.sum(1).cumsum(0) - self.present.sum(1)

    @cached_property
    def base(self) -> Int[Tensor, "u u"]:
        """Where in memory each tile begins, and the right-hand side's and what is forgotten; in 32 bits if they do."""
        upper, tiles, area = self.upper, self.tiles, self.width**2
        behind = self.count * area
        forgotten = behind + tiles * self.width
        most = max(forgotten + (tiles + 2) * area, (tiles + 2) ** 2)
        kind = np.int32 if most <= -_ABSENT else np.int64
        base = np.full((tiles + 2, tiles + 2), forgotten, dtype=kind)
        inner = np.where(np.tri(tiles, k=-1, dtype=bool), forgotten, _ABSENT)
        inner[upper] = area * np.arange(self.count)
        base[:tiles, :tiles] = inner
        base[tiles, :tiles] = behind + self.width * np.arange(tiles)
        return torch.from_numpy(base).to(self.present.device)

    @property
    def size(self) -> int:
        """Numbers to be kept."""
        return (self.count + 1) * self.width**2 + self.tiles * self.width

    def filled(self) -> TilePattern:
        """That of the Cholesky factor: a row leaves its tiles behind in the row of the first of them."""
        upper = self.upper.copy()
        for row in range(len(upper)):
            right = np.nonzero(upper[row, row + 1 :])[0]
            if len(right):
                first = row + 1 + right[0]
                upper[first] |= upper[row]
                upper[first, :first] = False
        return TilePattern.of(self.dim, self.width, upper, self.present.device)

    def at(self, row: Int[Tensor, ...], column: Int[Tensor, ...]) -> Int[Tensor, ...]:
        """Where in memory entries are, rows and columns broadcast; no place at all where there is no tile.

        Row `dim` is the right-hand side, `dim + 1` forgotten.
        """
        return self._place(*self._tile(row), *self._tile(column))

    def squares(self, columns: Int[Tensor, "b w"]) -> Int[Tensor, "b w w"]:
        """`at` of windows of columns, each with itself."""
        tile, within = self._tile(columns)
        return self._place(tile[:, :, None], within[:, :, None], tile[:, None], within[:, None])

    def _place(self, down: Tensor, r: Tensor, right: Tensor, c: Tensor) -> Int[Tensor, ...]:
        """Where in memory entries are, by tile and within it."""
        tile = down * len(self.base) + right
        begin = self.base.flatten().index_select(0, tile.flatten()).view(tile.shape)
        return begin.add_(r * self.width).add_(c)

    def _tile(self, entry: Int[Tensor, ...]) -> tuple[Int[Tensor, ...], Int[Tensor, ...]]:
        """The tile of an entry, and where in it that is."""
        entry = entry.to(self.base.dtype)
        tile = torch.div(entry, self.width, rounding_mode="floor")
        within = entry - tile * self.width
        beyond = entry - self.dim
        tile = torch.where(beyond >= 0, self.tiles + beyond, tile)
        return tile, torch.where(beyond >= 0, 0, within)


@dataclass(frozen=True)
class TileMatrix:
    """A symmetric matrix, and a right-hand side beside it."""

    pattern: TilePattern
    flat: Float[Tensor, " size"]

    @classmethod
    def zeros(cls, pattern: TilePattern, like: Tensor) -> TileMatrix:
        """Of the type and the device of `like`."""
        return cls(pattern, like.new_zeros(pattern.size))

    @property
    def tiles(self) -> Float[Tensor, "count w w"]:
        """The tiles, by number."""
        w = self.pattern.width
        return self.flat[: self.pattern.count * w * w].view(-1, w, w)

    @property
    def right_side(self) -> Float[Tensor, " r"]:
        """The right-hand side."""
        start = self.pattern.count * self.pattern.width**2
        return self.flat[start : start + self.pattern.dim]

    def diagonal(self) -> Float[Tensor, " r"]:
        """Its diagonal."""
        of_tiles = self.tiles[self.pattern.own].diagonal(dim1=-2, dim2=-1)
        return of_tiles.flatten()[: self.pattern.dim]

    def add_diagonal(self, added: Float[Tensor, " r"]) -> None:
        """Adds to its diagonal, in place; behind its end stands a one."""
        number, w = self.pattern.own, self.pattern.width
        padded = added.new_ones(self.pattern.tiles * w)
        padded[: self.pattern.dim] = added
        entry = torch.arange(w, device=added.device) * (w + 1)
        add_at(self.flat, 0, (number[:, None] * w * w + entry).flatten(), padded)

    def add(
        self, row: Int[Tensor, " m"], column: Int[Tensor, " m"], block: Float[Tensor, "k l m"]
    ) -> None:
        """Adds blocks, each from its row and column on, in place; what is below the diagonal's tiles is left out."""
        pattern, (height, width, _) = self.pattern, block.shape

        def places() -> Int[Tensor, " n"]:
            down = torch.arange(height, device=row.device)[:, None, None]
            right = torch.arange(width, device=row.device)[:, None]
            return pattern.at(row + down, column + right).flatten()

        at = lasting(("places", height, width), places, row, column, pattern.base)
        add_at(self.flat, 0, at, block.flatten())

    def read(self, row: Int[Tensor, ...], column: Int[Tensor, ...]) -> Float[Tensor, ...]:
        """Entries, rows and columns broadcast; ValueError where there is no tile."""
        row, column = torch.minimum(row, column), torch.maximum(row, column)
        at = self.pattern.at(row, column)
        if bool((at < 0).any()):
            raise ValueError(
                "entries between unknowns that nothing binds to each other are not kept"
            )
        return self.flat[at]

    def dense(self) -> Float[Tensor, "r r"]:
        """All entries, zeros included."""
        w, tiles = self.pattern.width, self.pattern.tiles
        whole = self.flat.new_zeros(tiles, w, tiles, w)
        row, column = torch.nonzero(self.pattern.present, as_tuple=True)
        whole[row, :, column] = self.tiles
        matrix = whole.view(tiles * w, tiles * w)[: self.pattern.dim, : self.pattern.dim]
        return matrix.triu() + matrix.triu(1).mT
