"""The covariance of landmarks: what of it is asked for, out of the factors of their reduced system."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.solvers.layout import Layout, read_entries
from crowdmap_torch.optim.solvers.normal_equations import LinearFunctions
from crowdmap_torch.optim.solvers.tiled_cholesky import TiledCholesky

_COLUMNS = 256
"""Functions whose joint covariance is solved for at once; bounds the memory."""


class LandmarkCovariance:
    """The covariance of landmarks as far as they are bound to each other, and of any functions of them."""

    def __init__(
        self, factor: TiledCholesky, where: Layout, is_current: Callable[[], bool]
    ) -> None:
        """`is_current` says whether the factors are there still: others may come into their memory."""
        self.where = where
        self._factor, self._is_current = factor, is_current
        # Of its own: the next factors come where these are.
        self._inverse = factor.selected_inverse()

    def of(self, functions: LinearFunctions) -> Float[Tensor, "n m m"]:
        """Covariance of each row's functions of landmarks, which are bound to each other."""
        at, J = read_entries(functions, self.where)
        return J @ self.entries(at) @ J.mT

    def entries(self, at: Int[Tensor, "n q"]) -> Float[Tensor, "n q q"]:
        """The covariance of tangents, row by row."""
        return self._inverse.read(at[:, :, None], at[:, None])

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
        for rows in torch.arange(n, device=at.device).split(max(_COLUMNS // m, 1)):
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
