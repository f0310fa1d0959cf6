"""Residuals, costs and block Jacobians of a cost term, at zero tangent."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.func import vjp, vmap

from crowdmap_torch.optim.problem import (
    CostTerm,
    Follows,
    Jacobian,
    Problem,
    SparseJacobian,
    Values,
    Variable,
)
from crowdmap_torch.optim.robust import is_joint
from crowdmap_torch.processes.amounts import at_once
from crowdmap_torch.processes.sums import add_at
from crowdmap_torch.processes.threads import in_order

CHUNK_ROWS = 1 << 14
"""Rows that are linearised at once on a CPU; bounds the memory, whatever the size of the problem."""
_MANY_ROWS = 1 << 15
"""Rows of a problem from which a second core is worth handing pieces over to it."""
R = TypeVar("R")


def rows(term: CostTerm, index: slice | Tensor) -> CostTerm:
    """The same term, restricted to some of its rows."""
    return replace(
        term,
        slots=tuple((name, block[index]) for name, block in term.slots),
        constants=tuple(_some_rows(constant, index) for constant in term.constants),
        weight=None if term.weight is None else term.weight[index],
        loss=term.loss.of_rows(index) if is_joint(term.loss) else term.loss,
        shared=None if term.shared is None else term.shared.of_rows(index),
    )


def _some_rows(constant: Float[Tensor, "m ..."], index: slice | Tensor) -> Float[Tensor, "n ..."]:
    """Some rows, as they lie in memory: rows last stay so, and are not copied where they follow each other."""
    if constant.movedim(0, -1).stride(-1) == 1:
        return constant.movedim(0, -1)[..., index].movedim(-1, 0)
    return constant[index]


def chunks(term: CostTerm, size: int | None = None) -> Iterator[tuple[slice, CostTerm]]:
    """The term in pieces of at most `size` rows, by default as many as suit its device.

    Rows that are joined stay in one piece, however many they are.
    """
    for piece in _cuts(term, size):
        yield piece, rows(term, piece)


def _cuts(
    term: CostTerm, size: int | None, order: Int[Tensor, " m"] | None = None
) -> Iterator[slice]:
    """Where the pieces of a term are, its rows in an `order` of their own."""
    size = size or at_once(CHUNK_ROWS, term.slots[0][1].device)
    joint = term.loss if is_joint(term.loss) else term.shared
    if joint is not None and order is not None:
        joint = joint.of_rows(order)
    start = 0
    while start < len(term):
        stop = min(start + size, len(term))
        if joint is not None:
            stop = joint.cut(start, stop)
        yield slice(start, stop)
        start = stop


def of_pieces(
    problem: Problem,
    function: Callable[[str, slice, CostTerm], R],
    device: torch.device,
    *,
    orders: Mapping[str, Int[Tensor, " m"] | None] | None = None,
    chunk_rows: int | None = None,
) -> Iterator[tuple[str, R]]:
    """`function` of all pieces of all terms, term by term, each handed its term's name, its rows there and itself.

    The rows of terms that have `orders` are taken in those. Pieces of different terms are seen to side by side.
    """
    by_term = orders or {}
    pieces = [
        (name, at)
        for name, term in problem.terms.items()
        for at in _cuts(term, chunk_rows, by_term.get(name))
    ]

    def of_piece(piece: tuple[str, slice]) -> tuple[str, R]:
        name, at = piece
        order = by_term.get(name)
        return name, function(
            name, at, rows(problem.terms[name], at if order is None else order[at])
        )

    count = sum(map(len, problem.terms.values()))
    worth = 1 if count >= _MANY_ROWS else len(pieces) + 1
    return in_order(of_piece, pieces, device, worth=worth)


def residuals(term: CostTerm, values: Values) -> Float[Tensor, "m d"]:
    """Whitened residuals of all rows."""
    like = next(iter(values.values()))
    if not len(term):
        return like.new_zeros(0, 1)
    pieces = [piece for _, piece in chunks(term)]
    return torch.cat(list(in_order(lambda piece: _whitened(piece, values).mT, pieces, like.device)))


@dataclass(frozen=True)
class LinearRows:
    """Rows of a term, whitened: residuals, one Jacobian per slot, and the robust weights.

    The rows are the last axis: the blocks are small and the rows many, so that every operation runs along the rows.
    """

    residual: Float[Tensor, "d m"]
    jacobians: tuple[Float[Tensor, "d _ m"], ...]
    robust_weight: Float[Tensor, " m"]
    rho: Float[Tensor, " m"]


def linearize(term: CostTerm, variables: Mapping[str, Variable], values: Values) -> LinearRows:
    """Whitened residuals and Jacobians of all rows at zero tangent, with the loss's weights."""
    residual, jacobians = _jacobians(term, variables, values)
    jacobians = dense(jacobians)
    if term.weight is not None:
        scale = _scale(term.weight)
        residual = residual * scale
        jacobians = tuple(J * scale.unsqueeze(-2) for J in jacobians)
    s = residual.square().sum(0)
    return LinearRows(residual, jacobians, term.loss.weight(s), term.loss.rho(s))


