"""The covariance of landmarks, all at once."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.optim.solvers.layout import Layout, read_entries
from crowdmap_torch.optim.solvers.normal_equations import LinearFunctions


@dataclass(frozen=True)
class LandmarkCovariance:
    """The joint covariance of all landmarks, as one dense matrix."""

    matrix: Float[Tensor, "r r"]
    where: Layout

    def of(self, functions: LinearFunctions) -> Float[Tensor, "n m m"]:
        """Covariance of each row's functions of landmarks."""
        at, J = read_entries(functions, self.where)
        return J @ self.matrix[at[:, :, None], at[:, None]] @ J.mT

    def common(self, functions: LinearFunctions) -> Float[Tensor, "m m"]:
        """The largest covariance that can be taken off all rows together, so that what is left is a covariance."""
        at, J = read_entries(functions, self.where)
        joint = self.matrix[at[:, None, :, None], at[None, :, None]]
        joint = (J[:, None] @ joint @ J[None].mT).transpose(1, 2).flatten(2).flatten(0, 1)
        factor = torch.linalg.cholesky(joint)
        alike = torch.eye(J.shape[1]).to(factor).repeat(len(at), 1)
        return torch.linalg.inv(alike.mT @ torch.cholesky_solve(alike, factor))
