"""The back end for chains: one variable's blocks are eliminated level by level, the rest is one small dense system.

Bundle adjustment of a map has frames by the ten thousand, each bound to the next, and landmarks by the hundred: what is
eliminated are the frames, the reverse of the usual habit. `chain_structure` says in which order; here is the
arithmetic.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.chain_structure import Batch, ChainStructure, Coupling, Level, analyse
from crowdmap_torch.optim.linear import DIAGONAL_FLOOR, Step, unpack
from crowdmap_torch.optim.linearize import CHUNK_ROWS, RowBlocks, chunks, row_blocks, rows
from crowdmap_torch.optim.problem import CostTerm, Problem, Values


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
    _store: Tensor | None = field(default=None, repr=False)

    def assemble(self, problem: Problem, values: Values) -> ChainNormalEquations:
        """Normal equations at `values`; memory beyond them is bounded by the chunk.

        The workspace of the solve is the backend's: of its normal equations only the last may be solved.
        """
        if self._structure is None or not _same_rows(problem, self._problem):
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
            self._store = block.new_empty(self._structure.store_rows + 1, k)
        assert self._store is not None
        return _assemble(problem, values, self._structure, self._store, self.chunk_rows)


def _same_rows(problem: Problem, other: Problem | None) -> bool:
    """Whether the terms of two problems touch the same blocks, by identity of their index tensors."""
    if other is None or list(problem.terms) != list(other.terms):
        return False
    return all(
        name == name_other and block is block_other
        for term, term_other in zip(problem.terms.values(), other.terms.values(), strict=True)
        for (name, block), (name_other, block_other) in zip(
            term.slots, term_other.slots, strict=False
        )
    )


@dataclass(frozen=True)
class _Reduced:
    """The reduced system, and what back-substitution needs beside the boundary store."""

    matrix: Float[Tensor, "r r"]
    right_side: Float[Tensor, " r"]
    towards: list[Float[Tensor, "e k sk"]]
    """By level: every block's inverse diagonal times its links to its neighbours."""


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
    store: Float[Tensor, "rows k"] = field(repr=False)
    """Workspace: per block and column of its window a row of `k`, overwritten by every solve."""

    def solve(self, damping: Float[Tensor, " 1"]) -> Step:
        """The damped step: eliminate level by level, solve what is left, substitute back."""
        scale = damping[0]
        added_chain = scale * self.diagonal.diagonal(dim1=-2, dim2=-1).clamp_min(DIAGONAL_FLOOR)
        added = scale * self.hessian.diagonal().clamp_min(DIAGONAL_FLOOR)
        reduced = self._reduce(added_chain, added)
        if reduced is None:
            return self._failed()
        factor, failed = torch.linalg.cholesky_ex(reduced.matrix)
        if bool(failed):
            return self._failed()
        packed = -torch.cholesky_solve(reduced.right_side[:, None], factor)[:, 0]
        chain_step = self._substitute(packed, reduced.towards)
        along = (self.chain_gradient * chain_step).sum() + self.gradient @ packed
        damped = (added_chain * chain_step.square()).sum() + added @ packed.square()
        delta = unpack(packed[None], self.structure.where)
        delta.update(self._unstack(chain_step))
        norm = (chain_step.square().sum() + packed.square().sum()).sqrt()
        solved = norm.isfinite()
        return Step(delta, ((damped - along) / 2)[None], solved[None], norm[None])

    def marginal_covariance(self, *, floor: float = 1e-9) -> Float[Tensor, "r r"]:
        """Covariance of all variables but the eliminated one, jointly, the eliminated one marginalised."""
        nothing = torch.zeros_like(self.diagonal[..., 0])
        # The floor keeps a landmark that nothing observes invertible; its variance says so.
        reduced = self._reduce(nothing, torch.full_like(self.gradient, floor))
        if reduced is None:
            raise ValueError("the chain's blocks are not positive definite without damping")
        return torch.cholesky_inverse(torch.linalg.cholesky(reduced.matrix))

    def _unstack(self, stacked: Tensor) -> dict[str, Tensor]:
        """Rows of the leaves and of the chain, by variable."""
        base = self.structure.base
        bounds = [*base.values(), len(stacked)]
        return {name: stacked[a:b] for name, a, b in zip(base, bounds, bounds[1:], strict=False)}

    def _failed(self) -> Step:
        delta = unpack(torch.zeros_like(self.gradient)[None], self.structure.where)
        delta.update(self._unstack(torch.zeros_like(self.chain_gradient)))
        zero = torch.zeros_like(self.cost)
        return Step(delta, zero, torch.zeros_like(zero, dtype=torch.bool), zero)

    def _reduce(self, added_chain: Tensor, added: Tensor) -> _Reduced | None:
        """The Schur complement on the landmarks and its right-hand side; the eliminated rows are in the store."""
        structure, store = self.structure, self.store
        store.zero_()
        for name, block in self.coupling.items():
            store.index_add_(0, structure.factor_rows[name], block.flatten(0, 1))
        store[structure.gradient_row] = self.chain_gradient
        dim = len(self.gradient)
        # One row and column more for the gradient, one for padding.
        system = torch.nn.functional.pad(self.hessian + torch.diag(added), (0, 2, 0, 2))
        system[dim, :dim] = self.gradient
        # In the order of elimination; a block that stands for none has no links, and a diagonal that does no harm.
        k = self.diagonal.shape[-1]
        none = torch.eye(k, dtype=store.dtype, device=store.device)[None]
        diagonal = torch.cat((self.diagonal + torch.diag_embed(added_chain), none))
        diagonal = diagonal[structure.order]
        link = torch.cat((self.link, torch.zeros_like(none)))[structure.order]
        towards = []
        for level in structure.levels:
            factor, failed = torch.linalg.cholesky_ex(diagonal[level.place])
            if bool(failed.any()):
                return None
            inverse = torch.cholesky_inverse(factor)
            links = link[level.place]
            if level.neighbour.shape[1] == 2:
                links = torch.cat((link[level.neighbour[:, 0]].mT, links), dim=-1)
            leads = inverse @ -links
            towards.append(leads)
            _pass_on(level, links.mT @ leads, diagonal, link)
            for batch in level.batches:
                mine = slice(
                    batch.place.start - level.place.start, batch.place.stop - level.place.start
                )
                _eliminate(batch, inverse[mine], leads[mine], store, system)
        return _Reduced(system[:dim, :dim], system[dim, :dim], towards)

    def _substitute(self, packed: Tensor, towards: list[Tensor]) -> Tensor:
        """Steps of the eliminated blocks, from the last level to the first."""
        structure, k = self.structure, self.chain_gradient.shape[1]
        # The gradient's column counts once, padding not at all.
        known = torch.cat((packed, packed.new_tensor([1.0, 0.0])))
        step = packed.new_zeros(len(structure.order), k)
        for level, leads in zip(reversed(structure.levels), reversed(towards), strict=True):
            for batch in level.batches:
                size = batch.fill.shape[1]
                window = known[batch.columns].repeat_interleave(size, 0)[:, None]
                torch.bmm(window, _rows(batch, self.store), out=step[batch.place][:, None])
            beside = step[level.neighbour].flatten(1)[..., None]
            step[level.place] = (leads @ beside)[..., 0] - step[level.place]
        return step[structure.place]


