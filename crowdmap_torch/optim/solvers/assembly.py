"""The rows of a problem, linearised and added up: the one loop over terms that every back end's normal equations come from.

A row with Jacobians J_i by its slots, residual r and robust weight w adds to the gradient and to the Hessian by blocks,

    g_i += J_i^T w r        H_ij += J_i^T w J_j        for its slots i <= j.

`assemble` computes them in chunks, rows last; where they go is for the back end to say.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.linearize import CHUNK_ROWS, RowBlocks, chunks, rows
from crowdmap_torch.optim.problem import CostTerm, Problem, Values, Variable
from crowdmap_torch.processes.threads import in_order

_Blocks = TypeVar("_Blocks", bound=RowBlocks)
_Blocks_co = TypeVar("_Blocks_co", bound=RowBlocks, covariant=True)
_Linearize = Callable[[CostTerm, dict[str, Variable], Values], _Blocks]


@dataclass(frozen=True)
class TermRows(Generic[_Blocks_co]):
    """A chunk of a term's rows, linearised."""

    term: str
    at: slice
    """Which of the term's rows they are."""
    slots: tuple[tuple[str, Int[Tensor, " m"]], ...]
    blocks: _Blocks_co


@dataclass(frozen=True)
class Costs:
    """What the rows cost, for each of the independent problems."""

    total: Float[Tensor, " groups"]
    by_term: Mapping[str, Float[Tensor, " groups"]]


def assemble(
    problem: Problem,
    values: Values,
    linearize: _Linearize[_Blocks],
    add: Callable[[TermRows[_Blocks]], None],
    *,
    order: Mapping[str, Int[Tensor, " m"] | None] | None = None,
    chunk_rows: int = CHUNK_ROWS,
) -> Costs:
    """The cost of every term; `add` is handed all rows, chunk by chunk, as `linearize` gives them.

    Rows of a term in `order` are taken in that order.
    """
    like = next(iter(values.values()))
    by_term = {}
    for name, term in problem.terms.items():
        cost = like.new_zeros(problem.group_count)
        chosen = (order or {}).get(name)
        pieces = list(chunks(term if chosen is None else rows(term, chosen), chunk_rows))
        computed = _computed(linearize, problem, [piece for _, piece in pieces], values)
        for (at, piece), blocks in zip(pieces, computed, strict=True):
            group = problem.group_of_rows(piece)
            if group is None:
                cost += blocks.rho.sum() / 2
            else:
                cost.index_add_(0, group, blocks.rho / 2)
            add(TermRows(name, at, piece.slots, blocks))
        by_term[name] = cost
    return Costs(torch.stack(list(by_term.values())).sum(0), by_term)


def _computed(
    linearize: _Linearize[_Blocks], problem: Problem, pieces: list[CostTerm], values: Values
) -> Iterable[_Blocks]:
    """Every piece of a term linearised, in order, on all cores."""
    kinds = dict(problem.variables)

    def one(piece: CostTerm) -> _Blocks:
        return linearize(piece, kinds, values)

    if not pieces:
        return ()
    return in_order(one, pieces, pieces[0].slots[0][1].device)


def pairs(count: int) -> Iterator[tuple[int, int]]:
    """The slots i < j of a row."""
    return ((i, j) for j in range(count) for i in range(j))


class BlockDiagonal:
    """Gradient and diagonal blocks of the Hessian of every variable, summed over rows, rows last."""

    def __init__(self, problem: Problem, values: Values) -> None:
        like = next(iter(values.values()))
        self._gradient, self._square = {}, {}
        for name, kind in problem.variables.items():
            n, k = len(values[name]), kind.tangent_dim
            self._gradient[name] = like.new_zeros(k, n)
            self._square[name] = like.new_zeros(k, k, n)

    def add(self, chunk: TermRows[RowBlocks]) -> None:
        """Adds the rows' gradients and diagonal blocks."""
        for i, (name, block) in enumerate(chunk.slots):
            self._gradient[name].index_add_(1, block, chunk.blocks.gradient[i])
            # The blocks are symmetric.
            for row, entries in enumerate(chunk.blocks.hessian[i, i]):
                self._square[name][row, row:].index_add_(1, block, entries[row:])

    def gradient(self, name: str) -> Float[Tensor, "n k"]:
        """The gradient of a variable."""
        return self._gradient[name].mT.contiguous()

    def hessian(self, name: str) -> Float[Tensor, "n k k"]:
        """The diagonal blocks of a variable."""
        upper = self._square[name].permute(2, 0, 1).contiguous()
        return upper + upper.triu(1).mT


def add_blocks(
    matrix: Float[Tensor, " size"],
    row: Int[Tensor, " m"],
    column: Int[Tensor, " m"],
    stride: int,
    block: Float[Tensor, "k l m"],
) -> None:
    """Adds blocks into a flattened matrix of `stride` columns, each from its row and column on; in place."""
    height, width, _ = block.shape
    down = torch.arange(height, device=row.device)[:, None, None]
    right = torch.arange(width, device=row.device)[:, None]
    at = (row + down) * stride + (column + right)
    matrix.index_add_(0, at.flatten(), block.flatten())
