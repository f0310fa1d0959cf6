"""The back end for chains of which each has unknowns of its own: a border around the chains' normal equations.

A journey's constant error touches all its frames. Among the landmarks it would widen every window, and as a block of
the chain it would be a neighbour of all. As a border it is eliminated last:

    [ K    F ] [ u ]     [ k ]        K, k: leaves, chains and landmarks, u = (x, y) of `chain_schur`
    [ F^T  G ] [ z ] = - [ g ]        F: `link`, of leaves and chains alone    G: `hessian`    g: `gradient`

    T = G - F^T K^-1 F        T z = -(g + F^T u')        u = u' - K^-1 F z        u' = -K^-1 k

Chains do not touch each other but through landmarks: one solve with these held gives A^-1 F for all chains, and K^-1 F takes
one more of the reduced system, with the right-hand side B A^-1 F.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.optim.problem import Problem, Values
from crowdmap_torch.optim.solvers.chain_schur import (
    UNOBSERVED_FLOOR,
    ChainBackend,
    ChainNormalEquations,
    Factor,
    LandmarkCovariance,
)
from crowdmap_torch.optim.solvers.normal_equations import (
    DIAGONAL_FLOOR,
    Step,
    StepPart,
    failed_step,
    solved_step,
)
from crowdmap_torch.optim.solvers.plan import EliminationPlan


class BorderedBackend:
    """Normal equations of a problem of whose plan the border goes last.

    Rows of a term may touch a block of the border beside blocks of its own chain, or alone.
    """

    def __init__(self, plan: EliminationPlan) -> None:
        if plan.border is None:
            raise ValueError("the plan has no border: ChainBackend is for chains without one")
        self.border, self._chains = plan.border, ChainBackend(plan)

    def assemble(self, problem: Problem, values: Values) -> BorderedNormalEquations:
        """Normal equations at `values`."""
        inner, sums = self._chains.assemble_with_border(problem, values)
        return BorderedNormalEquations(
            inner=inner,
            border=self.border,
            link=sums.border,
            hessian=sums.by_variable.hessian(self.border),
            gradient=sums.by_variable.gradient(self.border),
        )


@dataclass(frozen=True)
class BorderedNormalEquations:
    """The quadratic model: that of the chains and landmarks, and the border's blocks beside it."""

    inner: ChainNormalEquations
    border: str
    link: Float[Tensor, "e k b"]
    """Blocks of F: each eliminated block with its own chain's block of the border."""
    hessian: Float[Tensor, "j b b"]
    gradient: Float[Tensor, "j b"]

    @property
    def cost(self) -> Float[Tensor, " 1"]:
        """Cost at the point."""
        return self.inner.cost

    @property
    def term_cost(self) -> Mapping[str, Float[Tensor, " 1"]]:
        """The same by term."""
        return self.inner.term_cost

    def solve(self, damping: Float[Tensor, " 1"]) -> Step:
        """The damped step: that of chains and landmarks with the border held, the border's, and what it changes."""
        held = self.inner.solve(damping)
        still = {**held.delta, self.border: torch.zeros_like(self.gradient)}
        if not bool(held.solved):
            return failed_step(still, self.cost)
        added = damping * self.hessian.diagonal(dim1=-2, dim2=-1).clamp_min(DIAGONAL_FLOOR)
        reduced = self._reduced(added)
        factor, failed = torch.linalg.cholesky_ex(reduced.T)
        if bool(failed) or not bool(reduced.T.isfinite().all()):
            return failed_step(still, self.cost)
        structure = self.inner.structure
        x = torch.cat([held.delta[name] for name in structure.plan.first_block])
        y = structure.where.pack(held.delta)[0]
        right_side = self.gradient + self._by_border(x[..., None])[..., 0]
        z = -torch.cholesky_solve(right_side.reshape(-1, 1), factor)[:, 0].view_as(right_side)
        change = reduced.landmarks @ z.flatten()
        product = (self.link @ z[structure.owner][..., None])[..., 0]
        product = product + self.inner.couple_back(change)
        x = x - self.inner.solve_eliminated(product[..., None])[..., 0]
        y = y + change
        delta = {**self.inner.unpack(x, y), self.border: z}
        parts = self.inner.step_parts(x, y, *self.inner.damped_by(damping))
        return solved_step(delta, *parts, StepPart(z[None], self.gradient[None], added[None]))

    def covariance(self, *, floor: float = UNOBSERVED_FLOOR) -> BorderedCovariance:
        """Covariances of the landmarks and of sums over the chains, all else marginalised."""
        held = self.inner.covariance(floor=floor)
        reduced = self._reduced(torch.zeros_like(self.gradient))
        border = torch.linalg.inv(reduced.T)
        matrix = held.matrix + reduced.landmarks @ border @ reduced.landmarks.mT
        factor = self.inner.workspace.factor
        assert factor is not None
        return BorderedCovariance(matrix, held.where, self, held.matrix, border, reduced, factor)

    def conditional_covariance(self, name: str) -> Float[Tensor, "n k k"]:
        """Covariance of every block of an eliminated variable, landmarks and border known."""
        return self.inner.conditional_covariance(name)

    def _reduced(self, added: Float[Tensor, "j b"]) -> Reduced:
        """The border's own system, by the last factors of the inner one."""
        x = self.inner.solve_eliminated(self.link)
        by_landmark = self.inner.couple(x, self.inner.structure.owner, len(self.hessian)).flatten(1)
        landmarks = self.inner.solve_reduced(by_landmark)
        own = self.hessian + torch.diag_embed(added) - self._by_border(x)
        T = torch.block_diag(*own) - by_landmark.mT @ landmarks
        return Reduced(T, by_landmark, landmarks)

    def _by_border(self, x: Float[Tensor, "e k c"]) -> Float[Tensor, "j b c"]:
        """F^T x, chain by chain."""
        total = x.new_zeros(*self.gradient.shape, x.shape[-1])
        return total.index_add_(0, self.inner.structure.owner, self.link.mT @ x)