def _pass_on(level: Level, square: Tensor, diagonal: Tensor, link: Tensor) -> None:
    """What the blocks that go leave on the diagonals and links of their neighbours, in place."""
    e, sides, k = len(level.neighbour), level.neighbour.shape[1], diagonal.shape[-1]
    own = square.view(e, sides, k, sides, k).diagonal(dim1=1, dim2=3).permute(0, 3, 1, 2)
    diagonal.view(-1, k * k).index_add_(0, level.neighbour.flatten(), own.reshape(-1, k * k))
    if sides == 2:
        link[level.neighbour[:, 0]] = square[:, :k, k:]


def _rows(batch: Batch, store: Tensor) -> Tensor:
    """The batch's rows of the boundary store, [places, w, k]."""
    groups, size, w, _ = batch.fill.shape
    rows = store[batch.first_row : batch.first_row + groups * size * w]
    return rows.view(groups * size, w, store.shape[-1])


def _eliminate(batch: Batch, inverse: Tensor, leads: Tensor, store: Tensor, system: Tensor) -> None:
    """Eliminates a batch: into the reduced system, into its neighbours' rows, its own rows solved; in place."""
    groups, size, w, _ = batch.fill.shape
    k = store.shape[-1]
    rows = _rows(batch, store)
    solved = rows @ inverse
    left = rows.view(groups, size, w, k).transpose(1, 2).reshape(groups, w, size * k)
    right = solved.view(groups, size, w, k).transpose(1, 2).reshape(groups, w, size * k)
    at = batch.columns[:, :, None] * len(system) + batch.columns[:, None]
    system.view(-1).index_add_(0, at.flatten(), (left @ right.mT).flatten(), alpha=-1)
    # Adding rows as they are is several times faster than subtracting them: the leads carry the sign.
    store.index_add_(0, batch.fill.flatten(), (rows @ leads).view(-1, k))
    rows.copy_(solved)


