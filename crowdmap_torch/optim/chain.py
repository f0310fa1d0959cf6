"""The back end for chains: one variable's blocks are eliminated level by level, the rest is one small dense system.

Bundle adjustment of a map has frames by the ten thousand, each bound to the next, and landmarks by the hundred: what is
eliminated are the frames, the reverse of the usual habit. `chain_structure` says in which order, `chain_sums` adds the
blocks up; here is the arithmetic.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.chain_structure import Batch, ChainStructure, analyse
from crowdmap_torch.optim.chain_sums import BlockSums, add_link, add_mixed, computed, same_rows
from crowdmap_torch.optim.linear import DIAGONAL_FLOOR, Step, unpack
from crowdmap_torch.optim.linearize import (
    CHUNK_ROWS,
    chunks,
    row_blocks,
    row_gradients,
    rows,
)
from crowdmap_torch.optim.parallel import in_order
from crowdmap_torch.optim.problem import Problem, Values

_WORTH_HALVING = 64
"""Width of a window from which half of the entries below the diagonal are not worked out."""


@dataclass
class ChainBackend:
    """Normal equations of one problem, the blocks of `eliminate` eliminated along their chains.

    The structure is worked out when a problem is first seen, and kept for problems whose terms touch the same blocks
    (the same index tensors): weights, constants and losses may change from step to step.
    """

    eliminate: str
    chain: Int[Tensor, " n"]
    """Chain of every block of the eliminated variable; the blocks of a chain are adjacent and in order."""
    leaves: str | None = None
    """Variable whose blocks are bound to one block of the chain each, and go first; None: there is none."""
    carrier: Int[Tensor, " m"] | None = None
    """Block of the chain that carries each leaf."""
    group_size: int | None = None
    """Blocks that share one window of columns; None: half as many as there are chains, from 4 to 64."""
    batch_bytes: int = 1 << 22
    """Size of what is computed at once: about what the processor's cache holds."""
    chunk_rows: int = CHUNK_ROWS
    _problem: Problem | None = field(default=None, repr=False)
    _structure: ChainStructure | None = field(default=None, repr=False)
    _workspace: _Workspace | None = field(default=None, repr=False)

    def assemble(self, problem: Problem, values: Values) -> ChainNormalEquations:
        """Normal equations at `values`; memory beyond them is bounded by the chunk.

        The workspace of the solve is the backend's: of its normal equations only the last may be solved.
        """
        self.prepare(problem, values)
        assert self._structure is not None and self._workspace is not None
        return _assemble(problem, values, self._structure, self._workspace, self.chunk_rows)

    def prepare(self, problem: Problem, values: Values) -> None:
        """Works the structure out and takes the workspace, unless both are there for such a problem."""
        if self._structure is None or not same_rows(problem, self._problem):
            if problem.group_count != 1:
                raise ValueError("chains are eliminated in one problem at a time, not in a batch")
            self._structure = analyse(
                problem,
                values,
                self.eliminate,
                self.chain,
                leaves=self.leaves,
                carrier=self.carrier,
                group_size=self.group_size,
                batch_bytes=self.batch_bytes,
            )
            self._problem = problem
            block = values[self.eliminate]
            k = problem.variables[self.eliminate].tangent_dim
            self._workspace = _Workspace(block.new_empty(self._structure.store_rows + 1, k))


@dataclass
class _Workspace:
    """What the solves of one back end share: memory is taken once."""

    store: Float[Tensor, "rows k"]
    """Per eliminated block and column of its window a row of `k`; once eliminated, whitened by its diagonal."""
    couplings: dict[str, Float[Tensor, "f l k"]] = field(default_factory=dict)
    """Of the last normal equations, by term."""
    factor: _Factor | None = None
    """Of the last solve."""

    def coupling(self, name: str, rows: int, columns: int) -> Float[Tensor, "f l k"]:
        """Memory for a term's couplings; what is in it is of no account."""
        if name not in self.couplings:
            shape = (rows, columns, self.store.shape[1])
            self.couplings[name] = self.store.new_empty(shape)
        return self.couplings[name]


