"""Bundle adjustment against Ceres and GTSAM on one objective: `crowdmap benchmark bundle`.

Every solver runs in a process of its own, in turns; the cost at its result is computed by one neutral function.
`--problem FILE.npz --out OUT.npz` solves one problem with ours and prints one JSON line.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from crowdmap_torch.adjustment.config import AdjustConfig
from crowdmap_torch.benchmark import free_corners
from crowdmap_torch.benchmark.devices import finish
from crowdmap_torch.benchmark.free_corners import FreeCorners
from crowdmap_torch.geometry import se3
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.problem import Problem, Values
from crowdmap_torch.optim.robust import Huber, Tukey
from crowdmap_torch.optim.solvers.chain_schur import ChainBackend
from crowdmap_torch.optim.solvers.plan import EliminationPlan
from crowdmap_torch.processes.memory import keep_in_one_place
from crowdmap_torch.processes.threads import one_core_each, repeatable
from crowdmap_torch.ranges import Rounds, Workers, argument

MINIMISATION = replace(
    AdjustConfig().lm, max_iterations=100, cost_tolerance=1e-6, move_tolerance=0.0
)
"""The mapper's own, but that both stages stop when a step lowers the cost by less than a millionth, as the peers do."""
PEERS = {"ceres": "peers/ceres.py", "gtsam": "peers/gtsam.py"}
SERIES = ((5, 100, 10), (5, 500, 31), (25, 500, 31), (100, 500, 31), (400, 500, 31), (25, 500, 200))
"""Journeys, frames of each and signs of the problems of the table."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `crowdmap benchmark bundle`."""
    parser.add_argument("--problem", type=Path, help="solve this problem alone, with ours")
    parser.add_argument("--out", type=Path, help="npz file of its result: q, p, X")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=argument(Workers), default=2)
    parser.add_argument(
        "--repeats", type=argument(Rounds), default=3, help="runs of each; the median counts"
    )
    parser.add_argument(
        "--sizes",
        nargs="+",
        metavar="JxFxS",
        default=["x".join(map(str, size)) for size in SERIES],
        help="journeys x frames x signs",
    )
    parser.add_argument("--solvers", nargs="+", default=["ours", *PEERS], choices=["ours", *PEERS])


def run(options: argparse.Namespace) -> None:
    """Solves one problem, or prints the table of all solvers on all sizes."""
    torch.set_num_threads(options.threads)
    if options.problem is not None:
        figures = solve_file(options.problem, options.out, torch.device(options.device))
        print(json.dumps(figures))
        return
    print(f"{'size':>14} {'corners':>9} {'solver':>7} {'setup':>8} {'solve':>8} {'steps':>6} "
          f"{'memory':>8} {'cost':>16}")  # fmt: skip
    medians = {size: _race(size, options) for size in options.sizes}
    for line in growth(medians):
        print(line)


def solve_file(problem: Path, out: Path | None, device: torch.device) -> dict[str, Any]:
    """Solves a problem file; writes q, p and X, and gives times, steps and memory."""
    given = free_corners.load(problem)
    if out is not None and not out.parent.is_dir():
        raise InputError(f"{out}: the folder {out.parent} does not exist")
    figures, q, p, X = solve(given, device)
    if out is not None:
        beside = out.with_name(f".{out.name}.tmp.npz")
        np.savez(beside, q=q, p=p, X=X)
        os.replace(beside, out)
    return figures


@one_core_each()
def solve(
    problem: FreeCorners, device: torch.device
) -> tuple[dict[str, Any], np.ndarray, np.ndarray, np.ndarray]:
    """Huber's stage, then Tukey's from its result; poses eliminated along their chains."""
    # As the mapper does.
    keep_in_one_place()
    repeatable(device)
    start = time.perf_counter()
    # What a process loads at its first operations (threads, kernels) is set-up.
    tiny = free_corners.simulate(3, 12, 2)
    _minimise(tiny, *_prepared(tiny, device))
    prepared = _prepared(problem, device)
    finish(device)
    ready = time.perf_counter()
    first, last = _minimise(problem, *prepared)
    finish(device)
    done = time.perf_counter()
    q = se3.to_quaternion(last.values["pose"][:, :3, :3]).cpu().numpy()
    p, X = last.values["pose"][:, :3, 3].cpu().numpy(), last.values["point"].cpu().numpy()
    figures = {
        "setup_s": ready - start,
        "solve_s": done - ready,
        "iterations": first.iterations + last.iterations,
        "corrections": first.corrections + last.corrections,
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "cost": free_corners.cost(problem, q, p, X),
        "reason": last.reasons[0],
    }
    if device.type == "cuda":
        figures["peak_device_gb"] = torch.cuda.max_memory_allocated(device) / 2**30
    return figures, q, p, X