@dataclass(frozen=True)
class RowBlocks:
    """Every row's loss and its part of the normal equations, by slot, with the rows as the last axis."""

    rho: Float[Tensor, " m"]
    gradient: tuple[Float[Tensor, "_ m"], ...]
    """`J_i^T W r` of every slot i."""
    hessian: Mapping[tuple[int, int], Float[Tensor, "_ _ m"]]
    """`J_i^T W J_j` of every two slots i <= j."""

    def added_up(self, group: Int[Tensor, " m"], count: int) -> RowBlocks:
        """The sums over groups of rows."""

        def of_groups(x: Float[Tensor, "*block m"]) -> Float[Tensor, "*block groups"]:
            flat = x.reshape(-1, x.shape[-1])
            total = add_at(flat.new_zeros(len(flat), count), 1, group, flat)
            return total.view(*x.shape[:-1], count)

        return RowBlocks(
            add_at(self.rho.new_zeros(count), 0, group, self.rho),
            tuple(map(of_groups, self.gradient)),
            {slots: of_groups(block) for slots, block in self.hessian.items()},
        )


def row_blocks(
    term: CostTerm, variables: Mapping[str, Variable], values: Values, *, slots: int | None = None
) -> RowBlocks:
    """Every row's gradient and Hessian blocks; of the first so many `slots` alone, where it is given."""
    residual, jacobians, weight, rho = _weighted(term, variables, values)
    jacobians = jacobians[:slots]
    hessian: dict[tuple[int, int], Tensor] = {}
    for i, J in enumerate(jacobians):
        pulling = J if isinstance(J, Follows) else _weighted_rows(J, weight)
        for j, other in enumerate(jacobians[i:], i):
            if isinstance(pulling, Follows):
                block = hessian[0, j][: pulling.columns] * pulling.factor
            elif isinstance(other, Follows):
                block = hessian[0, i].transpose(0, 1)[:, : other.columns] * other.factor
            else:
                block = _product(pulling, other)
            hessian[i, j] = block
    return RowBlocks(rho, _pulled(jacobians, residual * weight), hessian)


def first_blocks(
    term: CostTerm,
    variables: Mapping[str, Variable],
    values: Values,
    run: Int[Tensor, " m"],
    count: int,
) -> tuple[Float[Tensor, " m"], Float[Tensor, "n k"], Float[Tensor, "n k k"]]:
    """Losses of all rows, and gradient and Hessian block of the first slot, added up over `count` runs of rows."""
    k = variables[term.slots[0][0]].tangent_dim
    like = next(iter(values.values()))
    rho, gradient = like.new_zeros(len(run)), like.new_zeros(count, k)
    matrix = like.new_zeros(count, k * k)
    for at, piece in chunks(term):
        blocks = row_blocks(piece, variables, values, slots=1)
        rho[at] = blocks.rho
        add_at(gradient, 0, run[at], blocks.gradient[0].mT)
        add_at(matrix, 0, run[at], blocks.hessian[0, 0].flatten(0, 1).mT)
    return rho, gradient, matrix.view(count, k, k)


def row_gradients(term: CostTerm, variables: Mapping[str, Variable], values: Values) -> RowBlocks:
    """Every row's gradient, without Hessian blocks."""
    residual, jacobians, weight, rho = _weighted(term, variables, values)
    return RowBlocks(rho, _pulled(jacobians, residual * weight), {})


def dense(jacobians: tuple[Jacobian, ...]) -> tuple[Float[Tensor, "d _ m"], ...]:
    """All entries of the Jacobians of a term."""
    whole: list[Tensor] = []
    for J in jacobians:
        if isinstance(J, Follows):
            J = whole[0][:, : J.columns] * J.factor
        whole.append(J.dense() if isinstance(J, SparseJacobian) else J)
    return tuple(whole)


