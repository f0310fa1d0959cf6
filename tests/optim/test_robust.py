"""Losses of whole detections: rows that stand or fall together."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from crowdmap_torch.optim.linearize import chunks, term_costs
from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean
from crowdmap_torch.optim.robust import JointTukey, Tukey, median_along, usual
from crowdmap_torch.optim.solvers.dense import DenseBackend

ROW_DIM = 2
C = 4.685
BOUND = torch.tensor(C, dtype=torch.float64)
LABEL = torch.tensor([4, 4, 4, 9, 9, 9, 9, 2, 0, 0, 0, 0, 0, 0, 0, 0, 7, 7, 7])
"""Detections of a triangle, a rectangle, a box's centre, an octagon, a triangle."""


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def whole(label: Tensor) -> JointTukey:
    return JointTukey.by_efficiency(label, BOUND, row_dim=ROW_DIM)


@pytest.mark.parametrize("rows", [1, 3, 4, 8])
def test_the_bound_keeps_the_efficiency_of_one_number(rows: int):
    count = 200_000
    label = torch.arange(count).repeat_interleave(rows)
    loss = whole(label)
    s = normal(count * rows, ROW_DIM).square().sum(-1)
    total = s.view(count, rows).sum(1)
    weight = loss.weight(s)[::rows]
    # Of a location's M-estimate: the mean slope squared over the mean square of its influence.
    inside = (1 - total / loss.c[::rows].square()).clamp_min(0)
    dim = rows * ROW_DIM
    slope = (weight - 4 * total / loss.c[::rows].square() * inside / dim).mean()
    efficiency = slope.square() / (weight.square() * total / dim).mean()
    # The sample's own error is a third of a percent.
    assert efficiency == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize("rows", [1, 4, 8])
def test_informative_weights_are_in_the_mean_what_is_kept(rows: int):
    count = 200_000
    loss = whole(torch.arange(count).repeat_interleave(rows)).informative()
    s = normal(count * rows, ROW_DIM, seed=1).square().sum(-1)
    assert float(loss.weight(s).mean()) == pytest.approx(0.95, abs=0.01)


def test_one_number_alone_has_the_plain_loss():
    s = torch.linspace(0, 30, 50, dtype=torch.float64)
    loss = JointTukey.by_efficiency(torch.arange(50), BOUND, row_dim=1)
    torch.testing.assert_close(loss.rho(s), Tukey(C).rho(s))
    torch.testing.assert_close(loss.weight(s), Tukey(C).weight(s))


def test_weights_are_the_derivative_of_the_loss():
    for loss in (whole(LABEL), whole(LABEL).informative()):
        s = (8 * normal(len(LABEL), seed=2).square()).requires_grad_()
        (slope,) = torch.autograd.grad(loss.rho(s).sum(), s)
        torch.testing.assert_close(loss.weight(s), slope)


def test_a_detection_is_given_up_as_a_whole_and_others_are_not():
    s = torch.ones(len(LABEL), dtype=torch.float64)
    at = LABEL == 9
    # Each corner 4 sigma off: one by one they would keep their say.
    s[at] = 16.0
    weight = whole(LABEL).weight(s)
    assert (weight[at] == 0).all() and (Tukey(C).weight(s[at]) > 0).all()
    assert (weight[~at] > 0.5).all()


def test_a_detection_costs_less_to_give_up_than_its_corners_one_by_one():
    far = torch.full((len(LABEL),), 1e6, dtype=torch.float64)
    joint, alone = whole(LABEL).rho(far), Tukey(C).rho(far)
    several = LABEL != 2
    assert (joint[several] < 0.8 * alone[several]).all()


def residual(x: Tensor, y: Tensor, measured: Tensor) -> Tensor:
    return torch.stack((x.square().sum() - measured[0], (x * y).sum() - measured[1]))


