"""The problem of the race: what it holds, and that it is the same for whoever asks twice."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from crowdmap_torch.benchmark import free_corners
from crowdmap_torch.optim.linearize import term_costs
from crowdmap_torch.optim.robust import Tukey


@pytest.fixture(scope="module")
def problem() -> free_corners.FreeCorners:
    return free_corners.simulate(3, 30, 4, seed=1)


def same(one: free_corners.FreeCorners, other: free_corners.FreeCorners) -> bool:
    names = (f.name for f in fields(free_corners.FreeCorners))
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


def test_a_seed_is_one_problem(problem):
    assert same(problem, free_corners.simulate(3, 30, 4, seed=1))
    assert not same(problem, free_corners.simulate(3, 30, 4, seed=2))


def test_a_problem_comes_back_from_its_file(problem, tmp_path: Path):
    problem.save(tmp_path / "problem.npz")
    assert same(free_corners.load(tmp_path / "problem.npz"), problem)


def test_corners_are_seen_in_the_image_up_to_noise_and_outliers(problem):
    low, high = np.quantile(problem.obs_uv, [0.02, 0.98], axis=0)
    assert (low > -10).all() and (high < 2 * problem.K[2:] + 10).all()
    assert len(problem.obs_pt) % 4 == 0
    assert problem.obs_pose.max() < problem.J * problem.F and problem.obs_pt.max() < 4 * problem.S
    # Frames look ahead: four corners of a sign come together.
    assert (problem.obs_pose.reshape(-1, 4) == problem.obs_pose[::4, None]).all()


def test_odometry_is_two_metres_ahead_and_nearly_straight(problem):
    step = np.linalg.norm(problem.odo_p, axis=1)
    assert step == pytest.approx(2.0, abs=0.2)
    assert Rotation.from_quat(problem.odo_q).magnitude().max() < 0.1
    assert len(problem.odo_i) == problem.J * (problem.F - 1)


def test_the_judge_and_the_solver_have_one_objective(problem):
    built, values = free_corners.bundle(problem, Tukey(problem.tukey_c), torch.device("cpu"))
    ours = float(torch.stack(list(term_costs(built, values).values())).sum())
    judged = free_corners.cost(problem, problem.prior_q, problem.prior_p, problem.pt_init)
    assert ours == pytest.approx(judged, rel=1e-10)
