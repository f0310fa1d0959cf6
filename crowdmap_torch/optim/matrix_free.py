"""The back end for maps too large for a dense matrix of their landmarks: the same step by conjugate gradients.

Chains are eliminated as ever, for they do not touch each other; what is left, the Schur complement on the landmarks, is
never formed but applied: through the rows' Jacobians, and through the factors of the chains. Memory grows with the
observations alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.chain import ChainNormalEquations, chain_equations
from crowdmap_torch.optim.chain_structure import ChainStructure, analyse
from crowdmap_torch.optim.chain_sums import add_link, same_rows
from crowdmap_torch.optim.linear import DIAGONAL_FLOOR, Step
from crowdmap_torch.optim.linearize import CHUNK_ROWS, chunks, linearize
from crowdmap_torch.optim.problem import Problem, Values

Tangents = Mapping[str, Tensor]
"""Several tangents of every block at once, `[n, k, c]` by variable."""


@dataclass
class MatrixFreeBackend:
    """Preconditioned conjugate gradients on the Schur complement of the chains, and of the border, if there is one."""

    eliminate: str
    chain: Int[Tensor, " n"]
    """Chain of every block of the eliminated variable; the blocks of a chain are adjacent and in order."""
    leaves: str | None = None
    """Variable whose blocks are bound to one block of the chain each."""
    carrier: Int[Tensor, " m"] | None = None
    """Block of the chain that carries each leaf."""
    border: str | None = None
    """Variable with one block per chain, of which the rows of that chain know alone."""
    tolerance: float = 1e-6
    """The residual, in the preconditioner's norm, that ends the iteration, relative to the first."""
    sample_tolerance: float = 1e-3
    """The same for samples, whose scatter is larger by far than what this leaves."""
    max_iterations: int = 2000
    chunk_rows: int = CHUNK_ROWS
    _problem: Problem | None = field(default=None, repr=False)
    """What the structure was worked out for."""
    _structure: ChainStructure | None = field(default=None, repr=False)

    def assemble(self, problem: Problem, values: Values) -> MatrixFreeEquations:
        """Normal equations at `values`."""
        structure = self._analysed(problem, values)
        kinds = dict(problem.variables)
        rows, term_cost = [], {}
        size = {name: (len(v), kinds[name].tangent_dim) for name, v in values.items()}
        like = values[self.eliminate]
        gradient = {name: like.new_zeros(n, k, 1) for name, (n, k) in size.items()}
        square = {name: like.new_zeros(n, k, k) for name, (n, k) in size.items()}
        k = kinds[self.eliminate].tangent_dim
        link = like.new_zeros(len(structure.chain), k, k)
        of_border = 0 if self.border is None else kinds[self.border].tangent_dim
        beside = like.new_zeros(len(structure.chain), k, of_border)
        for name, term in problem.terms.items():
            cost = like.new_zeros(1)
            for _, piece in chunks(term, self.chunk_rows):
                linear = linearize(piece, kinds, values)
                cost += linear.rho.sum() / 2
                root = linear.robust_weight.sqrt()[:, None]
                residual = (linear.residual * root)[..., None]
                jacobians = tuple(J * root[..., None] for J in linear.jacobians)
                rows.append(_Rows(piece.slots, jacobians))
                of_chain = []
                for (slot, index), J in zip(piece.slots, jacobians, strict=True):
                    gradient[slot].index_add_(0, index, J.mT @ residual)
                    square[slot].index_add_(0, index, J.mT @ J)
                    if slot in structure.base:
                        of_chain.append((index + structure.base[slot], J))
                if len(of_chain) == 2:
                    (one, J_one), (two, J_two) = of_chain
                    add_link(link, structure, one, two, J_one.mT @ J_two)
                for (slot, _), own in zip(piece.slots, jacobians, strict=True):
                    if slot == self.border:
                        for index, J in of_chain:
                            beside.index_add_(0, index, J.mT @ own)
            term_cost[name] = cost
        cost = torch.stack(list(term_cost.values())).sum(0)
        inner = chain_equations(
            structure,
            torch.cat([square[name] for name in structure.base]),
            link,
            torch.cat([gradient[name] for name in structure.base])[..., 0],
        )
        return MatrixFreeEquations(cost, term_cost, self, inner, rows, gradient, square, beside)

    def _analysed(self, problem: Problem, values: Values) -> ChainStructure:
        """The order of elimination with the landmarks held; kept as long as the chains are bound alike."""
        base = [name for name in (self.leaves, self.eliminate) if name is not None]
        terms = {}
        for name, term in problem.terms.items():
            slots = tuple(slot for slot in term.slots if slot[0] in base)
            if slots:
                terms[name] = replace(term, slots=slots)
        chains = Problem({name: problem.variables[name] for name in base}, terms)
        if self._structure is None or not same_rows(chains, self._problem):
            self._structure = analyse(
                chains,
                values,
                self.eliminate,
                self.chain,
                leaves=self.leaves,
                carrier=self.carrier,
                group_size=None,
                batch_bytes=1 << 22,
            )
            self._problem = chains
        return self._structure