@pytest.fixture
def problem() -> tuple[Problem, dict[str, Tensor]]:
    x, y = normal(5, 2, seed=3), normal(4, 2, seed=4)
    run = torch.unique_consecutive(LABEL, return_inverse=True)[1]
    term = CostTerm(
        residual,
        (("x", run % 5), ("y", run % 4)),
        (3 * normal(len(LABEL), 2, seed=5),),
        loss=whole(LABEL),
    )
    variables = {"x": Variable(2, euclidean), "y": Variable(2, euclidean)}
    return Problem(variables, {"seen": term}), {"x": x, "y": y}


@pytest.mark.parametrize("size", [1, 2, 4, 5, 9, 100])
def test_chunks_part_no_detection_and_change_nothing(problem, size: int):
    problem, values = problem
    term = problem.terms["seen"]
    pieces = [piece for piece, _ in chunks(term, size)]
    assert [piece.start for piece in pieces[1:]] == [piece.stop for piece in pieces[:-1]]
    assert (pieces[0].start, pieces[-1].stop) == (0, len(LABEL))
    for piece in pieces[1:]:
        assert LABEL[piece.start] != LABEL[piece.start - 1]
    assert all(p.stop - p.start <= max(size, 8) for p in pieces)
    cut, at_once = (DenseBackend(chunk_rows=n).assemble(problem, values) for n in (size, 1000))
    torch.testing.assert_close(cut.hessian, at_once.hessian)
    torch.testing.assert_close(cut.gradient, at_once.gradient)
    torch.testing.assert_close(cut.cost, at_once.cost)
    torch.testing.assert_close(
        term_costs(problem, values, chunk_rows=size)["seen"], at_once.term_cost["seen"]
    )


def test_detections_in_another_order_have_the_same_weights():
    loss, s = whole(LABEL), 5 * normal(len(LABEL), seed=6).square()
    order = torch.cat([torch.nonzero(LABEL == label)[:, 0] for label in (0, 7, 9, 2, 4)])
    torch.testing.assert_close(loss.of_rows(order).weight(s[order]), loss.weight(s)[order])
    torch.testing.assert_close(loss.of_rows(order).rho(s[order]), loss.rho(s)[order])


def test_no_rows_are_no_trouble():
    loss = whole(LABEL[:0])
    nothing = torch.zeros(0, dtype=torch.float64)
    assert len(loss.rho(nothing)) == len(loss.weight(nothing)) == 0


def test_what_is_usual_is_what_half_of_the_weight_says_or_what_is_assumed():
    value = torch.tensor([5.0, 3.0, 4.0], dtype=torch.float64)
    weight = torch.tensor([10.0, 10.0, 30.0], dtype=torch.float64)
    assert usual(value, weight, assumed=1.0, beside=20.0) == 4.0
    assert usual(value, weight, assumed=1.0, beside=60.0) == 1.0
    assert usual(value[:0], weight[:0], assumed=1.0, beside=20.0) == 1.0


@pytest.mark.parametrize("count", [1, 2, 7, 8])
@pytest.mark.parametrize("dim", [0, 1, -1])
def test_a_median_along_an_axis_is_torchs(count: int, dim: int):
    value = normal(count, count, seed=count)
    assert torch.equal(median_along(value, dim), value.median(dim).values)
    value[0, 0] = torch.nan
    assert torch.equal(median_along(value, dim).isnan(), value.median(dim).values.isnan())


def test_bounds_that_are_wider_let_a_detection_err_so_much_more():
    label = torch.tensor([0, 0, 1, 1])
    loss = JointTukey.by_efficiency(label, BOUND, row_dim=ROW_DIM)
    wider = loss.wider(torch.tensor([3.0, 3.0, 1.0, 1.0], dtype=torch.float64))
    s = torch.tensor([1.0, 2.0, 1.0, 2.0], dtype=torch.float64)
    assert torch.equal(wider.weight(9 * s)[:2], loss.weight(s)[:2])
    assert torch.equal(wider.weight(s)[2:], loss.weight(s)[2:])
    # Beside whole others it is the same of a detection's own rows.
    assert torch.equal(wider.of_rows(slice(0, 2)).weight(9 * s[:2]), loss.weight(s)[:2])
