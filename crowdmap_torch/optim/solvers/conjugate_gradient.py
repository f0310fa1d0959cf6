"""The back end for maps too large for a dense matrix of their landmarks: the same step by conjugate gradients.

The Hessian is J^T J of the rows' whitened Jacobians. Leaves, chains and border are eliminated exactly, for they do not
touch each other but through landmarks; with E for all three,

    [ E  B^T ] [ x ]     [ a ]        S = C + D - B E^-1 B^T        S y = -(b - B E^-1 a)
    [ B  C+D ] [ y ] = - [ b ]        x = -E^-1 (a + B^T y)

the Schur complement S on the landmarks is never formed but applied: products with B, B^T and C through the rows' Jacobians,
E^-1 through the factors of the chains. Memory grows with the observations alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.linearize import CHUNK_ROWS, RowBlocks, linearize, sum_of_products
from crowdmap_torch.optim.problem import CostTerm, Problem, Values, Variable
from crowdmap_torch.optim.solvers.assembly import TermRows, assemble
from crowdmap_torch.optim.solvers.chain_schur import (
    UNOBSERVED_FLOOR,
    ChainNormalEquations,
    chain_equations,
)
from crowdmap_torch.optim.solvers.chain_sums import ChainSums
from crowdmap_torch.optim.solvers.elimination import ChainStructure, analyse
from crowdmap_torch.optim.solvers.layout import SparsityPattern
from crowdmap_torch.optim.solvers.normal_equations import (
    DIAGONAL_FLOOR,
    ChainChanges,
    LinearFunctions,
    Step,
    StepPart,
    Tangents,
    failed_step,
    solved_step,
)
from crowdmap_torch.optim.solvers.plan import EliminationPlan


@dataclass
class ConjugateGradientBackend:
    """Preconditioned conjugate gradients on the Schur complement of all that the plan names."""

    plan: EliminationPlan
    tolerance: float = 1e-6
    """The residual, in the preconditioner's norm, that ends the iteration, relative to the first."""
    max_iterations: int = 2000
    samples: int = 64
    """Samples that covariances are estimated from."""
    sample_tolerance: float = 1e-3
    """The tolerance for samples, whose scatter is larger by far than what this leaves."""
    seed: int = 0
    """Of the samples."""
    chunk_rows: int = CHUNK_ROWS
    _pattern: SparsityPattern | None = field(default=None, repr=False)
    _structure: ChainStructure | None = field(default=None, repr=False)

    def assemble(self, problem: Problem, values: Values) -> ConjugateGradientEquations:
        """Normal equations at `values`."""
        structure = self._analysed(problem, values)
        sums = ChainSums(structure, problem, values)
        kept: list[_Jacobians] = []

        def add(chunk: TermRows[_KeptRows]) -> None:
            sums.add(chunk)
            kept.append(_Jacobians(chunk.slots, chunk.blocks.jacobians))

        costs = assemble(problem, values, _linearize_and_keep, add, chunk_rows=self.chunk_rows)
        names = tuple(problem.variables)
        return ConjugateGradientEquations(
            cost=costs.total,
            term_cost=costs.by_term,
            backend=self,
            inner=chain_equations(structure, sums.diagonal(), sums.link, sums.gradient()),
            rows=kept,
            gradient={name: sums.by_variable.gradient(name) for name in names},
            square={name: sums.by_variable.hessian(name) for name in names},
            border=sums.border.get(self.plan.border or "", sums.link[..., :0]),
        )

    def _analysed(self, problem: Problem, values: Values) -> ChainStructure:
        """The order of elimination with the landmarks held; kept as long as the chains are bound alike."""
        names = (*self.plan.first_block, *([] if self.plan.border is None else [self.plan.border]))
        terms = {}
        for name, term in problem.terms.items():
            slots = tuple(slot for slot in term.slots if slot[0] in names)
            if slots:
                terms[name] = replace(term, slots=slots)
        held = Problem({name: problem.variables[name] for name in names}, terms)
        if self._pattern is None or not self._pattern.is_of(held, values):
            # Of the landmarks none is in this problem.
            plan = replace(self.plan, room=None)
            self._structure = analyse(held, values, plan, group_size=None, batch_bytes=1 << 22)
            self._pattern = SparsityPattern.of(held, values)
        assert self._structure is not None
        return self._structure


