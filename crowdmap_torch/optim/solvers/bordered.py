"""The back end for chains that have unknowns of their own or share some: a border around the chains' normal equations.

A journey's constant error touches all its frames, the calibration of a car those of all its journeys. Among the landmarks
they would widen every window, and as a block of the chain they would be neighbours of all. As a border they are
eliminated last:

    [ K    F ] [ u ]     [ k ]        K, k: leaves, chains and landmarks, u = (x, y) of `chain_schur`
    [ F^T  G ] [ z ] = - [ g ]        F: `link` of leaves and chains, `beside` of landmarks   G: `hessian`   g: `gradient`

    T = G - F^T K^-1 F        T z = -(g + F^T u')        u = u' - K^-1 F z        u' = -K^-1 k

Chains touch each other through landmarks and the border alone: one solve with these held gives A^-1 F of all chains, and
K^-1 F takes one more of the reduced system, with the right-hand side B A^-1 F less what of F is the landmarks'.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.problem import Problem, Values
from crowdmap_torch.optim.solvers.chain_schur import (
    UNOBSERVED_FLOOR,
    ChainBackend,
    ChainNormalEquations,
    Factor,
)
from crowdmap_torch.optim.solvers.landmark_covariance import LandmarkCovariance
from crowdmap_torch.optim.solvers.layout import Layout
from crowdmap_torch.optim.solvers.normal_equations import (
    DIAGONAL_FLOOR,
    ChainChanges,
    Step,
    StepPart,
    failed_step,
    solved_step,
)
from crowdmap_torch.optim.solvers.plan import EliminationPlan


class BorderedBackend:
    """Normal equations of a problem of whose plan the border goes last.

    Rows of a term may touch a chain's own block of the border beside blocks of the chain, or alone; and what chains share
    beside anything of theirs.
    """

    def __init__(self, plan: EliminationPlan) -> None:
        if not plan.border_names:
            raise ValueError("the plan has no border: ChainBackend is for chains without one")
        self._chains = ChainBackend(plan)

    def assemble(self, problem: Problem, values: Values) -> BorderedNormalEquations:
        """Normal equations at `values`."""
        inner, sums = self._chains.assemble_with_border(problem, values)
        return BorderedNormalEquations(
            inner=inner,
            link=torch.cat(list(sums.border.values()), dim=-1),
            beside=sums.beside,
            hessian=sums.border_hessian(),
            gradient=sums.border_gradient(),
        )


@dataclass(frozen=True)
class BorderedNormalEquations:
    """The quadratic model: that of the chains and landmarks, and the border's blocks beside it."""

    inner: ChainNormalEquations
    link: Float[Tensor, "e k b"]
    """Blocks of F: each eliminated block with its chain's blocks of the border's variables, one behind the other."""
    beside: Float[Tensor, "r _"]
    """Those of the landmarks with the whole border; without columns where nothing is shared."""
    hessian: Float[Tensor, "z z"]
    gradient: Float[Tensor, " z"]

    @property
    def cost(self) -> Float[Tensor, " 1"]:
        """Cost at the point."""
        return self.inner.cost

    @property
    def term_cost(self) -> Mapping[str, Float[Tensor, " 1"]]:
        """The same by term."""
        return self.inner.term_cost

    @property
    def layout(self) -> Layout:
        """Where the blocks of the border's variables are."""
        return self.inner.structure.border

    def solve(self, damping: Float[Tensor, " 1"]) -> Step:
        """The damped step: that of chains and landmarks with the border held, the border's, and what it changes."""
        held = self.inner.solve(damping)
        still = {**held.delta, **self.layout.unpack(torch.zeros_like(self.gradient)[None])}
        if not bool(held.solved):
            return failed_step(still, self.cost)
        added = damping * self.hessian.diagonal().clamp_min(DIAGONAL_FLOOR)
        reduced = self._reduced(added)
        factor, failed = torch.linalg.cholesky_ex(reduced.T)
        if bool(failed) or not bool(reduced.T.isfinite().all()):
            return failed_step(still, self.cost)
        structure, entry = self.inner.structure, self._entries()
        x = structure.stack(held.delta)
        y = structure.where.pack(held.delta)[0]
        right_side = self.gradient.index_add(
            0, entry.flatten(), self._by_chain(x[..., None])[..., 0].flatten()
        )
        if self.beside.shape[1]:
            right_side = right_side + self.beside.mT @ y
        z = -torch.cholesky_solve(right_side[:, None], factor)[:, 0]
        change = reduced.landmarks @ z
        product = (self.link @ z[entry][structure.owner][..., None])[..., 0]
        product = product + self.inner.couple_back(change)
        x = x - self.inner.solve_eliminated(product[..., None])[..., 0]
        y = y + change
        delta = {**self.inner.unpack(x, y), **self.layout.unpack(z[None])}
        parts = self.inner.step_parts(x, y, *self.inner.damped_by(damping))
        return solved_step(delta, *parts, StepPart(z[None], self.gradient[None], added[None]))

    def covariance(self, *, floor: float = UNOBSERVED_FLOOR) -> BorderedCovariance:
        """Covariances of the landmarks, of the border and of sums over the chains, all else marginalised."""
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

    def variance_of_changes(self, changes: ChainChanges) -> Float[Tensor, "q m"]:
        """Variances of changes along chains by the last factors, landmarks and border known."""
        return self.inner.variance_of_changes(changes)

    def variance_of_leaves(self) -> Float[Tensor, "l k"]:
        """Variance of each leaf's numbers less those of the block that carries it, landmarks and border known."""
        return self.inner.variance_of_leaves()

    def _reduced(self, added: Float[Tensor, " z"]) -> Reduced:
        """The border's own system, by the last factors of the inner one.

        Variable by variable: A^-1 F of all of them is larger than what is solved.
        """
        plan, owner = self.inner.structure.plan, self.inner.structure.owner
        entry, size = self._entries(), len(self.gradient)
        T, coupled, first = self.hessian + torch.diag(added), [], 0
        for name, offset in self.layout.offset.items():
            own = slice(first, first + self.layout.tangent_dim[name])
            x = self.inner.solve_eliminated(self.link[..., own].contiguous())
            block = plan.border_block(name, owner)
            coupled.append(self.inner.couple(x, block, len(offset)).flatten(1))
            at = entry[:, :, None] * size + entry[:, None, own]
            T.view(-1).index_add_(0, at.flatten(), -self._by_chain(x).flatten())
            first = own.stop
        by_landmark = torch.cat(coupled, dim=1)
        if self.beside.shape[1]:
            by_landmark = by_landmark - self.beside
        landmarks = self.inner.solve_reduced(by_landmark)
        return Reduced(T - by_landmark.mT @ landmarks, by_landmark, landmarks)

    def _entries(self) -> Int[Tensor, "j b"]:
        """Where in the border the blocks of every chain are."""
        plan, layout = self.inner.structure.plan, self.layout
        chain = torch.arange(self._chains(), device=self.gradient.device)
        return torch.cat(
            [layout.entries(name, plan.border_block(name, chain)) for name in layout.offset], dim=1
        )

    def _chains(self) -> int:
        """Number of chains, those included that have no block."""
        plan = self.inner.structure.plan
        if plan.border is not None:
            return len(self.layout.offset[plan.border])
        return min(len(block) for block in plan.shared.values())

    def _by_chain(self, x: Float[Tensor, "e k c"]) -> Float[Tensor, "j b c"]:
        """F^T x of leaves and chains, chain by chain."""
        total = x.new_zeros(self._chains(), self.link.shape[-1], x.shape[-1])
        return total.index_add_(0, self.inner.structure.owner, self.link.mT @ x)