@dataclass(frozen=True)
class _Factor:
    """The factorised matrix, together with the boundary store."""

    whiten: list[Float[Tensor, "_ k k"]]
    """By batch: inverse Cholesky factors of the diagonals."""
    towards: list[Float[Tensor, "_ k _"]]
    """By batch: minus the inverse diagonals times the links to the neighbours."""
    reduced: Float[Tensor, "r r"]
    """Cholesky factor of the reduced system, the upper one."""


@dataclass(frozen=True)
class ChainNormalEquations:
    """The quadratic model, by blocks: chain diagonal and links, couplings, and the dense landmark part."""

    cost: Float[Tensor, " 1"]
    term_cost: Mapping[str, Float[Tensor, " 1"]]
    structure: ChainStructure
    diagonal: Float[Tensor, "n k k"]
    link: Float[Tensor, "n k k"]
    """Block of each node with its successor, of each leaf with the block that carries it."""
    chain_gradient: Float[Tensor, "n k"]
    coupling: Mapping[str, Float[Tensor, "f l k"]]
    hessian: Float[Tensor, "r r"]
    gradient: Float[Tensor, " r"]
    workspace: _Workspace = field(repr=False)
    factorised: bool = False
    """Whether the last solve's factors are to be used as they are: those of another point, for this gradient."""

    def moved(self, problem: Problem, values: Values) -> ChainNormalEquations:
        """Cost and gradient at other values, with the matrix as the last solve factorised it."""
        sums = BlockSums(self.structure, self.chain_gradient, hessian=None)
        term_cost = {}
        kinds = dict(problem.variables)
        for name, term in problem.terms.items():
            cost = torch.zeros_like(self.cost)
            pieces = [piece for _, piece in chunks(term)]
            parts = computed(row_gradients, term, pieces, kinds, values)
            for piece, part in zip(pieces, parts, strict=True):
                cost += part.rho.sum() / 2
                sums.add_gradient(piece, part)
            term_cost[name] = cost
        return replace(
            self,
            cost=torch.stack(list(term_cost.values())).sum(0),
            term_cost=term_cost,
            chain_gradient=sums.chain_gradient.mT.contiguous(),
            gradient=sums.gradient(),
            factorised=True,
        )

    def slope(self, delta: Mapping[str, Tensor]) -> Float[Tensor, " 1"]:
        """Derivative of the cost along `delta`."""
        of = unpack(self.gradient[None], self.structure.where)
        of.update(self.unstack(self.chain_gradient))
        return torch.stack([(of[name] * delta[name]).sum() for name in delta]).sum()[None]

    def solve(self, damping: Float[Tensor, " 1"]) -> Step:
        """The damped step: eliminate level by level, solve what is left, substitute back."""
        if self.factorised:
            return self._solve_again()
        scale = damping[0]
        added_chain = scale * self.diagonal.diagonal(dim1=-2, dim2=-1).clamp_min(DIAGONAL_FLOOR)
        added = scale * self.hessian.diagonal().clamp_min(DIAGONAL_FLOOR)
        matrix, right_side, whiten, towards = self._reduce(added_chain, added)
        reduced, failed = torch.linalg.cholesky_ex(matrix, upper=True)
        if bool(failed) or not bool(matrix.isfinite().all()):
            return self._failed()
        factor = self.workspace.factor = _Factor(whiten, towards, reduced)
        packed = -torch.cholesky_solve(right_side[:, None], reduced, upper=True)[:, 0]
        chain_step = self._substitute(packed, factor)
        along = (self.chain_gradient * chain_step).sum() + self.gradient @ packed
        damped = (added_chain * chain_step.square()).sum() + added @ packed.square()
        return self._step(packed, chain_step, (damped - along) / 2)

    def _solve_again(self) -> Step:
        """The step for this gradient by the factors of the last solve."""
        factor, structure = self.workspace.factor, self.structure
        assert factor is not None
        gradient = self.gradient.new_zeros(len(structure.order), self.chain_gradient.shape[1])
        gradient[structure.place] = self.chain_gradient
        right_side = torch.nn.functional.pad(self.gradient, (0, 2))

        def pass_on(item: tuple[Batch, Tensor, Tensor]) -> tuple[Tensor, Tensor]:
            batch, whiten, leads = item
            groups, size, w, _ = batch.fill.shape
            own = gradient[batch.place][..., None]
            rows = _rows(batch, self.workspace.store)
            seen = (rows @ (whiten @ own)).view(groups, size, w).sum(1)
            return seen.neg_().flatten(), (leads.mT @ own).view(-1, own.shape[1])

        parts = zip(factor.whiten, factor.towards, strict=True)
        for level in structure.levels:
            items = [(batch, *next(parts)) for batch in level.batches]
            passed = in_order(pass_on, items, gradient.device)
            for batch, (seen, across) in zip(level.batches, passed, strict=True):
                right_side.index_add_(0, batch.columns.flatten(), seen)
                gradient.index_add_(0, batch.neighbour.flatten(), across)
        right_side = right_side[: len(self.gradient), None]
        packed = -torch.cholesky_solve(right_side, factor.reduced, upper=True)[:, 0]
        chain_step = self._substitute(packed, factor, gradient)
        along = (self.chain_gradient * chain_step).sum() + self.gradient @ packed
        return self._step(packed, chain_step, -along / 2)

    def _step(self, packed: Tensor, chain_step: Tensor, predicted: Tensor) -> Step:
        delta = unpack(packed[None], self.structure.where)
        delta.update(self.unstack(chain_step))
        norm = (chain_step.square().sum() + packed.square().sum()).sqrt()
        return Step(delta, predicted[None], norm.isfinite()[None], norm[None])

    def marginal_covariance(self, *, floor: float = 1e-9) -> Float[Tensor, "r r"]:
        """Covariance of all variables but the eliminated one, jointly, the eliminated one marginalised."""
        nothing = torch.zeros_like(self.diagonal[..., 0])
        # The floor keeps a landmark that nothing observes invertible; its variance says so.
        added = torch.full_like(self.gradient, floor)
        matrix, _, whiten, towards = self._reduce(nothing, added)
        if not bool(matrix.isfinite().all()):
            raise ValueError("the chain's blocks are not positive definite without damping")
        reduced = torch.linalg.cholesky(matrix, upper=True)
        self.workspace.factor = _Factor(whiten, towards, reduced)
        return torch.cholesky_inverse(reduced, upper=True)

    def block_covariances(self) -> Float[Tensor, "n k k"]:
        """Covariance of every eliminated block with all that stays held: the diagonal blocks of the chains' inverse.

        From the last level to the first, a block's covariance is that of its own diagonal and what its neighbours add;
        what two neighbours have in common is known once the later one is (Takahashi, Fagan and Chen 1973).
        """
        structure, k = self.structure, self.diagonal.shape[-1]
        diagonal, link = self._in_order(self.diagonal)
        steps = []
        for batch in (batch for level in structure.levels for batch in level.batches):
            lead = _lead(batch, diagonal, link)
            _pass_on(batch, lead.square, diagonal, link)
            steps.append((batch, lead.whiten, lead.towards))
        found = self.diagonal.new_zeros(len(structure.order), k, k)
        # With the block that follows, of those known so far.
        crossed = torch.zeros_like(found)
        for batch, own, leads in reversed(steps):
            around = found[batch.neighbour]
            if batch.neighbour.shape[1] == 2:
                before = batch.neighbour[:, 0]
                both = crossed[before]
                upper = torch.cat((around[:, 0], both), dim=-1)
                beside = torch.cat((upper, torch.cat((both.mT, around[:, 1]), dim=-1)), dim=1)
                with_neighbours = leads @ beside
                crossed[before] = with_neighbours[..., :k].mT
                crossed[batch.place] = with_neighbours[..., k:]
            else:
                with_neighbours = leads @ around[:, 0]
            found[batch.place] = own.mT @ own + with_neighbours @ leads.mT
        return found[structure.place]

    def solve_reduced(self, right: Float[Tensor, "r m"]) -> Float[Tensor, "r m"]:
        """Landmarks that solve the last factorised reduced system for other right-hand sides."""
        assert self.workspace.factor is not None
        return torch.cholesky_solve(right, self.workspace.factor.reduced, upper=True)

    def solve_chains(self, right: Float[Tensor, "n k m"]) -> Float[Tensor, "n k m"]:
        """Eliminated blocks that solve the last factorised system with the landmarks held.

        Chains do not touch each other then: one column serves as many right-hand sides as there are chains.
        """
        structure, factor = self.structure, self.workspace.factor
        assert factor is not None
        force = right.new_zeros(len(structure.order), *right.shape[1:])
        force[structure.place] = right
        solved = torch.zeros_like(force)
        batches = [batch for level in structure.levels for batch in level.batches]
        steps = list(zip(batches, factor.whiten, factor.towards, strict=True))
        for batch, _, leads in steps:
            passed = (leads.mT @ force[batch.place]).view(-1, *right.shape[1:])
            force.index_add_(0, batch.neighbour.flatten(), passed)
        for batch, whiten, leads in reversed(steps):
            beside = solved[batch.neighbour].flatten(1, 2)
            solved[batch.place] = whiten.mT @ (whiten @ force[batch.place]) + leads @ beside
        return solved[structure.place]

    def by_landmark(
        self, moved: Float[Tensor, "n k m"], owner: Int[Tensor, " n"], owners: int
    ) -> Float[Tensor, "r owners m"]:
        """What moved eliminated blocks add to the landmarks' gradient, by who owns the block."""
        total = moved.new_zeros(len(self.gradient) * owners, moved.shape[-1])
        for name, block in self.coupling.items():
            coupling = self.structure.couplings[name]
            for at in range(0, len(block), CHUNK_ROWS):
                here = slice(at, at + CHUNK_ROWS)
                index = coupling.block[here]
                place = coupling.column[here] * owners + owner[index][:, None]
                total.index_add_(0, place.flatten(), (block[here] @ moved[index]).flatten(0, 1))
        return total.view(-1, owners, moved.shape[-1])

    def by_block(self, moved: Float[Tensor, " r"]) -> Float[Tensor, "n k"]:
        """What moved landmarks add to the eliminated blocks' gradient."""
        total = torch.zeros_like(self.chain_gradient)
        for name, block in self.coupling.items():
            coupling = self.structure.couplings[name]
            pushed = (moved[coupling.column][:, None] @ block)[:, 0]
            total.index_add_(0, coupling.block, pushed)
        return total

    def unstack(self, stacked: Tensor) -> dict[str, Tensor]:
        """Rows of the leaves and of the chain, by variable."""
        base = self.structure.base
        bounds = [*base.values(), len(stacked)]
        return {name: stacked[a:b] for name, a, b in zip(base, bounds, bounds[1:], strict=False)}

    def _failed(self) -> Step:
        delta = unpack(torch.zeros_like(self.gradient)[None], self.structure.where)
        delta.update(self.unstack(torch.zeros_like(self.chain_gradient)))
        zero = torch.zeros_like(self.cost)
        return Step(delta, zero, torch.zeros_like(zero, dtype=torch.bool), zero)

    def _reduce(
        self, added_chain: Tensor, added: Tensor
    ) -> tuple[Tensor, Tensor, list[Tensor], list[Tensor]]:
        """The Schur complement on the landmarks, its right-hand side, and by batch the whitening and the leads.

        Only the upper triangle of the complement counts. The eliminated rows are in the store. What is not positive
        definite gives numbers that are not finite.
        """
        structure, store = self.structure, self.workspace.store
        store.zero_()
        for name, block in self.coupling.items():
            store.index_add_(0, structure.factor_rows[name], block.flatten(0, 1))
        store[structure.gradient_row] = self.chain_gradient
        dim = len(self.gradient)
        # One row and column more for the gradient, one for padding.
        system = torch.nn.functional.pad(self.hessian + torch.diag(added), (0, 2, 0, 2))
        system[dim, :dim] = self.gradient
        diagonal, link = self._in_order(self.diagonal + torch.diag_embed(added_chain))
        whiten, towards = [], []
        for level in structure.levels:
            parts = in_order(
                lambda batch: _eliminate(batch, diagonal, link, store, len(system)),
                level.batches,
                store.device,
            )
            for batch, part in zip(level.batches, parts, strict=True):
                whiten.append(part.lead.whiten)
                towards.append(part.lead.towards)
                _pass_on(batch, part.lead.square, diagonal, link)
                system.view(-1).index_add_(0, part.at, part.product)
                store.index_add_(0, batch.fill.flatten(), part.fill)
        return system[:dim, :dim], system[dim, :dim], whiten, towards

    def _in_order(self, diagonal: Float[Tensor, "n k k"]) -> tuple[Tensor, Tensor]:
        """Diagonal blocks and links in the order of elimination.

        A block that stands for none has no links, and a diagonal that does no harm.
        """
        order, k = self.structure.order, diagonal.shape[-1]
        none = torch.eye(k, dtype=diagonal.dtype, device=diagonal.device)[None]
        links = torch.cat((self.link, torch.zeros_like(none)))
        return torch.cat((diagonal, none))[order], links[order]

    def _substitute(
        self, packed: Tensor, factor: _Factor, gradient: Tensor | None = None
    ) -> Tensor:
        """Steps of the eliminated blocks, from the last level to the first.

        Their gradient is that of the store, or else `gradient`, in the order of elimination.
        """
        structure, k = self.structure, self.chain_gradient.shape[1]
        # The gradient's column counts once, padding not at all.
        known = torch.cat((packed, packed.new_tensor([float(gradient is None), 0.0])))
        step = packed.new_zeros(len(structure.order), k)

        def solve(item: tuple[Batch, Tensor, Tensor]) -> Tensor:
            batch, whiten, leads = item
            window = known[batch.columns].repeat_interleave(batch.fill.shape[1], 0)[:, None]
            own = (window @ _rows(batch, self.workspace.store)).mT
            if gradient is not None:
                own = own + whiten @ gradient[batch.place][..., None]
            beside = step[batch.neighbour].flatten(1)[..., None]
            return (leads @ beside - whiten.mT @ own)[..., 0]

        last = len(factor.whiten)
        for level in reversed(structure.levels):
            mine = slice(last - len(level.batches), last)
            last = mine.start
            items = list(zip(level.batches, factor.whiten[mine], factor.towards[mine], strict=True))
            for batch, part in zip(level.batches, in_order(solve, items, step.device), strict=True):
                step[batch.place] = part
        return step[structure.place]