@dataclass(frozen=True)
class _KeptRows(RowBlocks):
    """The rows' blocks with the Jacobians that they come from."""

    jacobians: tuple[Float[Tensor, "m d _"], ...]
    """Whitened, and weighted by the root of the robust weights."""


def _linearize_and_keep(term: CostTerm, kinds: dict[str, Variable], values: Values) -> _KeptRows:
    linear = linearize(term, kinds, values)
    root = linear.robust_weight.sqrt()
    residual, jacobians = linear.residual * root, [J * root for J in linear.jacobians]
    return _KeptRows(
        linear.rho,
        tuple(sum_of_products(J, residual[:, None])[:, 0] for J in jacobians),
        {
            (i, j): sum_of_products(jacobians[i], jacobians[j])
            for i in range(len(jacobians))
            for j in range(i, len(jacobians))
        },
        tuple(J.permute(2, 0, 1).contiguous() for J in jacobians),
    )


@dataclass(frozen=True)
class _Jacobians:
    """Of a chunk of rows, by slot."""

    slots: tuple[tuple[str, Int[Tensor, " m"]], ...]
    by_slot: tuple[Float[Tensor, "m d _"], ...]

    def apply(self, tangents: Tangents) -> Float[Tensor, "m d c"] | None:
        """J times tangents; None where they touch none of the rows' slots."""
        product = None
        for (name, index), J in zip(self.slots, self.by_slot, strict=True):
            if name in tangents:
                part = J @ tangents[name][index]
                product = part if product is None else product + part
        return product

    def add_transposed(self, residual: Float[Tensor, "m d c"], total: dict[str, Tensor]) -> None:
        """Adds J^T times residuals to the variables of `total`, in place."""
        for (name, index), J in zip(self.slots, self.by_slot, strict=True):
            if name in total:
                # As a matrix: adding blocks of three dimensions takes many times as long.
                total[name].flatten(1).index_add_(0, index, (J.mT @ residual).flatten(1))