@dataclass(frozen=True)
class Reduced:
    """The border's system once chains and landmarks are gone."""

    T: Float[Tensor, "z z"]
    by_landmark: Float[Tensor, "r z"]
    """B A^-1 F, less the landmarks' part of F."""
    landmarks: Float[Tensor, "r z"]
    """S^-1 of it: the landmarks' part of K^-1 F, with the opposite sign."""


@dataclass(frozen=True)
class BorderedCovariance(LandmarkCovariance):
    """The joint covariance of all landmarks; those of the border and of sums over chains are there for the asking."""

    _equations: BorderedNormalEquations
    _held: Float[Tensor, "r r"]
    """S^-1: the landmarks' covariance with the border held."""
    _border: Float[Tensor, "z z"]
    """T^-1."""
    _reduced: Reduced
    _factor: Factor

    def of_border(self, *names: str) -> Float[Tensor, "n b b"]:
        """Joint covariance of the blocks that variables of the border have of each number, one behind the other."""
        layout = self._equations.layout
        entry = torch.cat([layout.entries(name, slice(None)) for name in names], dim=1)
        return self._border[entry[:, :, None], entry[:, None]]

    def of_chain_sums(self, weight: Float[Tensor, "n k m"]) -> Float[Tensor, "j m m"]:
        """Covariance of `m` weighted sums over the blocks of each chain, leaves left out."""
        equations, inner = self._equations, self._equations.inner
        if inner.workspace.factor is not self._factor:
            raise ValueError(
                "the normal equations were solved since; ask for their covariance anew"
            )
        j, m, owner = equations._chains(), weight.shape[-1], inner.structure.owner
        of_leaves = weight.new_zeros(len(owner) - len(weight), *weight.shape[1:])
        full = torch.cat((of_leaves, weight))
        x = inner.solve_eliminated(full)
        by_landmark = inner.couple(x, owner, j).flatten(1)
        own = weight.new_zeros(j, m, m).index_add_(0, owner, full.mT @ x)
        landmarks = self._held @ by_landmark
        by_border = self._reduced.by_landmark.mT @ landmarks
        # Of F^T x every chain's sums have the rows of its own blocks.
        entry, sums = equations._entries(), torch.arange(j * m, device=owner.device).view(j, 1, m)
        at = entry[..., None] * (j * m) + sums
        by_border.view(-1).index_add_(0, at.flatten(), equations._by_chain(x).flatten())
        joint = torch.block_diag(*own) + by_landmark.mT @ landmarks
        joint = joint + by_border.mT @ self._border @ by_border
        every = torch.arange(j, device=owner.device)
        found = joint.view(j, m, j, m)[every, :, every]
        return (found + found.mT) / 2