def _assemble(
    problem: Problem, values: Values, structure: ChainStructure, store: Tensor, chunk_rows: int
) -> ChainNormalEquations:
    base, kinds = structure.base, dict(problem.variables)
    n, blocks = len(structure.chain), values[next(iter(base))]
    k = problem.variables[next(iter(base))].tangent_dim
    # Rows last while they are summed, as they come.
    diagonal = blocks.new_zeros(k * k, n)
    chain_gradient = blocks.new_zeros(k, n)
    link = blocks.new_zeros(n, k, k)
    landmarks = _LandmarkSums(structure, blocks)
    term_cost, couplings = {}, {}

    for name, term in problem.terms.items():
        cost = blocks.new_zeros(1)
        coupling = structure.couplings.get(name)
        if coupling is not None and coupling.order is not None:
            term = rows(term, coupling.order)
        if coupling is not None:
            couplings[name] = blocks.new_zeros(len(coupling.block), coupling.column.shape[1], k)
        for at, piece in chunks(term, chunk_rows):
            part = row_blocks(piece, kinds, values)
            cost += part.rho.sum() / 2
            chained = [i for i, (slot, _) in enumerate(piece.slots) if slot in base]
            index = [piece.slots[i][1] + base[piece.slots[i][0]] for i in chained]
            for i, block in zip(chained, index, strict=True):
                diagonal.index_add_(1, block, part.hessian[i, i].flatten(0, 1))
                chain_gradient.index_add_(1, block, part.gradient[i])
            if len(chained) == 2:
                _add_link(link, structure, index[0], index[1], part.hessian[0, 1].permute(2, 0, 1))
            if coupling is not None:
                _add_mixed(couplings[name], coupling, at, part)
            landmarks.add(piece, part)
        term_cost[name] = cost
    total = torch.stack(list(term_cost.values())).sum(0)
    return ChainNormalEquations(
        total,
        term_cost,
        structure,
        diagonal.mT.reshape(n, k, k),
        link,
        chain_gradient.mT.contiguous(),
        couplings,
        landmarks.hessian(),
        landmarks.gradient(),
        store,
    )


def _add_mixed(mixed: Tensor, coupling: Coupling, at: slice, part: RowBlocks) -> None:
    """Adds the blocks between the eliminated slot and the others, [f, l, k], in place."""
    slot, start = coupling.slot, 0
    for other in range(len(part.gradient)):
        if other == slot:
            continue
        cross = part.hessian[min(slot, other), max(slot, other)]
        cross = cross.permute(2, 1, 0) if slot < other else cross.permute(2, 0, 1)
        here = slice(start, start + cross.shape[1])
        start = here.stop
        if coupling.factor_of_row is None:
            mixed[at, here] = cross
        else:
            mixed[:, here].index_add_(0, coupling.factor_of_row[at], cross)


class _LandmarkSums:
    """Gradient and Hessian of the variables that stay, summed by block before they go into one matrix."""

    def __init__(self, structure: ChainStructure, like: Tensor) -> None:
        where = structure.where
        self.offset, self.dim, self.like = where.offset, where.dim, like
        sizes = {name: (where.tangent_dim[name], len(at)) for name, at in self.offset.items()}
        self.gradients = {name: like.new_zeros(k, n) for name, (k, n) in sizes.items()}
        self.squares = {name: like.new_zeros(k * k, n) for name, (k, n) in sizes.items()}
        self.matrix = like.new_zeros(self.dim, self.dim)

    def add(self, piece: CostTerm, part: RowBlocks) -> None:
        """Adds the rows' blocks among landmarks."""
        stays = [i for i, (slot, _) in enumerate(piece.slots) if slot in self.offset]
        for i in stays:
            name, index = piece.slots[i]
            self.gradients[name].index_add_(1, index, part.gradient[i])
            self.squares[name].index_add_(1, index, part.hessian[i, i].flatten(0, 1))
            for j in stays:
                if i < j:
                    other, index_j = piece.slots[j]
                    at, at_j = self.offset[name][index], self.offset[other][index_j]
                    self._scatter(at, at_j, part.hessian[i, j])
                    self._scatter(at_j, at, part.hessian[i, j].transpose(0, 1))

    def hessian(self) -> Tensor:
        """The Hessian [dim, dim]."""
        for name, square in self.squares.items():
            k = len(self.gradients[name])
            self._scatter(self.offset[name], self.offset[name], square.view(k, k, -1))
        return self.matrix

    def gradient(self) -> Tensor:
        """The gradient [dim]."""
        packed = self.like.new_zeros(self.dim)
        for name, gradient in self.gradients.items():
            at = self.offset[name] + torch.arange(len(gradient), device=packed.device)[:, None]
            packed[at] = gradient
        return packed

    def _scatter(self, row: Tensor, column: Tensor, block: Tensor) -> None:
        rows, columns, _ = block.shape
        steps = torch.arange(max(rows, columns), device=row.device)[:, None]
        at = (row + steps[:rows])[:, None] * self.dim + (column + steps[:columns])
        self.matrix.view(-1).index_add_(0, at.flatten(), block.flatten())


def _add_link(
    link: Tensor,
    structure: ChainStructure,
    first: Int[Tensor, " m"],
    second: Int[Tensor, " m"],
    block: Float[Tensor, "m k k"],
) -> None:
    """Adds the blocks between two eliminated blocks, whichever the row names first, in place."""
    low, high = torch.minimum(first, second), torch.maximum(first, second)
    chain = structure.chain
    leaves = len(structure.carrier)
    neighbours = (high == low + 1) & (chain[low] == chain[high]) & (low >= leaves)
    carried = torch.zeros_like(neighbours)
    of_leaf = (low < leaves) & (high >= leaves)
    carried[of_leaf] = structure.carrier[low[of_leaf]] == high[of_leaf] - leaves
    if not bool((neighbours | carried).all()):
        raise ValueError(
            "a term links two eliminated blocks that are neither neighbours in their chain "
            "nor a leaf and the block that carries it"
        )
    link.index_add_(0, low, torch.where((first < second)[:, None, None], block, block.mT))
