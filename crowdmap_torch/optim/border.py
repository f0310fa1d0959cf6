"""The back end for chains of which each has unknowns of its own: a border around the chains' normal equations.

A journey's constant error touches all its frames. Among the landmarks it would widen every window, and as a block of
the chain it would be a neighbour of all. As a border it is eliminated last: one solve with the landmarks held serves all
chains at once, since they do not touch each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.chain import ChainBackend, ChainNormalEquations
from crowdmap_torch.optim.linear import DIAGONAL_FLOOR, Step, unpack
from crowdmap_torch.optim.linearize import linearize
from crowdmap_torch.optim.problem import CostTerm, Problem, Values


@dataclass(frozen=True)
class BorderedBackend:
    """Normal equations of a problem whose variable `border` has one block per chain of `inner`.

    Rows of a term may touch the border's block as their last slot, beside blocks of its own chain, or alone.
    """

    inner: ChainBackend
    border: str

    def assemble(self, problem: Problem, values: Values) -> BorderedNormalEquations:
        """Normal equations at `values`."""
        name, kinds = self.border, dict(problem.variables)
        bordered = {n: t for n, t in problem.terms.items() if any(s == name for s, _ in t.slots)}
        held = {
            n: _with_last_slot_held(t, values) if n in bordered else t
            for n, t in problem.terms.items()
            if n not in bordered or len(t.slots) > 1
        }
        others = {n: kind for n, kind in problem.variables.items() if n != name}
        within = {n: value for n, value in values.items() if n != name}
        inner = self.inner.assemble(Problem(others, held), within)
        structure = inner.structure
        blocks, k = len(values[name]), kinds[name].tangent_dim
        link = inner.diagonal.new_zeros(len(structure.chain), inner.diagonal.shape[-1], k)
        hessian = link.new_zeros(blocks, k, k)
        gradient = link.new_zeros(blocks, k)
        own_cost = {}
        for term_name, term in bordered.items():
            rows = linearize(term, kinds, values)
            *of_chain, own = rows.jacobians
            weighted = rows.robust_weight[:, None, None] * own
            at = term.slots[-1][1]
            hessian.index_add_(0, at, weighted.mT @ own)
            gradient.index_add_(0, at, (weighted.mT @ rows.residual[..., None])[..., 0])
            for (slot, index), J in zip(term.slots, of_chain, strict=False):
                link.index_add_(0, index + structure.base[slot], J.mT @ weighted)
            own_cost[term_name] = rows.rho.sum()[None] / 2
        term_cost = {n: (own_cost if n in bordered else inner.term_cost)[n] for n in problem.terms}
        owner = structure.chain.clone()
        leaves = len(structure.carrier)
        owner[:leaves] = structure.chain[structure.carrier + leaves]
        return BorderedNormalEquations(
            torch.stack(list(term_cost.values())).sum(0),
            term_cost,
            inner,
            name,
            owner,
            link,
            hessian,
            gradient,
        )


def _with_last_slot_held(term: CostTerm, values: Values) -> CostTerm:
    """The same rows without their last slot, whose blocks are constants at their value."""
    name, index = term.slots[-1]
    jacobian = term.jacobian
    assert jacobian is not None and term.batched is None and term.normal is None

    def without_last(*blocks: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        residual, jacobians = jacobian(*blocks)
        return residual, jacobians[:-1]

    return replace(
        term,
        slots=term.slots[:-1],
        constants=(values[name][index], *term.constants),
        jacobian=without_last,
    )


@dataclass(frozen=True)
class BorderedNormalEquations:
    """The quadratic model: that of the chains and landmarks, and the border's blocks beside it."""

    cost: Float[Tensor, " 1"]
    term_cost: Mapping[str, Float[Tensor, " 1"]]
    inner: ChainNormalEquations
    border: str
    owner: Int[Tensor, " n"]
    """Block of the border that each eliminated block belongs to."""
    link: Float[Tensor, "n k b"]
    """Blocks between the eliminated blocks and their own block of the border."""
    hessian: Float[Tensor, "j b b"]
    gradient: Float[Tensor, "j b"]

    def solve(self, damping: Float[Tensor, " 1"]) -> Step:
        """The damped step: that of the chains with the border held, the border's, and what it changes."""
        step = self.inner.solve(damping)
        nothing = torch.zeros_like(self.gradient)
        if not bool(step.solved):
            return replace(step, delta={**step.delta, self.border: nothing})
        added = damping[0] * self._diagonal().clamp_min(DIAGONAL_FLOOR)
        system = self._reduced(torch.diag_embed(added))
        factor, failed = torch.linalg.cholesky_ex(system.matrix)
        if bool(failed) or not bool(system.matrix.isfinite().all()):
            still = {name: torch.zeros_like(delta) for name, delta in step.delta.items()}
            zero = torch.zeros_like(step.predicted)
            return Step({**still, self.border: nothing}, zero, zero > 0, zero)
        held = torch.cat([step.delta[name] for name in self.inner.structure.base])
        force = self.gradient + self._by_border(held[..., None])[..., 0]
        own = -torch.cholesky_solve(force.reshape(-1, 1), factor)[:, 0].view_as(force)
        marks = system.answer @ own.flatten()
        pushed = (self.link @ own[self.owner][..., None])[..., 0] + self.inner.by_block(marks)
        chain = held - self.inner.solve_chains(pushed[..., None])[..., 0]
        change = unpack(marks[None], self.inner.structure.where)
        delta = {name: step.delta[name] + tangent for name, tangent in change.items()}
        delta.update(self.inner.unstack(chain))
        return self._finished(delta, own, damping[0])

    def covariances(
        self,
        weight: Float[Tensor, "n k m"] | None = None,
        *,
        floor: float = 1e-9,
    ) -> Covariances:
        """Covariances of the landmarks, and of `m` weighted sums over each chain's blocks, jointly over the chains.

        `weight` is by block of the chain, leaves left out; None: the landmarks' covariance alone.
        """
        held = self.inner.marginal_covariance(floor=floor)
        system = self._reduced(torch.zeros_like(self.hessian))
        border = torch.linalg.inv(system.matrix)
        landmarks = held + system.answer @ border @ system.answer.mT
        if weight is None:
            return Covariances(landmarks, border, None)
        j, m = len(self.hessian), weight.shape[-1]
        of_leaves = weight.new_zeros(len(self.owner) - len(weight), *weight.shape[1:])
        full = torch.cat((of_leaves, weight))
        moved = self.inner.solve_chains(full)
        seen = self.inner.by_landmark(moved, self.owner, j).flatten(1)
        own = weight.new_zeros(j, m, m).index_add_(0, self.owner, full.mT @ moved)
        by_border = torch.block_diag(*self._by_border(moved)) + system.seen.mT @ (held @ seen)
        sums = torch.block_diag(*own) + seen.mT @ (held @ seen)
        sums = sums + by_border.mT @ border @ by_border
        return Covariances(landmarks, border, (sums + sums.mT) / 2)

    def _reduced(self, added: Float[Tensor, "j b b"]) -> _Reduced:
        """The border's own system, by the factors of the inner system's last solve."""
        moved = self.inner.solve_chains(self.link)
        seen = self.inner.by_landmark(moved, self.owner, len(self.hessian)).flatten(1)
        answer = self.inner.solve_reduced(seen)
        own = self.hessian + added - self._by_border(moved)
        return _Reduced(torch.block_diag(*own) - seen.mT @ answer, seen, answer)

    def _by_border(self, moved: Float[Tensor, "n k m"]) -> Float[Tensor, "j b m"]:
        """What moved eliminated blocks add to the border's gradient."""
        total = moved.new_zeros(*self.gradient.shape, moved.shape[-1])
        return total.index_add_(0, self.owner, self.link.mT @ moved)

    def _diagonal(self) -> Float[Tensor, "j b"]:
        return self.hessian.diagonal(dim1=-2, dim2=-1)

    def _finished(self, delta: dict[str, Tensor], own: Tensor, scale: Tensor) -> Step:
        """The step with what the model predicts of it."""
        inner = self.inner
        chain = torch.cat([delta[name] for name in inner.structure.base])
        packed = torch.zeros_like(inner.gradient)
        where = inner.structure.where
        for name, offset in where.offset.items():
            at = offset[:, None] + torch.arange(where.tangent_dim[name], device=offset.device)
            packed[at] = delta[name]
        along = (inner.chain_gradient * chain).sum() + inner.gradient @ packed
        along = along + (self.gradient * own).sum()
        squares = (
            (inner.diagonal.diagonal(dim1=-2, dim2=-1), chain),
            (inner.hessian.diagonal(), packed),
            (self._diagonal(), own),
        )
        damped = [(d.clamp_min(DIAGONAL_FLOOR) * step.square()).sum() for d, step in squares]
        predicted = (scale * torch.stack(damped).sum() - along) / 2
        norm = (chain.square().sum() + packed.square().sum() + own.square().sum()).sqrt()
        delta[self.border] = own
        return Step(delta, predicted[None], norm.isfinite()[None], norm[None])


@dataclass(frozen=True)
class _Reduced:
    """The border's system once chains and landmarks are gone."""

    matrix: Float[Tensor, "jb jb"]
    seen: Float[Tensor, "r jb"]
    """What the border's unit steps, the chains following, add to the landmarks' gradient."""
    answer: Float[Tensor, "r jb"]
    """The landmarks' steps that follow, with the opposite sign."""


@dataclass(frozen=True)
class Covariances:
    """Covariances without an inverse of the whole."""

    landmarks: Float[Tensor, "r r"]
    border: Float[Tensor, "jb jb"]
    """Of the border's blocks, jointly."""
    sums: Float[Tensor, "jm jm"] | None
    """Of the weighted sums over each chain."""
