"""Ladybug 49 of Bundle Adjustment in the Large: real cameras and points, the points eliminated, Ceres' cost reached."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from crowdmap_torch.benchmark import ladybug
from crowdmap_torch.benchmark.ladybug import Bal
from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.linearize import linearize, rows

START_COST = 850912.46
"""As the literature has it."""
CERES_COST = 13344.3183
"""Of `crowdmap benchmark ladybug FILE --solvers ceres` (Ceres of pyceres 2.6, same start and tolerance)."""


@pytest.fixture(scope="module")
def problem(real_data) -> Bal:
    """The whole problem."""
    return ladybug.load(real_data("bal/problem-49-7776-pre.txt"))


def some_points(problem: Bal, count: int) -> Bal:
    """The same cameras with `count` of the points, spread over the drive."""
    points = np.linspace(0, len(problem.point) - 1, count).astype(np.int64)
    new = np.full(len(problem.point), -1)
    new[points] = np.arange(count)
    keeps = new[problem.point_of] >= 0
    return Bal(
        problem.camera,
        problem.point[points],
        problem.px[keeps],
        problem.camera_of[keeps],
        new[problem.point_of[keeps]],
    )


def test_the_cost_at_the_start_is_the_published_one(problem):
    built, values, _ = ladybug.bundle(problem)
    start = lm.init(built, values, ladybug.LM).cost.item()
    assert ladybug.cost(problem, problem.camera, problem.point) == pytest.approx(start, rel=1e-12)
    assert start == pytest.approx(START_COST, abs=0.01)


def test_jacobians_agree_with_autograd(problem):
    built, values, _ = ladybug.bundle(problem)
    # A camera that is not turned at all is where closed forms fail.
    values["camera"][0, :3] = 0
    values["camera"][1, :3] *= 1e-3
    term = rows(built.terms["reprojection"], slice(0, len(problem.px), 16))
    kinds = dict(built.variables)
    closed, auto = (linearize(t, kinds, values) for t in (term, replace(term, jacobian=None)))
    torch.testing.assert_close(closed.residual, auto.residual)
    for ours, reference in zip(closed.jacobians, auto.jacobians, strict=True):
        # Columns of pixels per radian and per unit of distortion: relative to the largest of each.
        scale = reference.abs().amax((0, 2), keepdim=True)[0]
        torch.testing.assert_close(ours / scale, reference / scale, rtol=0, atol=1e-9)


def test_the_step_is_that_of_the_dense_schur_complement(problem):
    few = some_points(problem, 150)
    built, values, backend = ladybug.bundle(few)
    damping = torch.tensor([1e-3], dtype=torch.float64)
    step = backend.assemble(built, values).solve(damping)
    assert bool(step.solved)

    linear = linearize(built.terms["reprojection"], dict(built.variables), values)
    m, n, k = len(few.px), 9 * len(few.camera), 3 * len(few.point)
    J = torch.zeros(m, 2, n + k, dtype=torch.float64)
    row = torch.arange(m)[:, None]
    camera, point = (torch.from_numpy(index)[:, None] for index in (few.camera_of, few.point_of))
    J[row, :, 9 * camera + torch.arange(9)] = linear.jacobians[0].permute(2, 1, 0)
    J[row, :, n + 3 * point + torch.arange(3)] = linear.jacobians[1].permute(2, 1, 0)
    J = J.flatten(0, 1)
    H, g = J.mT @ J, J.mT @ linear.residual.mT.flatten()
    H.diagonal().mul_(1 + damping)
    back = torch.linalg.solve(H[n:, n:], torch.cat((H[n:, :n], g[n:, None]), dim=1))
    reduced = H[:n, :n] - H[:n, n:] @ back[:, :n]
    by_camera = -torch.linalg.solve(reduced, g[:n] - H[:n, n:] @ back[:, n])
    by_point = -back[:, n] - back[:, :n] @ by_camera
    for name, dense in (("camera", by_camera), ("point", by_point)):
        ours = step.delta[name].flatten()
        # In units of each entry's own curvature: focal lengths and distortions differ by ten orders.
        unit = H.diagonal()[:n].sqrt() if name == "camera" else H.diagonal()[n:].sqrt()
        error = ((ours - dense) * unit).norm() / (dense * unit).norm()
        assert error < 1e-8, name


def test_the_cost_that_ceres_reaches_is_reached(problem):
    built, values, backend = ladybug.bundle(problem)
    state = lm.init(built, values, ladybug.LM)
    costs = [state.cost.item()]
    while not state.done and state.iterations < ladybug.LM.max_iterations:
        state = lm.step(built, state, ladybug.LM, backend=backend)
        costs.append(state.cost.item())
    assert state.reason.item() == lm.CONVERGED_COST
    assert all(after <= before for before, after in pairwise(costs))
    cameras, points = (state.values[name].numpy() for name in ("camera", "point"))
    assert ladybug.cost(problem, cameras, points) == pytest.approx(costs[-1], rel=1e-9)
    assert costs[-1] <= 1.001 * CERES_COST

    def scaled_gradient(at) -> float:
        """Length of the gradient where the Hessian's diagonal is one: what is left of a pixel, by parameter."""
        term = built.terms["reprojection"]
        linear = linearize(term, dict(built.variables), at)
        total = 0.0
        for (name, index), J in zip(term.slots, linear.jacobians, strict=True):
            like = torch.zeros_like(at[name])
            gradient = like.index_add(0, index, (J * linear.residual[:, None]).sum(0).mT)
            curvature = like.index_add(0, index, J.square().sum(0).mT)
            total += (gradient.square() / curvature.clamp_min(1e-12)).sum().item()
        return total**0.5

    assert scaled_gradient(state.values) < 1e-3 * scaled_gradient(values)


def test_a_file_cut_short_is_refused(tmp_path):
    path = tmp_path / "problem.txt"
    path.write_text("1 1 1\n0 0 -1.0 2.0\n" + "0.5\n" * 11)
    with pytest.raises(ValueError, match="make 19 numbers, found 18"):
        ladybug.load(path)
    path.write_text("1 1 1\n0 1 -1.0 2.0\n" + "0.5\n" * 12)
    with pytest.raises(ValueError, match="point"):
        ladybug.load(path)
