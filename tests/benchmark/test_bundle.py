"""The race of bundle adjustments: its problem, its judge, and ours on it."""

from __future__ import annotations

import json
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from crowdmap_torch.benchmark import free_corners
from crowdmap_torch.benchmark.bundle import LM, growth, solve
from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.chain import ChainBackend
from crowdmap_torch.optim.linear import DenseBackend
from crowdmap_torch.optim.linearize import term_costs
from crowdmap_torch.optim.robust import Tukey

CPU = torch.device("cpu")
SCRIPT = Path(__file__).parents[2] / "scripts" / "benchmark.py"


@pytest.fixture(scope="module")
def problem() -> free_corners.FreeCorners:
    return free_corners.simulate(3, 30, 4, seed=1)


def test_the_judge_and_the_solver_have_one_objective(problem):
    built, values = free_corners.bundle(problem, Tukey(problem.tukey_c), CPU)
    ours = float(torch.stack(list(term_costs(built, values).values())).sum())
    judged = free_corners.cost(problem, problem.prior_q, problem.prior_p, problem.pt_init)
    assert ours == pytest.approx(judged, rel=1e-10)


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


def test_kept_factors_and_fresh_ones_reach_one_cost(problem):
    built, values = free_corners.bundle(problem, Tukey(50.0), CPU)
    chain = torch.arange(problem.J).repeat_interleave(problem.F)
    states = [
        lm.solve(
            built,
            values,
            replace(LM, cost_tolerance=1e-9, reuse_below=below),
            backend=ChainBackend("pose", chain),
        )
        for below in (0.0, 1e-2)
    ]
    assert all(state.done for state in states)
    assert states[1].linearizations < states[0].linearizations
    torch.testing.assert_close(states[1].cost, states[0].cost, rtol=1e-7, atol=0)


def test_a_problem_file_is_solved_and_written(problem, tmp_path: Path, capsys):
    problem.save(tmp_path / "problem.npz")
    main = runpy.run_path(str(SCRIPT))["main"]
    out = tmp_path / "result.npz"
    threads = str(torch.get_num_threads())
    arguments = ["bundle", "--problem", str(tmp_path / "problem.npz"), "--out", str(out)]
    assert main([*arguments, "--threads", threads]) == 0
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
    main = runpy.run_path(str(SCRIPT))["main"]
    assert main(["bundle", "--problem", str(path)]) == 2
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