def _pass_on(batch: Batch, square: Tensor, diagonal: Tensor, link: Tensor) -> None:
    """What the blocks that go leave on the diagonals and links of their neighbours, in place."""
    (e, sides), k = batch.neighbour.shape, diagonal.shape[-1]
    own = square.view(e, sides, k, sides, k).diagonal(dim1=1, dim2=3).permute(0, 3, 1, 2)
    diagonal.view(-1, k * k).index_add_(0, batch.neighbour.flatten(), own.reshape(-1, k * k))
    if sides == 2:
        link[batch.neighbour[:, 0]] = square[:, :k, k:]


def _rows(batch: Batch, store: Tensor) -> Tensor:
    """The batch's rows of the boundary store, [places, w, k]."""
    groups, size, w, _ = batch.fill.shape
    rows = store[batch.first_row : batch.first_row + groups * size * w]
    return rows.view(groups * size, w, store.shape[-1])


@dataclass(frozen=True)
class _Lead:
    """What the elimination of a batch leaves to other blocks of its chains."""

    whiten: Float[Tensor, "e k k"]
    """Inverse Cholesky factors of the diagonals."""
    towards: Float[Tensor, "e k _"]
    """Minus the inverse diagonals times the links to the neighbours."""
    square: Float[Tensor, "e _ _"]
    """To be added to the neighbours' diagonals and to the link between them."""