@dataclass(frozen=True)
class _Rows:
    """Linearised rows of a term, weighted."""

    slots: tuple[tuple[str, Int[Tensor, " m"]], ...]
    jacobians: tuple[Float[Tensor, "m d _"], ...]

    def pulled(self, moved: Tangents) -> Float[Tensor, "m d c"] | None:
        """Change of the residuals with tangents; None where they touch none of the rows' slots."""
        change = None
        for (name, index), J in zip(self.slots, self.jacobians, strict=True):
            if name in moved:
                part = J @ moved[name][index]
                change = part if change is None else change + part
        return change

    def push(self, residual: Float[Tensor, "m d c"], total: dict[str, Tensor]) -> None:
        """Adds what residuals push the variables of `total` by, in place."""
        for (name, index), J in zip(self.slots, self.jacobians, strict=True):
            if name in total:
                # As a matrix: adding blocks of three dimensions takes many times as long.
                total[name].flatten(1).index_add_(0, index, (J.mT @ residual).flatten(1))


@dataclass(frozen=True)
class MatrixFreeEquations:
    """The quadratic model, as linearised rows and the blocks of its diagonal."""

    cost: Float[Tensor, " 1"]
    term_cost: Mapping[str, Float[Tensor, " 1"]]
    backend: MatrixFreeBackend
    inner: ChainNormalEquations
    """Chains and leaves, the rest held."""
    rows: list[_Rows]
    gradient: Tangents
    square: Tangents
    """Diagonal blocks [n, k, k] of every variable."""
    beside: Float[Tensor, "e k b"]
    """Blocks between the eliminated blocks and the border."""

    def solve(self, damping: Float[Tensor, " 1"]) -> Step:
        """The damped step; `solved` is False where the matrix is not positive definite, or too many steps were taken."""
        diagonal = {name: H.diagonal(dim1=1, dim2=2) for name, H in self.square.items()}
        added = {name: damping[0] * d.clamp_min(DIAGONAL_FLOOR) for name, d in diagonal.items()}
        force = {name: -g for name, g in self.gradient.items()}
        delta = self._solved(force, damping, added, self.backend.tolerance)
        if delta is None:
            still = {name: torch.zeros_like(g[..., 0]) for name, g in self.gradient.items()}
            zero = torch.zeros_like(self.cost)
            return Step(still, zero, zero > 0, zero)
        step = {name: tangent[..., 0] for name, tangent in delta.items()}
        along = torch.stack([(self.gradient[n][..., 0] * step[n]).sum() for n in step]).sum()
        damped = torch.stack([(added[n] * step[n].square()).sum() for n in step]).sum()
        norm = torch.stack([tangent.square().sum() for tangent in step.values()]).sum().sqrt()
        return Step(step, ((damped - along) / 2)[None], norm.isfinite()[None], norm[None])

    def samples(
        self, count: int, generator: torch.Generator, *, floor: float = 1e-9
    ) -> dict[str, Float[Tensor, "n k count"]]:
        """Tangents drawn from the normal distribution whose covariance is the inverse of the Hessian.

        White noise on the rows, put through the normal equations (Papandreou and Yuille 2010): covariances of a map
        too large for the inverse. The `floor` on the landmarks' diagonal keeps those that nothing observes.
        """
        force = {name: g.new_zeros(*g.shape[:2], count) for name, g in self.gradient.items()}
        for rows in self.rows:
            shape = (*rows.jacobians[0].shape[:2], count)
            noise = torch.randn(shape, dtype=self.cost.dtype, generator=generator)
            rows.push(noise.to(self.cost.device), force)
        eliminated = {*self.inner.structure.base, self.backend.border}
        added = {
            name: torch.full_like(g[..., 0], 0.0 if name in eliminated else floor)
            for name, g in self.gradient.items()
        }
        undamped = torch.zeros_like(self.cost)
        drawn = self._solved(force, undamped, added, self.backend.sample_tolerance)
        if drawn is None:
            raise ValueError("the map's normal equations are not positive definite")
        return drawn

    def _solved(
        self, force: Tangents, damping: Float[Tensor, " 1"], added: Tangents, tolerance: float
    ) -> dict[str, Tensor] | None:
        """Tangents that answer the forces, `added` to the diagonal; None where there are none."""
        if not bool(self.inner.solve(damping).solved):
            return None
        held = self._held(added)
        if held is None:
            return None
        landmarks = [name for name in force if name not in held.names]
        first = held.answer(force)
        rest = self._applied(first, landmarks)
        right = {name: force[name] - rest[name] for name in landmarks}
        moved = self._conjugate_gradients(right, held, added, tolerance) if landmarks else {}
        if moved is None:
            return None
        pushed = self._applied(moved, held.names)
        second = held.answer({name: force[name] - pushed[name] for name in held.names})
        return {name: (moved if name in moved else second)[name] for name in force}

    def _held(self, added: Tangents) -> _Held | None:
        """What answers forces with the landmarks held."""
        structure = self.inner.structure
        leaves = len(structure.carrier)
        owner = structure.chain.clone()
        owner[:leaves] = structure.chain[structure.carrier + leaves]
        name = self.backend.border
        if name is None:
            return _Held(self.inner, None, owner, self.beside, None)
        follow = self.inner.solve_chains(self.beside)
        system = self.square[name] + torch.diag_embed(added[name])
        system = system.index_add(0, owner, -self.beside.mT @ follow)
        factor, failed = torch.linalg.cholesky_ex(system)
        if bool(failed.any()) or not bool(factor.isfinite().all()):
            return None
        return _Held(self.inner, name, owner, follow, factor)

    def _applied(self, moved: Tangents, wanted: Sequence[str]) -> dict[str, Tensor]:
        """The Hessian's product with tangents, without its damping, as far as it is wanted."""
        columns = next(iter(moved.values())).shape[-1] if moved else 1
        like = self.gradient
        total = {n: like[n].new_zeros(*like[n].shape[:2], columns) for n in wanted}
        for rows in self.rows:
            change = rows.pulled(moved)
            if change is not None:
                rows.push(change, total)
        return total

    def _conjugate_gradients(
        self, right: Tangents, held: _Held, added: Tangents, tolerance: float
    ) -> dict[str, Tensor] | None:
        """Landmarks that solve the Schur complement for the right-hand sides, preconditioned by its diagonal blocks."""
        names = list(right)
        factors = {
            n: torch.linalg.cholesky_ex(self.square[n] + torch.diag_embed(added[n])) for n in names
        }
        if any(bool(failed.any()) for _, failed in factors.values()):
            return None

        def preconditioned(residual: Tangents) -> dict[str, Tensor]:
            return {n: torch.cholesky_solve(residual[n], factors[n][0]) for n in names}

        def inner(a: Tangents, b: Tangents) -> Tensor:
            return torch.stack([(a[n] * b[n]).sum((0, 1)) for n in names]).sum(0)

        every = [*names, *held.names]
        x = {n: torch.zeros_like(right[n]) for n in names}
        residual = {n: right[n].clone() for n in names}
        z = preconditioned(residual)
        direction = {n: z[n].clone() for n in names}
        size = inner(residual, z)
        target = tolerance**2 * size
        for _ in range(self.backend.max_iterations):
            if bool((size <= target).all()):
                return x
            pushed = self._applied(direction, every)
            followed = held.answer({n: pushed[n] for n in held.names})
            taken = self._applied(followed, names)
            product = {n: pushed[n] - taken[n] + added[n][..., None] * direction[n] for n in names}
            bend = inner(direction, product)
            if not bool(((bend > 0) | (size <= target)).all()):
                return None
            length = torch.where(size > target, size / bend, 0.0)
            for n in names:
                x[n] += length * direction[n]
                residual[n] -= length * product[n]
            z = preconditioned(residual)
            before, size = size, inner(residual, z)
            turn = torch.where(before > target, size / before, 0.0)
            for n in names:
                direction[n].mul_(turn).add_(z[n])
        return None


