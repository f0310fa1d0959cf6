"""The matrix C of `chain_schur`, block by block: what rows bind of landmarks and border, and no zeros between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.solvers.layout import Layout
from crowdmap_torch.optim.solvers.sparse_tiles import TileMatrix
from crowdmap_torch.processes.sums import add_at


class Between(NamedTuple):
    """Blocks between two variables that stay; those of one place add up."""

    row: Int[Tensor, " m"]
    column: Int[Tensor, " m"]
    """First row and first column of each."""
    square: Float[Tensor, "k l m"]

    def joined(self, dim: int) -> Between:
        """The same with neighbours of one place added up, in a matrix of so many columns."""
        key = self.row * dim + self.column
        at, of = torch.unique_consecutive(key, return_inverse=True)
        if len(at) == len(key):
            return self
        total = self.square.new_zeros(*self.square.shape[:2], len(at))
        add_at(total, 2, of, self.square)
        return Between(at // dim, at % dim, total)


@dataclass(frozen=True)
class StayingBlocks:
    """What rows say of everything that is not eliminated."""

    where: Layout
    own: Mapping[str, Float[Tensor, "n k k"]]
    """Of every block with itself, by variable."""
    between: tuple[Between, ...]

    def diagonal(self) -> Float[Tensor, " r"]:
        """Its diagonal."""
        own = {name: square.diagonal(dim1=1, dim2=2) for name, square in self.own.items()}
        total = self.where.pack(own)[0]
        for row, column, square in self.between:
            # A row may touch a block twice.
            twice = torch.nonzero(row == column)[:, 0]
            of_twice = square[..., twice].diagonal()
            at = row[twice, None] + torch.arange(of_twice.shape[1], device=row.device)
            add_at(total, 0, at.flatten(), 2 * of_twice.flatten())
        return total

    def add_to(self, system: TileMatrix) -> None:
        """Adds it to a matrix that has tiles for it, in place."""
        for name, square in self.own.items():
            offset = self.where.offset[name]
            system.add(offset, offset, square.permute(1, 2, 0))
        for row, column, square in self.between:
            system.add(row, column, square)
            system.add(column, row, square.transpose(0, 1))
