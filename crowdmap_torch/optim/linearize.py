"""Residuals, costs and block Jacobians of a cost term, at zero tangent."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import jacfwd, vmap

from crowdmap_torch.optim.parallel import in_order
from crowdmap_torch.optim.problem import CostTerm, Problem, Values, Variable
from crowdmap_torch.optim.robust import JointLoss

CHUNK_ROWS = 1 << 14
"""Rows that are linearised at once; bounds the memory, whatever the size of the problem."""


@dataclass(frozen=True)
class LinearRows:
    """Rows of a term, whitened: residuals, one Jacobian per slot, and the robust weights."""

    residual: Float[Tensor, "m d"]
    jacobians: tuple[Float[Tensor, "m d _"], ...]
    robust_weight: Float[Tensor, " m"]
    rho: Float[Tensor, " m"]


def rows(term: CostTerm, index: slice | Tensor) -> CostTerm:
    """The same term, restricted to some of its rows."""
    return replace(
        term,
        slots=tuple((name, block[index]) for name, block in term.slots),
        constants=tuple(constant[index] for constant in term.constants),
        weight=None if term.weight is None else term.weight[index],
        loss=term.loss.of_rows(index) if isinstance(term.loss, JointLoss) else term.loss,
    )


def chunks(term: CostTerm, size: int = CHUNK_ROWS) -> Iterator[tuple[slice, CostTerm]]:
    """The term in pieces of at most `size` rows; those that a loss joins stay in one piece, however many they are."""
    start = 0
    while start < len(term):
        stop = min(start + size, len(term))
        if isinstance(term.loss, JointLoss):
            stop = term.loss.cut(start, stop)
        piece = slice(start, stop)
        yield piece, rows(term, piece)
        start = stop


def residuals(term: CostTerm, values: Values) -> Float[Tensor, "m d"]:
    """Whitened residuals of all rows."""
    if not len(term):
        return torch.zeros(0, 1, dtype=next(iter(values.values())).dtype)
    blocks = [values[name][block] for name, block in term.slots]
    batched = term.batched or vmap(term.residual)
    return _whiten(term, batched(*blocks, *term.constants))


def linearize(term: CostTerm, variables: dict[str, Variable], values: Values) -> LinearRows:
    """Whitened residuals and Jacobians of all rows at zero tangent, with the loss's weights."""
    blocks = [values[name][block] for name, block in term.slots]
    if term.jacobian is not None:
        residual, jacobians = term.jacobian(*blocks, *term.constants)
    else:
        residual, jacobians = autograd_jacobians(term, variables, values)
    if term.weight is not None:
        scale = term.weight if term.weight.ndim == 2 else term.weight[:, None]
        residual = residual * scale
        jacobians = tuple(J * scale[..., None] for J in jacobians)
    s = residual.square().sum(-1)
    return LinearRows(residual, jacobians, term.loss.weight(s), term.loss.rho(s))


@dataclass(frozen=True)
class RowGradients:
    """Every row's loss and gradient, by slot, with the rows as the last axis.

    Rows last: the blocks are small and the rows many, so that every operation runs along the rows.
    """

    rho: Float[Tensor, " m"]
    gradient: tuple[Float[Tensor, "_ m"], ...]
    """`J_i^T W r` of every slot i."""


@dataclass(frozen=True)
class RowBlocks(RowGradients):
    """Every row's part of the normal equations."""

    hessian: Mapping[tuple[int, int], Float[Tensor, "_ _ m"]]
    """`J_i^T W J_j` of every two slots i <= j."""


def row_blocks(term: CostTerm, variables: dict[str, Variable], values: Values) -> RowBlocks:
    """Every row's gradient and Hessian blocks, by the term's own function or from its Jacobians."""
    if term.normal is not None:
        blocks = tuple(values[name][block] for name, block in term.slots)
        return term.normal(blocks, term.constants, term.weight, term.loss)
    linear = linearize(term, variables, values)
    return blocks_of_jacobians(
        linear.residual.mT,
        tuple(J.permute(1, 2, 0) for J in linear.jacobians),
        linear.robust_weight,
        linear.rho,
    )