@dataclass(frozen=True)
class ConjugateGradientEquations:
    """The quadratic model, as linearised rows and the blocks of its diagonal."""

    cost: Float[Tensor, " 1"]
    term_cost: Mapping[str, Float[Tensor, " 1"]]
    backend: ConjugateGradientBackend
    inner: ChainNormalEquations
    """Leaves and chains, the rest held."""
    rows: list[_Jacobians]
    gradient: Tangents
    square: Tangents
    """Diagonal blocks [n, k, k] of every variable."""
    border: Float[Tensor, "e k b"]
    """Blocks between the eliminated blocks and the border."""

    def solve(self, damping: Float[Tensor, " 1"]) -> Step:
        """The damped step; `solved` is False where the matrix is not positive definite, or too many steps were taken."""
        diagonal = {name: H.diagonal(dim1=1, dim2=2) for name, H in self.square.items()}
        added = {name: damping * d.clamp_min(DIAGONAL_FLOOR) for name, d in diagonal.items()}
        right_side = {name: -g[..., None] for name, g in self.gradient.items()}
        delta = self._solved(right_side, damping, added, self.backend.tolerance)
        if delta is None:
            return failed_step(self.gradient, self.cost)
        step = {name: tangent[..., 0] for name, tangent in delta.items()}
        parts = [StepPart(step[n][None], self.gradient[n][None], added[n][None]) for n in step]
        return solved_step(step, *parts)

    def covariance(self, *, floor: float = UNOBSERVED_FLOOR) -> SampledCovariance:
        """The inverse of the Hessian, estimated from samples; the `floor` keeps landmarks that nothing observes."""
        generator = torch.Generator().manual_seed(self.backend.seed)
        drawn = self.samples(self.backend.samples, generator, floor=floor)
        return SampledCovariance(drawn, self.inner.structure)

    def conditional_covariance(self, name: str) -> Float[Tensor, "n k k"]:
        """Covariance of every block of an eliminated variable, landmarks and border known."""
        return self.inner.conditional_covariance(name)

    def variance_of_changes(self, changes: ChainChanges) -> Float[Tensor, "q m"]:
        """Variances of changes along chains by the last factors, landmarks and border known."""
        return self.inner.variance_of_changes(changes)

    def variance_of_leaves(self) -> Float[Tensor, "l k"]:
        """Variance of each leaf's numbers less those of the block that carries it, landmarks and border known."""
        return self.inner.variance_of_leaves()

    def samples(
        self, count: int, generator: torch.Generator, *, floor: float
    ) -> dict[str, Float[Tensor, "n k count"]]:
        """Tangents drawn from the normal distribution whose covariance is the inverse of the Hessian.

        White noise on the rows, put through the normal equations (Papandreou and Yuille 2010): covariances of a map
        too large for the inverse.
        """
        right_side = {n: g.new_zeros(*g.shape, count) for n, g in self.gradient.items()}
        for rows in self.rows:
            shape = (*rows.by_slot[0].shape[:2], count)
            noise = torch.randn(shape, dtype=self.cost.dtype, generator=generator)
            rows.add_transposed(noise.to(self.cost.device), right_side)
        eliminated = {*self.backend.plan.first_block, self.backend.plan.border}
        added = {
            name: torch.full_like(g, 0.0 if name in eliminated else floor)
            for name, g in self.gradient.items()
        }
        undamped = torch.zeros_like(self.cost)
        drawn = self._solved(right_side, undamped, added, self.backend.sample_tolerance)
        if drawn is None:
            raise ValueError("the map's normal equations are not positive definite")
        return drawn

    def _solved(
        self, right_side: Tangents, damping: Float[Tensor, " 1"], added: Tangents, tolerance: float
    ) -> dict[str, Tensor] | None:
        """Tangents that solve the system for right-hand sides, `added` to its diagonal; None where there are none."""
        factor = self._factorised(damping, added)
        if factor is None:
            return None
        landmarks = [name for name in right_side if name not in factor.names]
        first = factor.solve(right_side)
        of_first = self._applied(first, landmarks)
        reduced = {name: right_side[name] - of_first[name] for name in landmarks}
        y = self._conjugate_gradients(reduced, factor, added, tolerance) if landmarks else {}
        if y is None:
            return None
        coupled = self._applied(y, factor.names)
        x = factor.solve({name: right_side[name] - coupled[name] for name in factor.names})
        return {name: (y if name in y else x)[name] for name in right_side}

    def _factorised(self, damping: Float[Tensor, " 1"], added: Tangents) -> _Eliminated | None:
        """The factors of E; None where it is not positive definite."""
        if self.inner.factorise(*self.inner.damped_by(damping)) is None:
            return None
        name, owner = self.backend.plan.border, self.inner.structure.owner
        if name is None:
            return _Eliminated(self.inner, None, self.border, None)
        solution = self.inner.solve_eliminated(self.border)
        system = self.square[name] + torch.diag_embed(added[name])
        system = system.index_add(0, owner, -self.border.mT @ solution)
        factor, failed = torch.linalg.cholesky_ex(system)
        if bool(failed.any()) or not bool(factor.isfinite().all()):
            return None
        return _Eliminated(self.inner, name, solution, factor)

    def _applied(self, tangents: Tangents, wanted: Sequence[str]) -> dict[str, Tensor]:
        """The Hessian's product with tangents, without its damping, as far as it is wanted."""
        columns = next(iter(tangents.values())).shape[-1] if tangents else 1
        total = {n: self.gradient[n].new_zeros(*self.gradient[n].shape, columns) for n in wanted}
        for rows in self.rows:
            product = rows.apply(tangents)
            if product is not None:
                rows.add_transposed(product, total)
        return total

    def _conjugate_gradients(
        self, right_side: Tangents, eliminated: _Eliminated, added: Tangents, tolerance: float
    ) -> dict[str, Tensor] | None:
        """Landmarks that solve S for right-hand sides, preconditioned by the diagonal blocks of C + D."""
        names = list(right_side)
        factors = {
            n: torch.linalg.cholesky_ex(self.square[n] + torch.diag_embed(added[n])) for n in names
        }
        if any(bool(failed.any()) for _, failed in factors.values()):
            return None

        def preconditioned(residual: Tangents) -> dict[str, Tensor]:
            return {n: torch.cholesky_solve(residual[n], factors[n][0]) for n in names}

        def inner(a: Tangents, b: Tangents) -> Float[Tensor, " c"]:
            return torch.stack([(a[n] * b[n]).sum((0, 1)) for n in names]).sum(0)

        every = [*names, *eliminated.names]
        y = {n: torch.zeros_like(right_side[n]) for n in names}
        residual = {n: right_side[n].clone() for n in names}
        z = preconditioned(residual)
        direction = {n: z[n].clone() for n in names}
        size = inner(residual, z)
        target = tolerance**2 * size
        for _ in range(self.backend.max_iterations):
            if bool((size <= target).all()):
                return y
            product = self._applied(direction, every)
            solution = eliminated.solve({n: product[n] for n in eliminated.names})
            taken = self._applied(solution, names)
            of_S = {n: product[n] - taken[n] + added[n][..., None] * direction[n] for n in names}
            curvature = inner(direction, of_S)
            if not bool(((curvature > 0) | (size <= target)).all()):
                return None
            length = torch.where(size > target, size / curvature, 0.0)
            for n in names:
                y[n] += length * direction[n]
                residual[n] -= length * of_S[n]
            z = preconditioned(residual)
            before, size = size, inner(residual, z)
            share = torch.where(before > target, size / before, 0.0)
            for n in names:
                direction[n].mul_(share).add_(z[n])
        return None


