"""What rows have wrong together: whitening by the inverse root of their joint covariance."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from crowdmap_torch.optim.linearize import chunks, residuals, row_blocks, rows, term_costs
from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean
from crowdmap_torch.optim.robust import JointTukey, Loss, Quadratic
from crowdmap_torch.optim.shared_errors import SharedErrors

F64 = torch.float64


def drawn(counts: list[int], seed: int = 0) -> SharedErrors:
    """Runs of so many rows of two numbers, each with a shift and a second pattern at right angles to it."""
    g = torch.Generator().manual_seed(seed)
    run = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
    rank = torch.cat([torch.arange(count) for count in counts])
    pattern, keep = [], []
    for count in counts:
        first = torch.ones(count, 2, dtype=F64) / count**0.5
        second = torch.randn(count, 2, generator=g, dtype=F64)
        second = second - first * (first * second).sum(0)
        length = second.norm(dim=0)
        second = second / length if count > 1 else torch.zeros_like(second)
        pattern.append(torch.stack((first, second), dim=-1))
        share = 0.1 + 0.8 * torch.rand(2, 2, generator=g, dtype=F64)
        keep.append(share.expand(count, 2, 2))
    return SharedErrors(run, rank, max(counts), torch.cat(pattern), torch.cat(keep))


def covariance(shared: SharedErrors, rows: Tensor, number: int) -> Tensor:
    """Of one number of the rows of a run, in units of their white noise."""
    b = shared.pattern[rows, number]
    more = shared.keep[rows[0], number].pow(-2) - 1
    return torch.eye(len(rows), dtype=F64) + (b * more) @ b.mT


@pytest.mark.parametrize("counts", [[1], [4, 4, 4], [3, 8, 1, 4, 5]])
def test_whitened_rows_have_unit_covariance(counts: list[int]):
    shared = drawn(counts)
    whiten = shared.whiten(torch.eye(len(shared.run), dtype=F64).expand(2, -1, -1)).mT
    for run in range(len(counts)):
        own = torch.nonzero(shared.run == run)[:, 0]
        for number in range(2):
            W = whiten[number][own]
            assert W[:, shared.run != run].abs().max() == 0 if len(counts) > 1 else True
            W = W[:, own]
            expected = torch.linalg.inv(covariance(shared, own, number))
            torch.testing.assert_close(W.mT @ W, expected, rtol=1e-12, atol=1e-12)


def linear_term(
    shared: SharedErrors, loss: Loss | None = None
) -> tuple[CostTerm, dict[str, Variable], dict[str, Tensor]]:
    """Rows that are linear in one block of three numbers."""
    g = torch.Generator().manual_seed(1)
    m = len(shared.run)
    J, target = (torch.randn(m, *size, generator=g, dtype=F64) for size in ((2, 3), (2,)))
    block = torch.zeros(m, dtype=torch.long)

    def residual(x: Tensor, J: Tensor, target: Tensor) -> Tensor:
        return (J * x).sum(1) - target

    sigma = torch.full((m,), 0.5, dtype=F64)
    joint = JointTukey.by_efficiency(shared.run, torch.tensor(50.0, dtype=F64), row_dim=2)
    term = CostTerm(
        residual,
        (("x", block),),
        (J, target),
        1 / sigma,
        loss or joint,
        takes_rows=True,
        shared=shared,
    )
    return term, {"x": Variable(3, euclidean)}, {"x": torch.randn(1, 3, generator=g, dtype=F64)}


def test_costs_and_normal_equations_are_those_of_the_joint_covariance():
    shared = drawn([3, 8, 1, 4, 5])
    term, variables, values = linear_term(shared, Quadratic())
    blocks = row_blocks(term, variables, values)
    J, target = term.constants
    error = (J * values["x"][0]).sum(-1) - target
    H, g, cost = (torch.zeros(size, dtype=F64) for size in ((3, 3), (3,), ()))
    for run in range(5):
        own = torch.nonzero(shared.run == run)[:, 0]
        for number in range(2):
            information = torch.linalg.inv(covariance(shared, own, number) * 0.25)
            H += J[own, number].mT @ information @ J[own, number]
            g += J[own, number].mT @ information @ error[own, number]
            cost += error[own, number] @ information @ error[own, number] / 2
    torch.testing.assert_close(blocks.hessian[0, 0].sum(-1), H, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(blocks.gradient[0].sum(-1), g, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(blocks.rho.sum() / 2, cost, rtol=1e-8, atol=0)
    # What steps are judged by is the same.
    tried = term_costs(Problem(variables, {"all": term}), values)["all"][0]
    torch.testing.assert_close(tried, cost, rtol=1e-8, atol=0)


def test_runs_are_not_parted_by_chunks_nor_mixed_up_by_an_order():
    shared = drawn([4] * 30 + [8] * 10)
    term, variables, values = linear_term(shared)
    problem = Problem(variables, {"all": term})
    whole = term_costs(problem, values)["all"]
    torch.testing.assert_close(term_costs(problem, values, chunk_rows=7)["all"], whole)
    assert sum(len(piece) for _, piece in chunks(term, 7)) == len(term)
    turned = torch.argsort(-shared.run, stable=True)
    by_row = residuals(term, values)
    again = residuals(rows(term, turned), values)
    torch.testing.assert_close(again, by_row[turned], rtol=1e-12, atol=1e-12)
