"""The rows of a problem, linearised and added up: the one loop over terms that every back end's normal equations come from.

A row with Jacobians J_i by its slots, residual r and robust weight w adds to the gradient and to the Hessian by blocks,

    g_i += J_i^T w r        H_ij += J_i^T w J_j        for its slots i <= j.

`assemble` computes them in chunks, rows last; where they go is for the back end to say. Rows that touch the same blocks may
be added up before they are handed over: the corners of a sign in one frame, the points of a lane's stretch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.optim.linearize import RowBlocks, of_pieces, row_gradients, term_costs
from crowdmap_torch.optim.problem import CostTerm, Problem, Values, Variable
from crowdmap_torch.processes.sums import add_at, lasting

_Linearize = Callable[[CostTerm, Mapping[str, Variable], Values], RowBlocks]


@dataclass(frozen=True)
class RowGroups:
    """Rows of a term that touch the same blocks, group by group."""

    order: Int[Tensor, " m"] | None = None
    """The term's rows in the order of their groups; None: they are in that order already."""
    of_row: Int[Tensor, " m"] | None = None
    """In that order, the group of each; None: every row is its own."""

    def added_up(self, chunk: TermRows) -> TermRows:
        """A chunk of rows in that order as a chunk of groups, of which the first may have begun in the chunk before."""
        if self.of_row is None or chunk.at.start == chunk.at.stop:
            return chunk
        group = self.of_row[chunk.at]
        of, begins, at = lasting("groups", lambda: _runs(group), group)
        slots = tuple(
            (name, lasting("begins", lambda block=block: block[begins], block, group))
            for name, block in chunk.slots
        )
        return TermRows(chunk.term, at, slots, chunk.blocks.added_up(of, at.stop - at.start))


def _runs(group: Int[Tensor, " m"]) -> tuple[Int[Tensor, " m"], Int[Tensor, " g"], slice]:
    """Groups that follow on each other, counted from the first on; the first row of each; and which they are."""
    first, last = torch.stack((group[0], group[-1])).tolist()
    begins = torch.ones_like(group, dtype=torch.bool)
    begins[1:] = group[1:] != group[:-1]
    return group - first, torch.nonzero(begins)[:, 0], slice(first, last + 1)


@dataclass(frozen=True)
class TermRows:
    """A chunk of a term's rows, linearised, or of groups of them, added up."""

    term: str
    at: slice
    """Which of the term's rows, or of its groups, they are."""
    slots: tuple[tuple[str, Int[Tensor, " m"]], ...]
    blocks: RowBlocks


@dataclass(frozen=True)
class Costs:
    """What the rows cost, for each of the independent problems."""

    total: Float[Tensor, " groups"]
    by_term: Mapping[str, Float[Tensor, " groups"]]

    @classmethod
    def at(cls, problem: Problem, values: Values) -> Costs:
        """What the terms of everybody cost at values, without any derivative."""
        by_term = term_costs(problem, values)
        return cls(torch.stack(list(by_term.values())).sum(0), by_term)


def assemble(
    problem: Problem,
    values: Values,
    linearize: _Linearize,
    add: Callable[[TermRows], None],
    *,
    groups: Mapping[str, RowGroups] | None = None,
    chunk_rows: int | None = None,
) -> Costs:
    """The cost of every term; `add` is handed all rows, chunk by chunk, as `linearize` gives them.

    Those of a term that has `groups` are handed over in their order, and added up by group.
    """
    like = next(iter(values.values()))
    by_term = {name: like.new_zeros(problem.group_count) for name in problem.terms}
    group_of = {name: (groups or {}).get(name, RowGroups()) for name in problem.terms}

    def linearised(name: str, at: slice, piece: CostTerm) -> tuple[CostTerm, Tensor, TermRows]:
        blocks = linearize(piece, problem.variables, values)
        own = TermRows(name, at, piece.slots, blocks)
        return piece, blocks.rho, group_of[name].added_up(own)

    orders = {name: of.order for name, of in group_of.items()}
    for name, (piece, rho, chunk) in of_pieces(
        problem, linearised, like.device, orders=orders, chunk_rows=chunk_rows
    ):
        group = problem.group_of_rows(piece)
        if group is None:
            by_term[name] += rho.sum() / 2
        else:
            add_at(by_term[name], 0, group, rho / 2)
        add(chunk)
    return Costs(torch.stack(list(by_term.values())).sum(0), by_term)


def cost_and_gradient(problem: Problem, values: Values) -> tuple[Costs, dict[str, Tensor]]:
    """The cost of every term, and the gradient [n, k] by the tangents of every variable; of everybody's terms."""
    gradient = {
        name: values[name].new_zeros(kind.tangent_dim, len(values[name]))
        for name, kind in problem.variables.items()
    }

    def add(chunk: TermRows) -> None:
        for (name, block), pull in zip(chunk.slots, chunk.blocks.gradient, strict=True):
            add_at(gradient[name], 1, block, pull)

    costs = assemble(problem, values, row_gradients, add)
    found = {name: of.mT.contiguous() for name, of in gradient.items()}
    costs, in_common = of_everybody(
        problem, costs, {name: of for name, of in found.items() if name in problem.common}
    )
    return costs, {**found, **in_common}


def of_everybody(
    problem: Problem, costs: Costs, in_common: Mapping[str, Tensor]
) -> tuple[Costs, dict[str, Tensor]]:
    """Costs, and what there is by name of what all have in common, added up over all who have terms of the problem."""
    if problem.together.is_alone:
        return costs, dict(in_common)
    # In one meeting.
    own = {f"cost {name}": cost for name, cost in costs.by_term.items()}
    total = problem.together.sum({**own, **{f"of {name}": of for name, of in in_common.items()}})
    by_term, summed = (
        {key.removeprefix(kind): of for key, of in total.items() if key.startswith(kind)}
        for kind in ("cost ", "of ")
    )
    return Costs(torch.stack(list(by_term.values())).sum(0), by_term), summed


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

    def add(self, chunk: TermRows) -> None:
        """Adds the rows' gradients and diagonal blocks."""
        for i, (name, block) in enumerate(chunk.slots):
            add_at(self._gradient[name], 1, block, chunk.blocks.gradient[i])
            # The blocks are symmetric.
            for row, entries in enumerate(chunk.blocks.hessian[i, i]):
                add_at(self._square[name][row, row:], 1, block, entries[row:])

    def gradient(self, name: str) -> Float[Tensor, "n k"]:
        """The gradient of a variable."""
        return self._gradient[name].mT.contiguous()

    def hessian(self, name: str) -> Float[Tensor, "n k k"]:
        """The diagonal blocks of a variable, which are handed over: they are here no more."""
        # The blocks are symmetric; the sums, their upper triangles, go before the lower ones come.
        upper = self._square.pop(name).permute(2, 0, 1).contiguous()
        return upper.add_(upper.triu(1).mT)


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
    add_at(matrix, 0, at.flatten(), block.flatten())
