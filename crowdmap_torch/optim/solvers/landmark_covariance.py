"""The covariance of what stays, landmarks and border: what of it is asked for, out of the factors of the reduced system."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.solvers.border import COLUMNS_AT_ONCE, Sums
from crowdmap_torch.optim.solvers.layout import Layout, read_entries
from crowdmap_torch.optim.solvers.normal_equations import LinearFunctions
from crowdmap_torch.optim.solvers.sparse_tiles import TileMatrix
from crowdmap_torch.optim.solvers.tiled_cholesky import TiledCholesky
from crowdmap_torch.processes.at_rest import rest

SumsOfChains = Callable[[Tensor, Tensor, int], Sums | None]


class LandmarkCovariance:
    """The covariance of landmarks and border as far as they are bound to each other, and of any functions of them.

    Of sums over chains too; chains and leaves are marginalised.
    """

    def __init__(
        self,
        where: Layout,
        factor: TiledCholesky,
        sums: SumsOfChains,
        is_current: Callable[[], bool],
    ) -> None:
        """`sums` are the `weighted_sums` of the chains.

        `is_current` says whether the factors are there still: others may come into their memory. What landmarks have by
        themselves, asked for once before then, is known afterwards too.
        """
        self.where = where
        self._factor, self._sums, self._is_current = factor, sums, is_current

    def resting(self) -> LandmarkCovariance:
        """The same, its factors in a file: while the inverse is made, which is as large, they take no memory.

        Of sums over chains it tells nothing more.
        """
        self._check()
        upper = self._factor.upper
        upper = replace(upper, flat=rest(upper.flat))
        return LandmarkCovariance(
            self.where, TiledCholesky(upper), lambda *_: None, is_current=lambda: True
        )

    @cached_property
    def _inverse(self) -> TileMatrix:
        """When it is first asked for: as large as the factors, and those of drives may be gone by then."""
        self._check()
        return self._factor.selected_inverse()

    def of(self, functions: LinearFunctions) -> Float[Tensor, "n m m"]:
        """Covariance of each row's functions of landmarks, which are bound to each other."""
        at, J = read_entries(functions, self.where)
        return J @ self.entries(at) @ J.mT

    def entries(self, at: Int[Tensor, "n q"]) -> Float[Tensor, "n q q"]:
        """The covariance of tangents, row by row."""
        return self._inverse.read(at[:, :, None], at[:, None])

    def of_border(self, *names: str) -> Float[Tensor, "n b b"]:
        """Joint covariance of the blocks that variables of the border have of each number, one behind the other."""
        return self.entries(torch.cat([self.where.entries(n, slice(None)) for n in names], dim=1))

    def of_border_mean(self, name: str) -> Float[Tensor, "k k"]:
        """Covariance of the mean over all blocks of a variable of the border."""
        entry = self.where.entries(name, slice(None))
        joint = self._inverse.read(entry[:, None, :, None], entry[None, :, None])
        return joint.sum((0, 1)) / max(len(entry), 1) ** 2

    def of_sums(
        self, weight: Float[Tensor, "n k m"], of: Int[Tensor, " chains"], count: int
    ) -> Float[Tensor, "j m m"]:
        """Covariance of `m` weighted sums over chains' blocks, leaves left out; `of` says of which of them each chain is.

        ValueError where the factors are there no more.
        """
        self._check()
        told = self._sums(weight, of, count)
        assert told is not None, "asked of who has the chains"
        known, sums = told
        return known + sums.variance(self._factor, count)

    def solve(self, right_side: Float[Tensor, "r c"]) -> Float[Tensor, "r c"]:
        """The covariance times right-hand sides; ValueError where the factors are there no more."""
        self._check()
        return self._factor.solve(right_side)

    def _check(self) -> None:
        if not self._is_current():
            raise ValueError(
                "the normal equations were solved since; ask for their covariance anew"
            )

    def common(self, functions: LinearFunctions) -> Float[Tensor, "m m"]:
        """The largest covariance that can be taken off all rows together, so that what is left is a covariance."""
        at, J = read_entries(functions, self.where)
        n, m, _ = J.shape
        joint = J.new_zeros(n, m, n, m)
        for rows in torch.arange(n, device=at.device).split(max(COLUMNS_AT_ONCE // m, 1)):
            number = torch.arange(len(rows) * m, device=at.device).view(-1, m, 1)
            function = J.new_zeros(self.where.dim, len(rows) * m)
            entry = at[rows][:, None].expand_as(J[rows])
            function.index_put_((entry, number.expand_as(entry)), J[rows], accumulate=True)
            solved = self.solve(function)
            joint[:, :, rows] = (J @ solved[at]).unflatten(2, (len(rows), m))
        joint = joint.view(n * m, n * m)
        factor = torch.linalg.cholesky((joint + joint.mT) / 2)
        alike = torch.eye(m).to(factor).repeat(n, 1)
        return torch.linalg.inv(alike.mT @ torch.cholesky_solve(alike, factor))