def sum_of_products(
    a: Float[Tensor, "d k *#m"], b: Float[Tensor, "d l *#m"]
) -> Float[Tensor, "k l *#m"]:
    """`a^T b`, of every row where rows are the last axis."""
    total = a[0, :, None] * b[0]
    for i in range(1, len(a)):
        total.addcmul_(a[i, :, None], b[i])
    return total


def _pulled(
    jacobians: tuple[Jacobian, ...], pull: Float[Tensor, "d m"]
) -> tuple[Float[Tensor, "_ m"], ...]:
    """`J^T pull` of every slot."""
    gradient: list[Tensor] = []
    for J in jacobians:
        if isinstance(J, Follows):
            gradient.append(gradient[0][: J.columns] * J.factor)
        else:
            gradient.append(_product(J, pull[:, None])[:, 0])
    return tuple(gradient)


def _product(a: Tensor | SparseJacobian, b: Tensor | SparseJacobian) -> Float[Tensor, "k l m"]:
    """`a^T b` of every row, without what is known to be zero."""
    if isinstance(a, Tensor) and isinstance(b, Tensor):
        return sum_of_products(a, b)
    (width, of_a), (height, of_b) = _entries(a), _entries(b)
    total = of_a[0][1].new_zeros(width, height, of_a[0][1].shape[-1])
    for (i, x), (j, y) in zip(of_a, of_b, strict=True):
        total[i : i + len(x), j : j + len(y)].addcmul_(x[:, None], y)
    return total


def _entries(J: Tensor | SparseJacobian) -> tuple[int, Sequence[tuple[int, Tensor]]]:
    """The number of columns, and by row of the residual the first column and the entries from there on."""
    return (
        (J.columns, J.rows) if isinstance(J, SparseJacobian) else (J.shape[1], [(0, x) for x in J])
    )


def _weighted_rows(
    J: Tensor | SparseJacobian, weight: Float[Tensor, "#d m"]
) -> Tensor | SparseJacobian:
    """A Jacobian times the weights of the residual's entries."""
    if isinstance(J, Tensor):
        return J * weight.unsqueeze(-2)
    each = weight.expand(len(J.rows), -1)
    rows = tuple((i, x * w) for (i, x), w in zip(J.rows, each, strict=True))
    return SparseJacobian(J.columns, rows)


def _weighted(
    term: CostTerm, variables: Mapping[str, Variable], values: Values
) -> tuple[Float[Tensor, "d m"], tuple[Jacobian, ...], Float[Tensor, "#d m"], Float[Tensor, " m"]]:
    """Residuals and Jacobians, not whitened, the weights W of their squares, and the rows' losses."""
    residual, jacobians = _jacobians(term, variables, values)
    scale = residual.new_ones(1, 1) if term.weight is None else _scale(term.weight)
    s = (residual * scale).square().sum(0)
    return residual, jacobians, scale.square() * term.loss.weight(s), term.loss.rho(s)


def _jacobians(
    term: CostTerm, variables: Mapping[str, Variable], values: Values
) -> tuple[Float[Tensor, "d m"], tuple[Jacobian, ...]]:
    """Residuals and one Jacobian per slot, in the term's closed form or by autograd; not yet whitened by its weights."""
    if term.jacobian is None:
        residual, jacobians = autograd_jacobians(term, variables, values)
    else:
        residual, jacobians = term.jacobian(*_arguments(term, values))
    jacobians = jacobians[: len(term.slots)]
    if term.shared is None:
        return residual, jacobians
    whiten = term.shared.whiten
    return whiten(residual), tuple(whiten(J) for J in dense(jacobians))


