"""Cholesky factors of one large symmetric matrix, in place and tile by tile: the tiles of a row side by side.

A = U^T U, with the rows k of tiles from top to bottom:

    U_kk^T U_kk = A_kk - sum_i<k U_ik^T U_ik        U_kj = U_kk^-T (A_kj - sum_i<k U_ik^T U_ij)

Where the tiles end does not depend on the number of cores, nor do the bits of the factors.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.processes.threads import in_order

_WORTH_TILES = 768
"""Unknowns from which tiles pay."""
_TILE = 192
_SIDE_BY_SIDE = 8
"""Pieces that a row of tiles is cut into."""


@dataclass(frozen=True)
class TiledCholesky:
    """The factors of a matrix, and what is solved with them."""

    upper: Float[Tensor, "r r"]
    """U; below its diagonal anything may stand."""

    @classmethod
    def of(cls, matrix: Float[Tensor, "r r"]) -> TiledCholesky | None:
        """Those of a matrix of which the upper triangle counts, and which is no more; None: it is not positive definite."""
        if not _by_tiles(matrix):
            upper, failed = torch.linalg.cholesky_ex(matrix, upper=True)
            # What is not a number on the way is none down to the last pivot.
            failed = bool(failed) or not bool(upper.diagonal().isfinite().all())
            return None if failed else cls(upper)
        for here, before, behind in _tiles(len(matrix)):
            above = matrix[before, here].mT
            own = matrix[here, here].addmm_(above, above.mT, alpha=-1)
            factor, failed = torch.linalg.cholesky_ex(own, upper=True)
            if int(failed) or not bool(factor.diagonal().isfinite().all()):
                return None
            own.copy_(factor)
            _finish_row(matrix, here, before, behind, factor)
        return cls(matrix)

    def solve(self, right_side: Float[Tensor, "r c"]) -> Float[Tensor, "r c"]:
        """The inverse times right-hand sides."""
        U = self.upper
        if not _by_tiles(U):
            return torch.cholesky_solve(right_side, U, upper=True)
        x = right_side.clone()
        tiles = list(_tiles(len(U)))
        for here, before, _ in tiles:
            x[here].addmm_(U[before, here].mT, x[before], alpha=-1)
            x[here] = torch.linalg.solve_triangular(U[here, here].mT, x[here], upper=False)
        for here, _, behind in reversed(tiles):
            x[here].addmm_(U[here, behind], x[behind], alpha=-1)
            x[here] = torch.linalg.solve_triangular(U[here, here], x[here], upper=True)
        return x

    def inverse(self) -> Float[Tensor, "r r"]:
        """The inverse."""
        return torch.cholesky_inverse(self.upper, upper=True)


def _by_tiles(matrix: Float[Tensor, "r r"]) -> bool:
    """Whether a matrix is large enough, and on a processor."""
    return len(matrix) >= _WORTH_TILES and matrix.device.type == "cpu"


def _tiles(dim: int) -> list[tuple[slice, slice, slice]]:
    """A tile's rows, those before it and those behind it."""
    return [
        (slice(at, min(at + _TILE, dim)), slice(0, at), slice(min(at + _TILE, dim), dim))
        for at in range(0, dim, _TILE)
    ]


def _finish_row(
    matrix: Float[Tensor, "r r"], here: slice, before: slice, behind: slice, factor: Tensor
) -> None:
    """The tiles beside the diagonal's, in place."""
    width = behind.stop - behind.start
    if not width:
        return
    size = max(_TILE // 2, -(-width // _SIDE_BY_SIDE))

    def finish(at: int) -> None:
        there = slice(at, min(at + size, behind.stop))
        part = matrix[here, there]
        part.addmm_(matrix[before, here].mT, matrix[before, there], alpha=-1)
        part.copy_(torch.linalg.solve_triangular(factor.mT, part, upper=False))

    for _ in in_order(finish, range(behind.start, behind.stop, size), matrix.device):
        pass
