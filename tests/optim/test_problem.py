"""Variables, cost terms and sparse Jacobians as data."""

from __future__ import annotations

import torch

from crowdmap_torch.optim.problem import (
    CostTerm,
    Problem,
    SparseJacobian,
    Variable,
    euclidean,
    positive,
    retract,
)


def test_retractions_are_the_identity_at_zero():
    value = torch.tensor([[0.3, 2.0], [1e-6, 5e3]]).double()
    for moved in (euclidean, positive):
        assert torch.equal(moved(value, torch.zeros_like(value)), value)


def test_no_step_makes_a_positive_number_negative():
    value = torch.tensor([[1e-3, 4.0]]).double()
    assert (positive(value, torch.full_like(value, -50.0)) > 0).all()


def test_retract_leaves_variables_without_a_step_as_they_are():
    problem = Problem({"a": Variable(1, euclidean), "b": Variable(1, euclidean)}, {})
    values = {"a": torch.ones(2, 1), "b": torch.ones(3, 1)}
    moved = retract(problem, values, {"b": torch.full((3, 1), 2.0)})
    assert moved["a"] is values["a"]
    assert torch.equal(moved["b"], torch.full((3, 1), 3.0))


def test_a_diagonal_jacobian_is_zero_beside_its_diagonal():
    entries = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    whole = SparseJacobian.diagonal(entries).dense()
    assert torch.equal(whole, torch.diag_embed(entries.mT).permute(1, 2, 0))


def test_a_sparse_jacobian_has_its_entries_from_the_first_column_on():
    row = torch.tensor([[1.0], [2.0]])
    whole = SparseJacobian(4, ((2, row), (0, row[:1]))).dense()
    assert whole[..., 0].tolist() == [[0.0, 0.0, 1.0, 2.0], [1.0, 0.0, 0.0, 0.0]]


def test_rows_belong_to_the_problem_of_the_block_in_their_first_slot():
    group = torch.tensor([0, 0, 1])
    variables = {"x": Variable(1, euclidean, group), "y": Variable(1, euclidean)}
    term = CostTerm(lambda x: x, (("x", torch.tensor([2, 0])),))
    alone = CostTerm(lambda y: y, (("y", torch.tensor([0])),))
    problem = Problem(variables, {"of_x": term, "of_y": alone}, group_count=2)
    of_rows = problem.group_of_rows(term)
    assert of_rows is not None
    assert of_rows.tolist() == [1, 0]
    assert problem.group_of_rows(alone) is None
    assert len(term) == 2