def autograd_jacobians(
    term: CostTerm, variables: Mapping[str, Variable], values: Values
) -> tuple[Float[Tensor, "d m"], tuple[Float[Tensor, "d _ m"], ...]]:
    """Residuals and Jacobians (not whitened) by reverse-mode autograd, and the chain rule through every retraction.

    One pass back for each number of the residual: rows do not depend on each other, so it gives that number's derivatives
    for all rows at once.
    """
    kinds = [variables[name] for name, _ in term.slots]
    arguments = _arguments(term, values)
    blocks = [block.detach().requires_grad_() for block in arguments[: len(kinds)]]
    with torch.enable_grad():
        residual = _evaluate(term, (*blocks, *arguments[len(kinds) :]))
        # Sums: to be given ones for each row, autograd would import sympy, half a second.
        numbers = residual.sum(1).unbind(0) if residual.requires_grad else ()
    by_number = [_by_blocks(number, blocks) for number in numbers]
    jacobians = [
        _pulled_back(kind, block.detach(), torch.stack(by_block))
        for kind, block, by_block in zip(kinds, blocks, zip(*by_number, strict=True), strict=True)
    ] or [residual.new_zeros(len(residual), kind.tangent_dim, len(term)) for kind in kinds]
    return residual.detach(), tuple(jacobians)


def _by_blocks(number: Float[Tensor, ""], blocks: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """The derivatives of one number's sum over all rows by the blocks: of every row by its own ones."""
    found = torch.autograd.grad(number, blocks, retain_graph=True, allow_unused=True)
    return tuple(
        torch.zeros_like(block) if x is None else x for x, block in zip(found, blocks, strict=True)
    )


def _pulled_back(
    kind: Variable, block: Float[Tensor, "*block m"], gradient: Float[Tensor, "d *block m"]
) -> Float[Tensor, "d k m"]:
    """Derivatives by a variable's tangents at zero, of those by its value."""
    if kind.pull is not None:
        return kind.pull(block, gradient)
    value = block.movedim(-1, 0)

    def moved(tangent: Tensor) -> Tensor:
        return kind.retract(value, tangent)

    _, pull, *_ = vjp(moved, value.new_zeros(len(value), kind.tangent_dim))
    return torch.stack([pull(row.movedim(-1, 0))[0].mT for row in gradient])


def _whitened(term: CostTerm, values: Values) -> Float[Tensor, "d m"]:
    """Whitened residuals of all rows."""
    residual = _evaluate(term, _arguments(term, values))
    if term.shared is not None:
        residual = term.shared.whiten(residual)
    return residual if term.weight is None else residual * _scale(term.weight)


def _evaluate(term: CostTerm, arguments: tuple[Tensor, ...]) -> Float[Tensor, "d m"]:
    """The residual of all rows."""
    if term.takes_rows or term.jacobian is not None:
        return term.residual(*arguments)
    return vmap(term.residual, in_dims=-1, out_dims=-1)(*arguments)


def _arguments(term: CostTerm, values: Values) -> tuple[Tensor, ...]:
    """What the residual takes, the rows as the last axis: the blocks of every slot and the constants."""
    blocks = (values[name].index_select(0, block) for name, block in term.slots)
    return tuple(_rows_last(x) for x in (*blocks, *term.constants))


def _rows_last(x: Float[Tensor, "m ..."]) -> Float[Tensor, "... m"]:
    """The same with the rows as the last axis, and a row's next neighbour in memory: copied unless it lies there so."""
    x = x.movedim(0, -1)
    return x if x.stride(-1) == 1 else x.contiguous()


def _scale(weight: Float[Tensor, " m"] | Float[Tensor, "m d"]) -> Float[Tensor, "#d m"]:
    """Weights as factors of residuals, the rows as the last axis."""
    if weight.ndim == 1:
        return weight[None]
    # What is the same for all rows is one number in memory.
    return weight.mT if weight.stride(0) == 0 else weight.mT.contiguous()


def term_costs(
    problem: Problem, values: Values, *, chunk_rows: int | None = None
) -> dict[str, Float[Tensor, " groups"]]:
    """`1/2 sum rho` of every term, for each of the independent problems; of terms that others have as well."""
    first = next(iter(values.values()))
    losses = {name: [first.new_zeros(problem.group_count)] for name in problem.terms}
    for name, loss in of_pieces(
        *(problem, lambda _, __, piece: _losses(problem, piece, values), first.device),
        chunk_rows=chunk_rows,
    ):
        losses[name].append(loss)
    return problem.together.sum({name: torch.stack(of).sum(0) for name, of in losses.items()})


def _losses(problem: Problem, piece: CostTerm, values: Values) -> Float[Tensor, " groups"]:
    """`1/2 sum rho` of some rows, for each of the independent problems."""
    rho = piece.loss.rho(_whitened(piece, values).square().sum(0)) / 2
    group = problem.group_of_rows(piece)
    if group is None:
        return rho.sum()[None]
    return add_at(rho.new_zeros(problem.group_count), 0, group, rho)