@dataclass(frozen=True)
class Reduced:
    """The border's system once chains and landmarks are gone."""

    T: Float[Tensor, "jb jb"]
    by_landmark: Float[Tensor, "r jb"]
    """B A^-1 F."""
    landmarks: Float[Tensor, "r jb"]
    """S^-1 B A^-1 F: the landmarks' part of K^-1 F, with the opposite sign."""


@dataclass(frozen=True)
class BorderedCovariance(LandmarkCovariance):
    """The joint covariance of all landmarks; those of sums over chains are worked out when they are asked for."""

    _equations: BorderedNormalEquations
    _held: Float[Tensor, "r r"]
    """S^-1: the landmarks' covariance with the border held."""
    _border: Float[Tensor, "jb jb"]
    """T^-1."""
    _reduced: Reduced
    _factor: Factor

    def of_chain_sums(self, weight: Float[Tensor, "n k m"]) -> Float[Tensor, "j m m"]:
        """Covariance of `m` weighted sums over the blocks of each chain, leaves left out."""
        equations, inner = self._equations, self._equations.inner
        if inner.workspace.factor is not self._factor:
            raise ValueError(
                "the normal equations were solved since; ask for their covariance anew"
            )
        j, m, owner = len(equations.hessian), weight.shape[-1], inner.structure.owner
        of_leaves = weight.new_zeros(len(owner) - len(weight), *weight.shape[1:])
        full = torch.cat((of_leaves, weight))
        x = inner.solve_eliminated(full)
        by_landmark = inner.couple(x, owner, j).flatten(1)
        own = weight.new_zeros(j, m, m).index_add_(0, owner, full.mT @ x)
        landmarks = self._held @ by_landmark
        by_border = torch.block_diag(*equations._by_border(x))
        by_border = by_border + self._reduced.by_landmark.mT @ landmarks
        joint = torch.block_diag(*own) + by_landmark.mT @ landmarks
        joint = joint + by_border.mT @ self._border @ by_border
        every = torch.arange(j, device=owner.device)
        found = joint.view(j, m, j, m)[every, :, every]
        return (found + found.mT) / 2