def _lead(batch: Batch, diagonal: Tensor, link: Tensor) -> _Lead:
    """What a batch leaves behind of itself."""
    factor, failed = torch.linalg.cholesky_ex(diagonal[batch.place])
    # A block that is not positive definite spoils all that follows, and the whole step fails.
    inverse = torch.cholesky_inverse(factor).where((failed == 0)[:, None, None], torch.nan)
    links = link[batch.place]
    if batch.neighbour.shape[1] == 2:
        links = torch.cat((link[batch.neighbour[:, 0]].mT, links), dim=-1)
    leads = (inverse @ links).neg_()
    return _Lead(factor.mT @ inverse, leads, links.mT @ leads)


@dataclass(frozen=True)
class _Part:
    """What the elimination of a batch leaves to others."""

    lead: _Lead
    at: Int[Tensor, " ww"]
    product: Float[Tensor, " ww"]
    """To be added to the reduced system, and where."""
    fill: Float[Tensor, "rows k"]
    """To be added to the neighbours' rows."""


def _eliminate(batch: Batch, diagonal: Tensor, link: Tensor, store: Tensor, stride: int) -> _Part:
    """What a batch leaves behind; its own rows are solved in place."""
    groups, size, w, _ = batch.fill.shape
    k = store.shape[-1]
    lead = _lead(batch, diagonal, link)
    rows = _rows(batch, store)
    # Adding rows as they are is several times faster than subtracting them: the leads carry the sign.
    fill = (rows @ lead.towards).view(-1, k)
    rows.copy_(rows @ lead.whiten.mT)
    wide = rows.view(groups, size, w, k).transpose(1, 2).reshape(groups, w, size * k)
    half = w // 2 if w >= _WORTH_HALVING else w
    ats, products = [], []
    for here, there in ((slice(half), slice(w)), (slice(half, w), slice(half, w))):
        if here.start == w:
            continue
        column = batch.columns[:, there]
        ats.append((batch.columns[:, here, None] * stride + column[:, None]).flatten())
        products.append((wide[:, here] @ wide[:, there].mT).neg_().flatten())
    return _Part(lead, torch.cat(ats), torch.cat(products), fill)