@dataclass(frozen=True)
class _Eliminated:
    """E of leaves, chains and border, factorised: the border is eliminated after the chains, as in `bordered`."""

    inner: ChainNormalEquations
    border: str | None
    solution: Float[Tensor, "e k b"]
    """A^-1 F: the chains' part that follows from the border's."""
    factor: Float[Tensor, "j b b"] | None
    """Cholesky factors of G - F^T A^-1 F, chain by chain."""

    @property
    def names(self) -> list[str]:
        """Its variables."""
        return [*self.inner.structure.plan.first_block, *([self.border] if self.border else [])]

    def solve(self, right_side: Tangents) -> dict[str, Tensor]:
        """E^-1 of right-hand sides, of which those of its own variables count."""
        structure = self.inner.structure
        stacked = structure.stack(right_side)
        x, found = self.inner.solve_eliminated(stacked), {}
        if self.border is not None:
            assert self.factor is not None
            # A^-1 is symmetric: F^T A^-1 of the right-hand side is the solution's product with it.
            of_border = right_side[self.border]
            own = of_border.index_add(0, structure.owner, -self.solution.mT @ stacked)
            found[self.border] = torch.cholesky_solve(own, self.factor)
            x = x - self.solution @ found[self.border][structure.owner]
        return {**found, **structure.unstack(x)}


@dataclass(frozen=True)
class SampledCovariance:
    """The covariance of tangents that were drawn."""

    drawn: Mapping[str, Float[Tensor, "n k s"]]
    structure: ChainStructure

    def of(self, functions: LinearFunctions) -> Float[Tensor, "n m m"]:
        """Covariance of each row's functions."""
        value = self._values(functions)
        return value @ value.mT / value.shape[-1]

    def common(self, functions: LinearFunctions) -> Float[Tensor, "m m"]:
        """What all rows have in common: too few samples to tell to the last, the mean over all pairs is next to it."""
        value = self._values(functions).mean(0)
        return value @ value.mT / value.shape[-1]

    def of_border(self, *names: str) -> Float[Tensor, "n b b"]:
        """Joint covariance of the blocks that variables of the border have of each number, one behind the other."""
        drawn = torch.cat([self.drawn[name] for name in names], dim=1)
        return drawn @ drawn.mT / drawn.shape[-1]

    def of_chain_sums(self, weight: Float[Tensor, "n k m"]) -> Float[Tensor, "j m m"]:
        """Covariance of `m` weighted sums over the blocks of each chain."""
        plan = self.structure.plan
        drawn = self.drawn[plan.chains]
        chains = int(plan.chain.max()) + 1 if len(plan.chain) else 0
        if plan.border is not None:
            chains = len(self.drawn[plan.border])
        sums = drawn.new_zeros(chains, weight.shape[-1], drawn.shape[-1])
        sums.index_add_(0, plan.chain, weight.mT @ drawn)
        return sums @ sums.mT / sums.shape[-1]

    def _values(self, functions: LinearFunctions) -> Float[Tensor, "n m s"]:
        parts = zip(functions.slots, functions.jacobians, strict=True)
        values = [J @ self.drawn[name][block] for (name, block), J in parts]
        return torch.stack(values).sum(0)
