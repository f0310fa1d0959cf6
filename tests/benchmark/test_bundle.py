"""The race of bundle adjustments: its problem, its judge, and ours on it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from crowdmap_torch.benchmark import free_corners
from crowdmap_torch.benchmark.bundle import growth, solve
from crowdmap_torch.cli import main
from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.robust import Tukey
from crowdmap_torch.optim.solvers.dense import DenseBackend

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def problem() -> free_corners.FreeCorners:
    return free_corners.simulate(3, 30, 4, seed=1)


def test_ours_reaches_the_minimum_of_the_dense_solver(problem):
    figures, q, p, X = solve(problem, CPU)
    # The dense solver from there, without factors kept or steps stretched, finds next to nothing to gain.
    built, values = free_corners.bundle(problem, Tukey(problem.tukey_c), CPU)
    poses, _ = free_corners.bundle(replace(problem, prior_q=q, prior_p=p, pt_init=X), Tukey(), CPU)
    start = {**values, "pose": poses.terms["prior"].constants[0], "point": torch.as_tensor(X)}
    plain = lm.LmConfig(max_iterations=30, cost_tolerance=1e-9)
    dense = lm.solve(built, start, plain, backend=DenseBackend())
    assert dense.done
    # Both stop by a relative tolerance of a millionth.
    assert figures["cost"] <= float(dense.cost) * (1 + 1e-5)


def test_a_problem_file_is_solved_and_written(problem, tmp_path: Path, capsys):
    problem.save(tmp_path / "problem.npz")
    out = tmp_path / "result.npz"
    threads = str(torch.get_num_threads())
    arguments = ["bundle", "--problem", str(tmp_path / "problem.npz"), "--out", str(out)]
    assert main(["benchmark", *arguments, "--threads", threads]) == 0
    said = json.loads(capsys.readouterr().out)
    assert {"setup_s", "solve_s", "iterations", "peak_gb"} <= said.keys()
    with np.load(out) as result:
        judged = free_corners.cost(problem, result["q"], result["p"], result["X"])
    assert judged == pytest.approx(said["cost"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["problem.npz", "result.npz"]


@pytest.mark.parametrize("what", ["missing", "nonsense", "incomplete"])
def test_a_file_that_is_no_problem_is_one_line(problem, tmp_path: Path, capsys, what: str):
    path = tmp_path / "problem.npz"
    if what == "nonsense":
        path.write_bytes(b"nonsense")
    if what == "incomplete":
        np.savez(path, J=1)
    assert main(["benchmark", "bundle", "--problem", str(path)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "problem.npz" in said


def test_growth_is_the_slope_of_the_logarithms():
    def figures(journeys, power):
        return {"solve_s": 0.01 * journeys**power, "peak_gb": 0.2 * journeys**0.5}

    medians = {f"{j}x500x31": {"ours": figures(j, 1.25)} for j in (5, 25, 100)}
    medians["25x500x200"] = {"ours": figures(25, 3.0)}
    (line,) = growth(medians)
    assert "5 to 100 journeys" in line
    assert "power 1.25" in line
    assert "memory with 0.50" in line
