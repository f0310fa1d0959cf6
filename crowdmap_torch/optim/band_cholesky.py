"""Cholesky factors of symmetric banded matrices: chains of unknowns, and stretches of a path bound to each other.

On the CPU they are LAPACK's (`pbtrf`, `pbtrs`): 2 ms for 2,008 unknowns with a band of 144, where blocks in torch take ten
times as long. On any other device the same is done block by block there: nothing is brought to the CPU.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.linalg import LinAlgError
from scipy.linalg import cho_solve_banded as lapack_solve
from scipy.linalg import cholesky_banded as lapack_factor
from torch import Tensor

_LEAST_BLOCK = 32
"""Blocks are no smaller, however narrow the band: each costs some calls."""


@runtime_checkable
class BandFactor(Protocol):
    """The factor L of a matrix `A = L L^T`."""

    @property
    def log_determinant(self) -> Float[Tensor, ""]:
        """Of A."""
        ...

    @property
    def band(self) -> Float[Tensor, "q w"]:
        """L column by column, the diagonal first: `L[j + d, j] = band[j, d]`."""
        ...

    def solve(self, right: Float[Tensor, "q c"]) -> Float[Tensor, "q c"]:
        """A^-1 times `right`."""
        ...


@dataclass(frozen=True)
class BandInverse:
    """The inverse of a banded matrix near its diagonal: blocks on it, and those beside them."""

    own: Float[Tensor, "k b b"]
    beside: Float[Tensor, "k b b"]
    """Right of each of them."""

    @classmethod
    def of(cls, factor: BandFactor, reach: int) -> BandInverse:
        """That of a matrix with this factor, as far as `reach` from the diagonal at least.

        With A = L L^T in blocks, from the last one to the first (Takahashi, Fagan and Chen 1973),

            Z_k,k+1 = -G_k^T Z_k+1,k+1        Z_kk = (L_kk L_kk^T)^-1 - Z_k,k+1 G_k        G_k = L_k+1,k L_kk^-1
        """
        band = factor.band
        q, w = band.shape
        b = max(_LEAST_BLOCK, w - 1, reach)
        count, device = -(-q // b), band.device
        own, beside = band.new_zeros(count, b, b), band.new_zeros(count, b, b)
        eye = torch.eye(b).to(band)
        row, column = torch.arange(2 * b, device=device)[:, None], torch.arange(b, device=device)
        back = row - column
        for k in reversed(range(count)):
            at = k * b + column
            inside = (back >= 0) & (back < w) & (k * b + row < q)
            found = band[at.clamp_max(q - 1), back.clamp(0, w - 1)].where(inside, 0.0)
            # Behind the last unknown each stands for itself.
            diagonal = found[:b] + torch.diag((at >= q).to(band))
            inverse = torch.linalg.solve_triangular(diagonal, eye, upper=False)
            torch.mm(inverse.mT, inverse, out=own[k])
            if k + 1 < count:
                G = found[b:] @ inverse
                torch.mm(G.mT, own[k + 1], out=beside[k]).neg_()
                own[k] -= beside[k] @ G
        return cls(own, beside)

    def read(self, row: Int[Tensor, ...], column: Int[Tensor, ...]) -> Float[Tensor, ...]:
        """Entries, rows and columns broadcast, no further from the diagonal than was asked for."""
        b = self.own.shape[1]
        first, last = torch.minimum(row, column), torch.maximum(row, column)
        k, behind = first // b, last // b
        at = first * b + last - behind * b
        same = (k == behind).expand_as(at)
        return torch.where(same, self.own.flatten()[at], self.beside.flatten()[at])


def cholesky_banded(lower: Float[Tensor, "q w"]) -> BandFactor | None:
    """The factor of the matrix with `A[j + d, j] = lower[j, d]`; None if it is not positive definite.

    What `lower` holds of rows behind the last is of no account, and its memory may be reused.
    """
    return _by_lapack(lower) if lower.device.type == "cpu" else _by_blocks(lower)


@dataclass(frozen=True)
class _LapackFactor:
    factor: Float[np.ndarray, "w q"]
    like: Tensor

    @property
    def log_determinant(self) -> Float[Tensor, ""]:
        return self.like.new_tensor(2 * float(np.log(self.factor[0]).sum()))

    @property
    def band(self) -> Float[Tensor, "q w"]:
        return torch.from_numpy(self.factor).T

    def solve(self, right: Float[Tensor, "q c"]) -> Float[Tensor, "q c"]:
        solved = lapack_solve((self.factor, True), right.numpy(), check_finite=False)
        return torch.from_numpy(np.ascontiguousarray(solved))


def _by_lapack(lower: Float[Tensor, "q w"]) -> _LapackFactor | None:
    # Column by column, the diagonal first: LAPACK's lower band storage, transposed.
    stored = lower.detach().numpy().T
    try:
        factor = lapack_factor(stored, lower=True, overwrite_ab=True, check_finite=False)
    except LinAlgError:
        return None
    return _LapackFactor(factor, lower[:0])


@dataclass(frozen=True)
class _BlockFactor:
    block: Float[Tensor, "k b b"]
    """On the diagonal of L."""
    below: Float[Tensor, "k r b"]
    """Under each of them, as far as the band goes."""
    size: int
    """Unknowns; the last block may have more."""
    width: int
    """Of the band."""

    @property
    def log_determinant(self) -> Float[Tensor, ""]:
        return 2 * self.block.diagonal(dim1=-2, dim2=-1).log().sum()

    @property
    def band(self) -> Float[Tensor, "q w"]:
        (_, b, _), device = self.block.shape, self.block.device
        column = torch.arange(self.size, device=device)[:, None]
        k, j = column // b, column % b
        row = j + torch.arange(self.width, device=device)
        whole = torch.cat((self.block, self.below), dim=1)
        inside = (row < whole.shape[1]) & (column - j + row < self.size)
        return whole[k, row.clamp_max(whole.shape[1] - 1), j].where(inside, 0.0)

    def solve(self, right: Float[Tensor, "q c"]) -> Float[Tensor, "q c"]:
        (count, b, _), reach = self.block.shape, self.below.shape[1]
        x = right.new_zeros(count * b + reach, right.shape[1])
        x[: self.size] = right
        for k in range(count):
            here = slice(k * b, k * b + b)
            x[here] = torch.linalg.solve_triangular(self.block[k], x[here], upper=False)
            x[here.stop : here.stop + reach] -= self.below[k] @ x[here]
        for k in range(count - 1, -1, -1):
            here = slice(k * b, k * b + b)
            y = x[here] - self.below[k].mT @ x[here.stop : here.stop + reach]
            x[here] = torch.linalg.solve_triangular(self.block[k].mT, y, upper=True)
        return x[: self.size]


def _by_blocks(lower: Float[Tensor, "q w"]) -> _BlockFactor | None:
    q, w = lower.shape
    b = max(_LEAST_BLOCK, w // 2)
    count, reach = -(-q // b), -(-(w - 1) // b) * b
    # The columns of a block, from its diagonal down as far as the band of its last column goes.
    k, i, j = (
        torch.arange(n, device=lower.device).reshape(shape)
        for n, shape in ((count, (-1, 1, 1)), (b + reach, (-1, 1)), (b, (-1,)))
    )
    column, back = k * b + j, (i - j).expand(count, -1, -1)
    inside = (back >= 0) & (back < w) & (k * b + i < q) & (column < q)
    at = torch.where(inside, column * w + back, 0)
    window = torch.where(inside, lower.flatten()[at], (column >= q) & (back == 0))
    block, below = torch.zeros_like(window[:, :b]), torch.zeros_like(window[:, b:])
    failed = torch.zeros_like(k[:1, 0, 0], dtype=torch.int32)
    for n in range(count):
        block[n], info = torch.linalg.cholesky_ex(window[n, :b])
        failed = failed + info
        below[n] = torch.linalg.solve_triangular(block[n].mT, window[n, b:], upper=True, left=False)
        update = below[n] @ below[n].mT
        for s in range(min(reach // b, count - 1 - n)):
            beyond = slice(s * b, s * b + b)
            window[n + 1 + s, : reach - s * b] -= update[s * b :, beyond]
    return None if bool(failed.any()) else _BlockFactor(block, below, q, w)
