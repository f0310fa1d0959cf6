"""Cholesky factors of one large symmetric matrix by its tiles, in place; and as much of its inverse as it has tiles.

A = U^T U, with the rows k of tiles from top to bottom, and each taken off those below it that it touches:

    U_kk^T U_kk = A_kk        U_kj = U_kk^-T A_kj        A_ij -= U_ki^T U_kj        for k < i <= j

Of the inverse Z the tiles that the factor has follow from each other, from bottom to top (Takahashi, Fagan and Chen 1973):

    G_j = U_kk^-1 U_kj        Z_kj = -sum_i G_i Z_ij        Z_kk = U_kk^-1 U_kk^-T - sum_j Z_kj G_j^T

Where the tiles end does not depend on the number of cores, nor do the bits of the factors.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.optim.solvers.sparse_tiles import TileMatrix
from crowdmap_torch.processes.threads import in_order


@dataclass(frozen=True)
class TiledCholesky:
    """The factors of a matrix, and what is solved with them."""

    upper: TileMatrix
    """U; below its diagonal anything may stand."""

    @classmethod
    def of(cls, matrix: TileMatrix) -> TiledCholesky | None:
        """Those of a matrix with all tiles of its factor, which is no more; None: it is not positive definite."""
        pattern, tiles = matrix.pattern, matrix.tiles
        number, failures = pattern.number, []
        for k, right in enumerate(pattern.columns):
            own = tiles[number[k][k]]
            factor, failed = torch.linalg.cholesky_ex(own, upper=True)
            failures.append(failed)
            own.copy_(factor)

            def whiten(j: int, k: int = k, factor: Tensor = factor) -> None:
                tile = tiles[number[k][j]]
                tile.copy_(torch.linalg.solve_triangular(factor.mT, tile, upper=False))

            def take_off(at: int, k: int = k, right: tuple[int, ...] = right) -> None:
                i = right[at]
                of_i = tiles[number[k][i]].mT
                for j in right[at:]:
                    tiles[number[i][j]].addmm_(of_i, tiles[number[k][j]], alpha=-1)

            for _ in in_order(whiten, right, tiles.device):
                pass
            for _ in in_order(take_off, range(len(right)), tiles.device):
                pass
        # What is not a number on the way is none down to the last pivot.
        finite = tiles[pattern.own].diagonal(dim1=-2, dim2=-1).isfinite().all()
        if failures and bool(torch.stack(failures).any() | ~finite):
            return None
        return cls(matrix)

    def solve(self, right_side: Float[Tensor, "r c"]) -> Float[Tensor, "r c"]:
        """The inverse times right-hand sides."""
        pattern, tiles, number = self.upper.pattern, self.upper.tiles, self.upper.pattern.number
        x = self._begun(right_side)
        for k, right in enumerate(pattern.columns):
            self._forward(x, k, right)
        for k, right in reversed(list(enumerate(pattern.columns))):
            for j in right:
                x[k].addmm_(tiles[number[k][j]], x[j], alpha=-1)
            x[k] = torch.linalg.solve_triangular(tiles[number[k][k]], x[k], upper=True)
        return x.view(-1, right_side.shape[1])[: pattern.dim].contiguous()

    def whitened(self, right_side: Float[Tensor, "r c"]) -> Float[Tensor, "p c"]:
        """U^-T times right-hand sides, of which products are those with the inverse.

        Where they are zero costs nothing on a CPU; a GPU would have to stop to be asked.
        """
        x = self._begun(right_side)
        asks = x.device.type == "cpu"
        for k, right in enumerate(self.upper.pattern.columns):
            if not asks or bool(x[k].any()):
                self._forward(x, k, right)
        return x.flatten(0, 1)

    def trailing(self, begin: int) -> Float[Tensor, "z z"]:
        """U from this row and column on: its square is what is left of the matrix there once all before are eliminated."""
        pattern, tiles = self.upper.pattern, self.upper.tiles
        first, w = begin // pattern.width, pattern.width
        whole = tiles.new_zeros(pattern.tiles - first, w, pattern.tiles - first, w)
        for i, right in enumerate(pattern.columns[first:]):
            for j in (first + i, *right):
                whole[i, :, j - first] = tiles[pattern.number[first + i][j]]
        here = slice(begin - first * w, pattern.dim - first * w)
        return whole.flatten(2, 3).flatten(0, 1)[here, here].triu()

    def _begun(self, right_side: Float[Tensor, "r c"]) -> Float[Tensor, "t w c"]:
        """Right-hand sides by rows of tiles."""
        pattern = self.upper.pattern
        x = right_side.new_zeros(pattern.tiles, pattern.width, right_side.shape[1])
        x.view(-1, right_side.shape[1])[: pattern.dim] = right_side
        return x

    def _forward(self, x: Float[Tensor, "t w c"], k: int, right: tuple[int, ...]) -> None:
        """Solves for a row of tiles, and takes it off those below; in place."""
        tiles, number = self.upper.tiles, self.upper.pattern.number
        x[k] = torch.linalg.solve_triangular(tiles[number[k][k]].mT, x[k], upper=False)
        for j in right:
            x[j].addmm_(tiles[number[k][j]].mT, x[k], alpha=-1)

    def selected_inverse(self) -> TileMatrix:
        """The inverse where the factor has tiles."""
        pattern, tiles = self.upper.pattern, self.upper.tiles
        number = pattern.number
        inverse = TileMatrix.zeros(pattern, self.upper.flat)
        found = inverse.tiles
        eye = torch.eye(pattern.width).to(tiles)
        for k, right in reversed(list(enumerate(pattern.columns))):
            factor = tiles[number[k][k]]
            back = torch.linalg.solve_triangular(factor, eye, upper=True)
            lead = {j: back @ tiles[number[k][j]] for j in right}

            def beside(j: int, k: int = k, lead: dict[int, Tensor] = lead) -> None:
                tile = found[number[k][j]]
                for i, of_i in lead.items():
                    other = found[number[i][j]] if i <= j else found[number[j][i]].mT
                    tile.addmm_(of_i, other, alpha=-1)

            for _ in in_order(beside, right, tiles.device):
                pass
            own = found[number[k][k]]
            torch.mm(back, back.mT, out=own)
            for j in right:
                own.addmm_(found[number[k][j]], lead[j].mT, alpha=-1)
            # What rounding leaves between halves grows by half from tile to tile: to 1e80 along 20 km.
            own.copy_((own + own.mT) / 2)
        return inverse