def _assemble(
    problem: Problem,
    values: Values,
    structure: ChainStructure,
    workspace: _Workspace,
    chunk_rows: int,
) -> ChainNormalEquations:
    base, kinds = structure.base, dict(problem.variables)
    n, blocks = len(structure.chain), values[next(iter(base))]
    k = problem.variables[next(iter(base))].tangent_dim
    sums = BlockSums(structure, blocks.new_zeros(n, k), hessian=blocks.new_zeros(k * k, n))
    link = blocks.new_zeros(n, k, k)
    term_cost, couplings = {}, {}

    for name, term in problem.terms.items():
        cost = blocks.new_zeros(1)
        coupling = structure.couplings.get(name)
        if coupling is not None:
            mixed = workspace.coupling(name, len(coupling.block), coupling.column.shape[1])
            couplings[name] = mixed if coupling.factor_of_row is None else mixed.zero_()
            term = term if coupling.order is None else rows(term, coupling.order)
        pieces = list(chunks(term, chunk_rows))
        parts = computed(row_blocks, term, [piece for _, piece in pieces], kinds, values)
        for (at, piece), part in zip(pieces, parts, strict=True):
            cost += part.rho.sum() / 2
            sums.add_gradient(piece, part)
            sums.add_hessian(piece, part)
            index = [block + base[slot] for slot, block in piece.slots if slot in base]
            if len(index) == 2:
                add_link(link, structure, index[0], index[1], part.hessian[0, 1].permute(2, 0, 1))
            if coupling is not None:
                add_mixed(couplings[name], coupling, at, part)
        term_cost[name] = cost
    assert sums.diagonal is not None
    return ChainNormalEquations(
        torch.stack(list(term_cost.values())).sum(0),
        term_cost,
        structure,
        sums.diagonal.mT.reshape(n, k, k),
        link,
        sums.chain_gradient.mT.contiguous(),
        couplings,
        sums.hessian(),
        sums.gradient(),
        workspace,
    )


def chain_equations(
    structure: ChainStructure,
    diagonal: Float[Tensor, "n k k"],
    link: Float[Tensor, "n k k"],
    gradient: Float[Tensor, "n k"],
) -> ChainNormalEquations:
    """Normal equations of chains and leaves alone, from their blocks; `structure` knows of no landmarks."""
    nothing = gradient.new_zeros(1)
    store = gradient.new_empty(structure.store_rows + 1, gradient.shape[1])
    none = gradient.new_zeros(0)
    return ChainNormalEquations(
        nothing,
        {},
        structure,
        diagonal,
        link,
        gradient,
        {},
        none.view(0, 0),
        none,
        _Workspace(store),
    )
