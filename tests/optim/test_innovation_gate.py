"""Innovations against leaving detections out one by one, on a linear problem small enough for that."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from crowdmap_torch.optim import innovation_gate
from crowdmap_torch.optim.innovation_gate import Innovations, innovations
from crowdmap_torch.optim.linearize import linearize, residuals
from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean
from crowdmap_torch.optim.robust import JointTukey
from crowdmap_torch.optim.solvers.dense import DenseBackend

POSES, ROW_DIM, K = 12, 2, 3
CORNERS = 4
BOUND = torch.tensor(4.685, dtype=torch.float64)
"""What keeps detections in, in standard deviations of one number."""


def seen(pose: Tensor, J: Tensor, measured: Tensor) -> Tensor:
    return J @ pose - measured


def step(before: Tensor, after: Tensor) -> Tensor:
    return after - before


def drive(outlier: float = 0.0, *, seed: int = 0) -> tuple[Problem, dict[str, Tensor]]:
    """A random walk of poses, each with one detection of four corners that holds it; the last pose is drawn to `outlier`."""
    generator = torch.Generator().manual_seed(seed)

    def noise(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    every = torch.arange(POSES)
    of_row = every.repeat_interleave(CORNERS)
    J, measured = 10 * noise(len(of_row), ROW_DIM, K), noise(len(of_row), ROW_DIM)
    measured[-CORNERS:] += outlier * J[-CORNERS:, :, 0]
    loss = JointTukey.by_efficiency(of_row, BOUND, row_dim=ROW_DIM)
    terms = {
        "seen": CostTerm(seen, (("pose", of_row),), (J, measured), loss=loss),
        "start": CostTerm(lambda x: x, (("pose", every[:1]),)),
        "step": CostTerm(
            step,
            (("pose", every[:-1]), ("pose", every[1:])),
            weight=torch.full((POSES - 1,), 2.0, dtype=torch.float64),
        ),
    }
    problem = Problem({"pose": Variable(K, euclidean)}, terms)
    start = torch.zeros(POSES, K, dtype=torch.float64)
    start[-1, 0] = outlier
    return problem, minimum(problem, {"pose": start})


def minimum(problem: Problem, values: dict[str, Tensor], steps: int = 60) -> dict[str, Tensor]:
    """Where reweighted least squares lead."""
    for _ in range(steps):
        normal = DenseBackend().assemble(problem, values)
        delta = normal.solve(torch.zeros(1).double()).delta["pose"]
        values = {"pose": values["pose"] + delta}
    return values


def covariance(problem: Problem, values: dict[str, Tensor]) -> Tensor:
    every = torch.arange(POSES)
    hessian = DenseBackend().assemble(problem, values).hessian[0]
    return torch.linalg.inv(hessian).view(POSES, K, POSES, K)[every, :, every]


def judged(problem: Problem, values: dict[str, Tensor]) -> Innovations:
    term = problem.terms["seen"]
    P = covariance(problem, values)
    return innovations(term, dict(problem.variables), values, P)


def by_leaving_out(problem: Problem, values: dict[str, Tensor], pose: int) -> Tensor:
    """Residual of one pose's detection where the others alone put it, by its covariance there."""
    term, kinds = problem.terms["seen"], dict(problem.variables)
    linear = linearize(term, kinds, values)
    # The others' weights stay.
    counted = (linear.robust_weight * (term.slots[0][1] != pose)).sqrt()
    held = replace(term, loss=CostTerm(seen, term.slots).loss, weight=counted)
    others = Problem(problem.variables, {**problem.terms, "seen": held})
    # With them the problem is linear: one step leads there, and another takes off what is rounded.
    there = minimum(others, values, steps=2)
    P = covariance(others, there)[pose]
    rows = term.slots[0][1] == pose
    J = linear.jacobians[0][..., rows].permute(2, 0, 1).flatten(0, 1)
    r = residuals(term, there)[rows].flatten()
    S = torch.eye(len(r)).double() + J @ P @ J.T
    return r @ torch.linalg.solve(S, r)


@pytest.mark.parametrize("outlier", [0.0, 1.0, 5.0])
def test_an_innovation_is_what_leaving_the_detection_out_shows(outlier: float):
    problem, values = drive(outlier)
    found = judged(problem, values)
    expected = torch.stack([by_leaving_out(problem, values, pose) for pose in range(POSES)])
    torch.testing.assert_close(found.squared, expected, rtol=1e-6, atol=1e-8)
    assert found.freedom.tolist() == [CORNERS * ROW_DIM] * POSES


def test_innovations_are_found_in_lots_to_the_same_bits(monkeypatch: pytest.MonkeyPatch):
    problem, values = drive(3.0)
    whole = judged(problem, values)
    monkeypatch.setattr(innovation_gate, "CHUNK_ROWS", 2)
    assert torch.equal(judged(problem, values).squared, whole.squared)


def test_an_outlier_that_bends_its_pose_shows_in_the_innovation_alone():
    problem, values = drive(4.0)
    s = residuals(problem.terms["seen"], values).square().sum(-1).view(POSES, -1).sum(1)
    found = judged(problem, values)
    # Its residual is that of any other, and so it has its say.
    assert s[-1] < 2 * s[:-1].max() and found.weight[-1] > 0.2
    # The pose before it is bent too, so that the view from there is not foreseen either, but better.
    assert found.are_too_large(1e-9)[-1] and found.squared[-1] > 1.5 * found.squared[:-1].max()


def of_noise(sigma: float, *, outliers: int = 0) -> Innovations:
    generator = torch.Generator().manual_seed(3)
    n, freedom = 20_000, 8
    z = sigma * torch.randn(n, freedom, dtype=torch.float64, generator=generator)
    squared = z.square().sum(-1)
    squared[:outliers] *= 30
    weight = torch.ones(n, dtype=torch.float64)
    weight[:outliers] = 0
    return Innovations(squared, torch.full((n,), freedom), weight)


@pytest.mark.parametrize("sigma", [1.0, 2.0])
def test_of_normal_noise_the_asked_share_is_too_large_whatever_its_sigma(sigma: float):
    share = of_noise(sigma).are_too_large(0.01).double().mean()
    # Of 20000 the share's own error is 7 % of it; the median's adds as much.
    assert float(share) == pytest.approx(0.01, rel=0.3)


def test_noise_smaller_than_stated_is_not_held_against_detections():
    assert of_noise(0.5).are_too_large(1e-3).sum() == 0


def test_outliers_that_have_no_say_do_not_excuse_others():
    found = of_noise(1.0, outliers=6000)
    assert found.are_too_large(1e-6)[:6000].double().mean() > 0.99
    assert found.are_too_large(1e-6)[6000:].sum() == 0


def test_no_detections_are_no_trouble():
    nothing = torch.zeros(0, dtype=torch.float64)
    assert len(Innovations(nothing, torch.zeros(0).long(), nothing).are_too_large(1e-3)) == 0