@dataclass(frozen=True)
class _Held:
    """Chains, leaves and border with the landmarks held: an exact solve."""

    inner: ChainNormalEquations
    border: str | None
    owner: Int[Tensor, " e"]
    """Block of the border that each eliminated block belongs to."""
    follow: Float[Tensor, "e k b"]
    """How the eliminated blocks answer, with the opposite sign, to unit steps of the border."""
    factor: Float[Tensor, "j b b"] | None
    """Cholesky factors of the border's own systems."""

    @property
    def names(self) -> list[str]:
        """Its variables."""
        return [*self.inner.structure.base, *([] if self.border is None else [self.border])]

    def answer(self, force: Tangents) -> dict[str, Tensor]:
        """Tangents that answer the forces on its own variables."""
        base = self.inner.structure.base
        chain = self.inner.solve_chains(torch.cat([force[name] for name in base]))
        found = {}
        if self.border is not None:
            assert self.factor is not None
            # The blocks between chains and border are symmetric: what the chains would push is by what they follow.
            stacked = torch.cat([force[name] for name in base])
            own = force[self.border].index_add(0, self.owner, -self.follow.mT @ stacked)
            found[self.border] = torch.cholesky_solve(own, self.factor)
            chain = chain - self.follow @ found[self.border][self.owner]
        found.update(self.inner.unstack(chain))
        return found