def _prepared(problem: FreeCorners, device: torch.device) -> tuple[Problem, Values, ChainBackend]:
    """The problem of the first stage, its start, and the back end with the structure worked out."""
    built, values = free_corners.bundle(problem, Huber(problem.huber_c), device)
    chain = torch.arange(problem.J, device=device).repeat_interleave(problem.F)
    backend = ChainBackend(EliminationPlan("pose", chain))
    backend.prepare(built, values)
    return built, values, backend


def _minimise(
    problem: FreeCorners, built: Problem, values: Values, backend: ChainBackend
) -> tuple[lm.LmState, lm.LmState]:
    """The states at the end of both stages."""
    first = lm.solve(built, values, MINIMISATION, backend=backend)
    corner = replace(built.terms["corner"], loss=Tukey(problem.tukey_c))
    built = replace(built, terms={**built.terms, "corner": corner})
    return first, lm.solve(built, first.values, MINIMISATION, backend=backend)


def growth(medians: Mapping[str, Mapping[str, Mapping[str, float]]]) -> Iterator[str]:
    """Exponents of time and memory in the number of journeys, for roads of which three sizes or more were solved.

    `medians` has by size and solver what `solve_file` gives. The exponents are slopes of straight lines through the
    logarithms.
    """
    runs: dict[tuple[str, tuple[int, ...]], list[tuple[int, Mapping[str, float]]]] = {}
    for size, by_solver in medians.items():
        journeys, *road = _parsed(size)
        for name, figures in by_solver.items():
            runs.setdefault((name, tuple(road)), []).append((journeys, figures))
    for (name, (frames, signs)), series in runs.items():
        counts = np.log([journeys for journeys, _ in series])
        if len(set(counts)) < 3:
            continue
        time_s, memory = (
            np.polyfit(counts, np.log([figures[key] for _, figures in series]), 1)[0]
            for key in ("solve_s", "peak_gb")
        )
        least, most = min(j for j, _ in series), max(j for j, _ in series)
        yield (
            f"{name}: {frames} frames x {signs} signs, {least} to {most} journeys: time grows "
            f"with the power {time_s:.2f} of their number, memory with {memory:.2f}"
        )


def _parsed(size: str) -> tuple[int, int, int]:
    try:
        journeys, frames, signs = (int(part) for part in size.split("x"))
    except ValueError:
        raise InputError(f"--sizes: expected JOURNEYSxFRAMESxSIGNS, found {size!r}") from None
    return journeys, frames, signs


def _race(size: str, options: argparse.Namespace) -> dict[str, dict[str, float]]:
    """All solvers on one size, in turns, each in a fresh process; the medians of each, printed as a line."""
    problem = free_corners.simulate(*_parsed(size))
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "problem.npz", Path(folder) / "result.npz"
        problem.save(path)
        runs: dict[str, list[dict[str, Any]]] = {name: [] for name in options.solvers}
        failed: dict[str, str] = {}
        for _ in range(options.repeats):
            for name in options.solvers:
                if name in failed:
                    continue
                try:
                    figures = _fresh(name, path, out, options)
                except _Failed as error:
                    failed[name] = str(error)
                    continue
                with np.load(out) as result:
                    figures["cost"] = free_corners.cost(
                        problem, result["q"], result["p"], result["X"]
                    )
                runs[name].append(figures)
    medians = {}
    for name, done in runs.items():
        head = f"{size:>14} {len(problem.obs_pt):>9} {name:>7}"
        if name in failed:
            print(f"{head} {failed[name]}")
            continue
        medians[name] = middle = {
            key: statistics.median(one.get(key, 0) for one in done)
            for key in ("setup_s", "solve_s", "iterations", "corrections", "peak_gb", "cost")
        }
        steps = f"{middle['iterations']:.0f}"
        if middle["corrections"]:
            steps += f"+{middle['corrections']:.0f}"
        print(
            f"{head} {middle['setup_s']:>6.2f} s {middle['solve_s']:>6.2f} s "
            f"{steps:>6} {middle['peak_gb']:>5.2f} GB {middle['cost']:>16.4f}",
            flush=True,
        )
    return medians


class _Failed(Exception):
    """A solver that gave no result, with what it said."""


def _fresh(name: str, problem: Path, out: Path, options: argparse.Namespace) -> dict[str, Any]:
    """The figures that a solver prints in a process of its own."""
    threads = str(options.threads)
    if name == "ours":
        command = [sys.executable, "-m", "crowdmap_torch", "benchmark", "bundle"]
        command += ["--problem", str(problem), "--out", str(out)]
        command += ["--threads", threads, "--device", options.device]
    else:
        command = [sys.executable, str(Path(__file__).parent / PEERS[name])]
        command += [str(problem), str(out), threads]
    limits = {"OMP_NUM_THREADS": threads, "MKL_NUM_THREADS": threads}
    done = subprocess.run(
        command, capture_output=True, text=True, env={**os.environ, **limits}, check=False
    )
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise _Failed(f"exit code {done.returncode}: {said}")
    return json.loads(done.stdout.strip().splitlines()[-1])
