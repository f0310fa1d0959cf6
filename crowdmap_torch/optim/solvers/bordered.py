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
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.problem import Problem, Values
from crowdmap_torch.optim.solvers.block_elimination import Lead
from crowdmap_torch.optim.solvers.chain_schur import (
    UNOBSERVED_FLOOR,
    ChainBackend,
    ChainNormalEquations,
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
from crowdmap_torch.optim.solvers.parts import Part
from crowdmap_torch.optim.solvers.plan import EliminationPlan
from crowdmap_torch.processes.threads import in_order


class BorderedBackend:
    """Normal equations of a problem of whose plan the border goes last.

    Rows of a term may touch a chain's blocks of the border beside anything of theirs, or alone.
    """

    def __init__(self, plan: EliminationPlan) -> None:
        if not plan.border:
            raise ValueError("the plan has no border: ChainBackend is for chains without one")
        self._chains = ChainBackend(plan)

    def prepare(self, problem: Problem, values: Values) -> None:
        """Finds the order of elimination of such a problem, and takes the memory for it."""
        self._chains.prepare(problem, values)

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
    """Those of the landmarks with the whole border."""
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
        """The damped step: the border's first, then the landmarks' and the chains'."""
        inner = self.inner
        added_x, added_y = inner.damped_by(damping)
        right_side = inner.factorise(added_x, added_y)
        if right_side is None:
            return self._failed()
        added = damping * self.hessian.diagonal().clamp_min(DIAGONAL_FLOOR)
        reduced = self._reduced(added)
        factor, failed = torch.linalg.cholesky_ex(reduced.T)
        if bool(failed) or not bool(reduced.T.isfinite().all()):
            return self._failed()
        # With the border held, F^T u' is -F^T A^-1 a less what landmarks take by B A^-1 F.
        held = -inner.solve_reduced(right_side[:, None])[:, 0]
        of_border = self.gradient - reduced.gradient - reduced.by_landmark.mT @ held
        z = -torch.cholesky_solve(of_border[:, None], factor)[:, 0]
        y = held + reduced.landmarks @ z
        of_chain = z[self._entries()][inner.structure.owner]
        linked = inner.eliminated_gradient + (self.link @ of_chain[..., None])[..., 0]
        x = inner.substitute(y, linked)
        delta = {**inner.unpack(x, y), **self.layout.unpack(z[None])}
        parts = inner.step_parts(x, y, added_x, added_y)
        last = (StepPart.alone(y, right_side), StepPart.alone(z, self.gradient - reduced.gradient))
        count = inner.structure.where.used.sum(1).to(z) + len(z)
        border = StepPart(z[None], self.gradient[None], added[None])
        return solved_step(delta, *parts, border, last=last, count=count)

    def _failed(self) -> Step:
        inner, nothing = self.inner, torch.zeros_like(self.gradient)
        still = inner.unpack(inner.eliminated_gradient, inner.gradient)
        return failed_step({**still, **self.layout.unpack(nothing[None])}, self.cost)

    def covariance(self, *, floor: float = UNOBSERVED_FLOOR) -> BorderedCovariance:
        """Covariances of the landmarks, of the border and of sums over the chains, all else marginalised."""
        held = self.inner.covariance(floor=floor)
        reduced = self._reduced(torch.zeros_like(self.gradient))
        return BorderedCovariance(self, held, reduced)

    def conditional_covariance(self, name: str) -> Float[Tensor, "n k k"]:
        """Covariance of every block of an eliminated variable, landmarks and border known."""
        return self.inner.conditional_covariance(name)

    def variance_of_changes(self, changes: ChainChanges) -> Float[Tensor, "q m"]:
        """Variances of changes along chains, landmarks and border known."""
        return self.inner.variance_of_changes(changes)

    def variance_of_leaves(self) -> Float[Tensor, "l k"]:
        """Variance of each leaf's numbers less those of the block that carries it, landmarks and border known."""
        return self.inner.variance_of_leaves()

    def _reduced(self, added: Float[Tensor, " z"]) -> Reduced:
        """The border's own system, by the last factors of the inner one.

        Part by part and variable by variable: A^-1 F of all of them is larger than what is solved.
        """
        inner, entry, size = self.inner, self._entries(), len(self.gradient)
        owner, border = inner.structure.owner, inner.structure.plan.border
        own, first = {}, 0
        for name in self.layout.offset:
            own[name] = slice(first, first + self.layout.tangent_dim[name])
            first = own[name].stop

        def through(of: tuple[Part, tuple[Lead, ...], str]) -> tuple[Through, Float[Tensor, "j c"]]:
            part, leads, name = of
            block, chain = part.block, owner[part.block]
            seen, column = torch.unique(border[name][chain], return_inverse=True)
            right_side = self.link[block][..., own[name]]
            found = self._through(part, leads, right_side, column, len(seen))
            found = replace(found, border=seen)
            told = (found.x.mT @ inner.eliminated_gradient[block][..., None])[..., 0]
            by_chain = told.new_zeros(len(entry), told.shape[1]).index_add_(0, chain, told)
            return replace(found, x=found.x[:0]), by_chain

        every = [(*of, name) for name in own for of in inner.by_part()]
        T, gradient = self.hessian + torch.diag(added), torch.zeros_like(self.gradient)
        coupled = {
            name: self.beside.new_zeros(
                len(self.beside), len(offset) * self.layout.tangent_dim[name]
            )
            for name, offset in self.layout.offset.items()
        }
        for (*_, name), (found, told) in zip(
            every, in_order(through, every, T.device, worth=1), strict=True
        ):
            wide = self.layout.tangent_dim[name]
            by_block = found.by_landmark.unflatten(1, (-1, wide))
            coupled[name].unflatten(1, (-1, wide)).index_add_(1, found.border, by_block)
            at = entry[:, :, None] * size + entry[:, None, own[name]]
            T.view(-1).index_add_(0, at.flatten(), -found.by_chain.flatten())
            gradient.index_add_(0, entry[:, own[name]].flatten(), told.flatten())
        by_landmark = torch.cat(list(coupled.values()), dim=1)
        by_landmark = by_landmark - self.beside
        landmarks = inner.solve_reduced(by_landmark)
        return Reduced(T - by_landmark.mT @ landmarks, by_landmark, landmarks, gradient)

    def _entries(self) -> Int[Tensor, "j b"]:
        """Where in the border the blocks of every chain are."""
        border = self.inner.structure.plan.border
        parts = [self.layout.entries(name, border[name]) for name in self.layout.offset]
        return torch.cat(parts, dim=1)

    def _through(
        self,
        part: Part,
        leads: tuple[Lead, ...],
        right_side: Float[Tensor, "n k c"],
        column: Int[Tensor, " n"],
        columns: int,
    ) -> Through:
        """A^-1 of right-hand sides of a part's blocks, and what it is to others; `column` is that of each in the sums."""
        structure = self.inner.structure
        x = part.solve(leads, right_side)
        by_chain = x.new_zeros(structure.plan.chain_count, self.link.shape[-1], x.shape[-1])
        by_chain.index_add_(0, structure.owner[part.block], self.link[part.block].mT @ x)
        by_landmark = self.inner.couple(part, x, column, columns).flatten(1)
        return Through(x, by_landmark, by_chain, torch.arange(columns, device=x.device))


@dataclass(frozen=True)
class Through:
    """What right-hand sides of a part are to the landmarks and to the border, by way of its chains."""

    x: Float[Tensor, "n k c"]
    """A^-1 of them."""
    by_landmark: Float[Tensor, "r _"]
    """B x, column by column."""
    by_chain: Float[Tensor, "j b c"]
    """F^T x, chain by chain."""
    border: Int[Tensor, " blocks"]
    """The blocks of the border that the columns are of."""


@dataclass(frozen=True)
class Reduced:
    """The border's system once chains and landmarks are gone."""

    T: Float[Tensor, "z z"]
    by_landmark: Float[Tensor, "r z"]
    """B A^-1 F, less the landmarks' part of F."""
    landmarks: Float[Tensor, "r z"]
    """S^-1 of it: the landmarks' part of K^-1 F, with the opposite sign."""
    gradient: Float[Tensor, " z"]
    """F^T A^-1 a: what the border is told by the chains alone."""


class BorderedCovariance(LandmarkCovariance):
    """The covariance of landmarks; those of the border and of sums over chains are there for the asking."""

    def __init__(
        self, equations: BorderedNormalEquations, held: LandmarkCovariance, reduced: Reduced
    ) -> None:
        """`held` is that of the landmarks with the border held."""
        self.where = held.where
        self._equations, self._held, self._reduced = equations, held, reduced
        self._border = torch.linalg.inv(reduced.T)

    def entries(self, at: Int[Tensor, "n q"]) -> Float[Tensor, "n q q"]:
        """The covariance of tangents, row by row."""
        through = self._reduced.landmarks[at]
        return self._held.entries(at) + through @ self._border @ through.mT

    def solve(self, right_side: Float[Tensor, "r c"]) -> Float[Tensor, "r c"]:
        """The covariance times right-hand sides; ValueError where the factors are there no more."""
        through = self._reduced.landmarks
        return self._held.solve(right_side) + through @ (self._border @ (through.mT @ right_side))

    def of_border(self, *names: str) -> Float[Tensor, "n b b"]:
        """Joint covariance of the blocks that variables of the border have of each number, one behind the other."""
        layout = self._equations.layout
        entry = torch.cat([layout.entries(name, slice(None)) for name in names], dim=1)
        return self._border[entry[:, :, None], entry[:, None]]

    def of_border_mean(self, name: str) -> Float[Tensor, "k k"]:
        """Covariance of the mean over all blocks of a variable of the border."""
        entry = self._equations.layout.entries(name, slice(None))
        mean = self._border.new_zeros(len(self._border), entry.shape[1])
        mean[entry, torch.arange(entry.shape[1], device=entry.device)] = 1 / max(len(entry), 1)
        return mean.mT @ self._border @ mean

    def of_sums(
        self, weight: Float[Tensor, "n k m"], of: Int[Tensor, " chains"], count: int
    ) -> Float[Tensor, "j m m"]:
        """Covariance of `m` weighted sums over chains' blocks, leaves left out; `of` says of which of them each chain is."""
        equations, inner = self._equations, self._equations.inner
        j, m, owner = count, weight.shape[-1], inner.structure.owner
        of_leaves = weight.new_zeros(len(owner) - len(weight), *weight.shape[1:])
        full, every = torch.cat((of_leaves, weight)), inner.by_part()

        def through(one: tuple[Part, tuple[Lead, ...]]) -> tuple[Through, Float[Tensor, "n m m"]]:
            part, leads = one
            own = full[part.block]
            found = equations._through(part, leads, own, of[owner[part.block]], j)
            return found, own.mT @ found.x

        own = weight.new_zeros(j, m, m)
        by_landmark = weight.new_zeros(len(equations.beside), j * m)
        by_chain = weight.new_zeros(len(of), equations.link.shape[-1], m)
        done = in_order(through, every, weight.device, worth=1)
        for (part, _), (found, sums) in zip(every, done, strict=True):
            by_landmark += found.by_landmark
            by_chain += found.by_chain
            own.index_add_(0, of[owner[part.block]], sums)
        landmarks = self._held.solve(by_landmark)
        by_border = self._reduced.by_landmark.mT @ landmarks
        # Of F^T x the sums that a chain is of have the rows of its own blocks.
        entry, sums = equations._entries(), of[:, None] * m + torch.arange(m, device=of.device)
        at = entry[..., None] * (j * m) + sums[:, None]
        by_border.view(-1).index_add_(0, at.flatten(), by_chain.flatten())
        joint = torch.block_diag(*own) + by_landmark.mT @ landmarks
        joint = joint + by_border.mT @ self._border @ by_border
        every = torch.arange(j, device=owner.device)
        found = joint.view(j, m, j, m)[every, :, every]
        return (found + found.mT) / 2
