"""Rows of cost terms, linearised: whole and in chunks, with Jacobians that are dense, sparse or follow another."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from crowdmap_torch.optim import linearize
from crowdmap_torch.optim.problem import (
    CostTerm,
    Follows,
    Problem,
    SparseJacobian,
    Values,
    Variable,
    euclidean,
    positive,
)
from crowdmap_torch.optim.robust import JointTukey, Tukey

ROWS = 11
VARIABLES = {"a": Variable(2, euclidean), "b": Variable(2, positive)}


def apart(a: Tensor, b: Tensor, measured: Tensor) -> Tensor:
    """A residual of three numbers that bends in both of its blocks."""
    return torch.stack((a[0] - b[0], a[1] * b[1], a[0] * a[1])) - measured


@pytest.fixture
def values() -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(3)
    return {
        "a": torch.randn(5, 2, dtype=torch.float64, generator=generator),
        "b": torch.rand(4, 2, dtype=torch.float64, generator=generator) + 0.5,
    }


@pytest.fixture
def term() -> CostTerm:
    generator = torch.Generator().manual_seed(4)
    measured = torch.randn(ROWS, 3, dtype=torch.float64, generator=generator)
    weight = torch.rand(ROWS, 3, dtype=torch.float64, generator=generator) + 0.5
    at = torch.arange(ROWS)
    return CostTerm(apart, (("a", at % 5), ("b", at % 4)), (measured,), weight, Tukey(4.0))


def by_hand(term: CostTerm, values: Values) -> Tensor:
    """The whitened residuals, row by row."""
    assert term.weight is not None
    (a, of_a), (b, of_b) = term.slots
    each = zip(values[a][of_a], values[b][of_b], term.constants[0], strict=True)
    return torch.stack([apart(*row) for row in each]) * term.weight


def test_residuals_are_those_of_each_row_whitened(term: CostTerm, values: Values):
    assert torch.allclose(linearize.residuals(term, values), by_hand(term, values), atol=1e-15)


def test_jacobians_are_the_change_of_the_whitened_residual(term: CostTerm, values: Values):
    found = linearize.linearize(term, VARIABLES, values)
    h = 1e-6
    for (name, block), J in zip(term.slots, found.jacobians, strict=True):
        for k in range(VARIABLES[name].tangent_dim):
            delta = torch.zeros_like(values[name])
            delta[:, k] = h
            ends = [
                by_hand(term, {**values, name: VARIABLES[name].retract(values[name], s * delta)})
                for s in (1, -1)
            ]
            # Central differences of a quadratic: rounding over the step is what remains.
            assert torch.allclose(J[:, k].mT, (ends[0] - ends[1]) / (2 * h), atol=1e-8), name
        assert J.shape == (3, 2, len(block))


def test_blocks_of_rows_are_products_of_weighted_jacobians(term: CostTerm, values: Values):
    found = linearize.linearize(term, VARIABLES, values)
    blocks = linearize.row_blocks(term, VARIABLES, values)
    for i, J in enumerate(found.jacobians):
        pull = torch.einsum("dkm,dm,m->km", J, found.residual, found.robust_weight)
        assert torch.allclose(blocks.gradient[i], pull, atol=1e-13)
        for j in range(i, 2):
            square = torch.einsum("dkm,dlm,m->klm", J, found.jacobians[j], found.robust_weight)
            assert torch.allclose(blocks.hessian[i, j], square, atol=1e-13)
    assert torch.equal(blocks.rho, found.rho)


def structured(
    x: Tensor, y: Tensor
) -> tuple[Tensor, tuple[Tensor | SparseJacobian | Follows, ...]]:
    """`2 x - 2 y` of vectors of two numbers, with a diagonal Jacobian and one that follows it."""
    return 2 * (x - y), (SparseJacobian.diagonal(2 * torch.ones_like(x)), Follows(2))


def test_what_is_known_of_a_jacobian_changes_no_block(values: Values):
    variables = {"a": Variable(2, euclidean), "b": Variable(2, euclidean)}
    at = torch.arange(4)
    closed = CostTerm(
        lambda x, y: 2 * (x - y),
        (("a", at), ("b", at)),
        weight=1 + at.double(),
        jacobian=structured,
    )
    plain = replace(closed, jacobian=None)
    known, found = (linearize.row_blocks(t, variables, values) for t in (closed, plain))
    for key in found.hessian:
        assert torch.allclose(known.hessian[key], found.hessian[key], atol=1e-14)
    for a, b in zip(known.gradient, found.gradient, strict=True):
        assert torch.allclose(a, b, atol=1e-14)


@pytest.mark.parametrize("size", [1, 4, ROWS, 100])
def test_chunks_make_up_the_term(term: CostTerm, values: Values, size: int):
    whole = linearize.residuals(term, values)
    pieces = [linearize.residuals(piece, values) for _, piece in linearize.chunks(term, size)]
    assert torch.equal(torch.cat(pieces), whole)
    assert all(len(piece) <= size for piece in pieces)


@pytest.mark.parametrize("rows_last", [True, False])
def test_pieces_of_a_term_do_not_copy_what_is_constant(rows_last: bool):
    constant = torch.arange(12.0).view(2, 6)
    constant = constant.mT if rows_last else constant.mT.contiguous()
    term = CostTerm(lambda x, y: x - y, (("a", torch.arange(6)),), (constant,))
    for at, piece in linearize.chunks(term, 2):
        (part,) = piece.constants
        assert torch.equal(part, constant[at])
        assert part.untyped_storage().data_ptr() == constant.untyped_storage().data_ptr()
    some = torch.tensor([4, 1, 1])
    assert torch.equal(linearize.rows(term, some).constants[0], constant[some])


def test_chunks_do_not_part_rows_that_share_a_weight(term: CostTerm):
    together = torch.tensor([0, 0, 0, 1, 1, 2, 2, 2, 2, 3, 4])
    bound = torch.tensor(4.0).double()
    joined = replace(term, loss=JointTukey.by_efficiency(together, bound, row_dim=3))
    cuts = [piece.stop for piece, _ in linearize.chunks(joined, 4)]
    ends = torch.nonzero(together[1:] != together[:-1])[:, 0] + 1
    assert len(cuts) > 1
    assert set(cuts[:-1]) <= set(ends.tolist())


def test_costs_add_up_by_group(term: CostTerm, values: Values):
    group = torch.tensor([0, 1, 1, 0, 2])
    variables = {**VARIABLES, "a": replace(VARIABLES["a"], group=group)}
    problem = Problem(variables, {"t": term}, group_count=3)
    rho = term.loss.rho(by_hand(term, values).square().sum(-1)) / 2
    of = group[term.slots[0][1]]
    expected = torch.stack([rho[of == g].sum() for g in range(3)])
    for chunk_rows in (2, 100):
        costs = linearize.term_costs(problem, values, chunk_rows=chunk_rows)
        assert torch.allclose(costs["t"], expected, atol=1e-14)


def test_weights_that_all_rows_share_need_no_memory_of_their_own(term: CostTerm, values: Values):
    one = torch.tensor([2.0, 0.5, 3.0], dtype=torch.float64)
    shared = replace(term, weight=one.expand(len(term), 3))
    own = replace(term, weight=one.repeat(len(term), 1))
    some, others = (linearize.row_blocks(t, VARIABLES, values) for t in (shared, own))
    assert torch.equal(some.rho, others.rho)
    assert all(map(torch.equal, some.gradient, others.gradient))
    assert all(torch.equal(some.hessian[key], others.hessian[key]) for key in others.hessian)


def test_a_term_without_rows_has_no_residuals(term: CostTerm, values: Values):
    none = linearize.rows(term, slice(0, 0))
    assert linearize.residuals(none, values).numel() == 0