def row_gradients(term: CostTerm, variables: dict[str, Variable], values: Values) -> RowGradients:
    """Every row's gradient, by the term's own function or from its blocks."""
    if term.gradient is None:
        return row_blocks(term, variables, values)
    blocks = tuple(values[name][block] for name, block in term.slots)
    return term.gradient(blocks, term.constants, term.weight, term.loss)


def blocks_of_jacobians(
    residual: Float[Tensor, "d m"],
    jacobians: tuple[Float[Tensor, "d _ m"], ...],
    robust_weight: Float[Tensor, " m"],
    rho: Float[Tensor, " m"],
) -> RowBlocks:
    """Blocks of whitened residuals and Jacobians, rows last."""
    jacobians = tuple(J.contiguous() for J in jacobians)
    weighted = tuple(J * robust_weight for J in jacobians)
    return RowBlocks(
        rho,
        tuple(sum_of_products(J, residual[:, None]).squeeze(1) for J in weighted),
        {
            (i, j): sum_of_products(weighted[i], jacobians[j])
            for i in range(len(jacobians))
            for j in range(i, len(jacobians))
        },
    )


def sum_of_products(a: Float[Tensor, "d k m"], b: Float[Tensor, "d l m"]) -> Float[Tensor, "k l m"]:
    """`a^T b` of every row, rows last."""
    total = a[0, :, None] * b[0]
    for i in range(1, len(a)):
        total.addcmul_(a[i, :, None], b[i])
    return total


def autograd_jacobians(
    term: CostTerm, variables: dict[str, Variable], values: Values
) -> tuple[Float[Tensor, "m d"], tuple[Float[Tensor, "m d _"], ...]]:
    """Residuals and Jacobians (not whitened) by forward-mode autograd through every retraction."""
    blocks = tuple(values[name][block] for name, block in term.slots)
    kinds = [variables[name] for name, _ in term.slots]

    def moved(tangents, blocks, constants):
        at = [
            kind.retract(block[None], xi[None])[0]
            for kind, block, xi in zip(kinds, blocks, tangents, strict=True)
        ]
        residual = term.residual(*at, *constants)
        return residual, residual

    zero = tuple(blocks[0].new_zeros(len(term), kind.tangent_dim) for kind in kinds)
    jacobians, residual = vmap(jacfwd(moved, argnums=0, has_aux=True))(zero, blocks, term.constants)
    return residual, jacobians


def term_costs(
    problem: Problem, values: Values, *, chunk_rows: int = CHUNK_ROWS
) -> dict[str, Float[Tensor, " groups"]]:
    """`1/2 sum rho` of every term, for each of the independent problems."""
    first = next(iter(values.values()))
    costs = {}
    for name, term in problem.terms.items():
        pieces = [piece for _, piece in chunks(term, chunk_rows)]
        losses = in_order(lambda piece: _losses(problem, piece, values), pieces, first.device)
        total = torch.stack([first.new_zeros(problem.group_count), *losses]).sum(0)
        costs[name] = total
    return costs


def _losses(problem: Problem, piece: CostTerm, values: Values) -> Float[Tensor, " groups"]:
    """`1/2 sum rho` of some rows, for each of the independent problems."""
    rho = piece.loss.rho(residuals(piece, values).square().sum(-1)) / 2
    group = problem.group_of_rows(piece)
    if group is None:
        return rho.sum()[None]
    return rho.new_zeros(problem.group_count).index_add_(0, group, rho)


def _whiten(term: CostTerm, residual: Float[Tensor, "m d"]) -> Float[Tensor, "m d"]:
    if term.weight is None:
        return residual
    return residual * (term.weight if term.weight.ndim == 2 else term.weight[:, None])
