"""Bundle adjustment in the large against Ceres, from one start: `crowdmap benchmark ladybug FILE`.

FILE is a problem of Agarwal et al., Bundle Adjustment in the Large (ECCV 2010), as published: nine parameters a camera
(rotation vector, translation, focal length, two of radial distortion), cameras that look along -z, half a sum of squares
without a robust loss. Here it is the cameras that stay: every point is a chain of its own and goes first. The cost at
each result is computed by one neutral function.
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
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.optim import levenberg_marquardt as lm
from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean
from crowdmap_torch.optim.solvers.chain_schur import ChainBackend
from crowdmap_torch.optim.solvers.plan import EliminationPlan
from crowdmap_torch.ranges import Rounds, Workers, argument
from crowdmap_torch.residuals.reprojection import components

LM = lm.LmConfig(max_iterations=100, cost_tolerance=1e-6, initial_damping=1e-4)
"""As Ceres begins and ends: its first radius is 1e4, and it stops when a step lowers the cost by less than a millionth."""
PEER = "peers/ceres_ladybug.py"

Array = NDArray[Any]


@dataclass(frozen=True)
class Bal:
    """The arrays of one problem, as they stand in its file."""

    camera: Array
    """Per camera: rotation vector, translation (camera from world), focal length [px], k1, k2."""
    point: Array
    px: Array
    """Observed points, about the image's centre, y upwards [px]."""
    camera_of: Array
    point_of: Array


def load(path: Path) -> Bal:
    """The problem of a file as Bundle Adjustment in the Large publishes them, unpacked."""
    try:
        numbers = np.array(path.read_text().split(), dtype=np.float64)
    except OSError as error:
        raise InputError(f"{path}: expected a BAL problem: {error}") from None
    except ValueError as error:
        raise InputError(f"{path}: expected numbers alone (is it unpacked?): {error}") from None
    if len(numbers) < 3:
        raise InputError(f"{path}: expected a BAL problem, found {len(numbers)} numbers")
    cameras, points, rows = (int(count) for count in numbers[:3])
    expected = 3 + 4 * rows + 9 * cameras + 3 * points
    if len(numbers) != expected:
        raise InputError(
            f"{path}: {cameras} cameras, {points} points and {rows} observations make "
            f"{expected} numbers, found {len(numbers)}"
        )
    seen, camera, point = np.split(numbers[3:], [4 * rows, 4 * rows + 9 * cameras])
    seen = seen.reshape(rows, 4)
    camera_of, point_of = seen[:, :2].astype(np.int64).T
    for name, index, count in (("camera", camera_of, cameras), ("point", point_of, points)):
        if rows and not 0 <= index.min() <= index.max() < count:
            raise InputError(f"{path}: expected a {name} below {count}, found {index.max()}")
    return Bal(
        camera.reshape(cameras, 9), point.reshape(points, 3), seen[:, 2:], camera_of, point_of
    )


def reprojection(
    camera: Float[Tensor, "9 *#rows"],
    point: Float[Tensor, "3 *#rows"],
    px: Float[Tensor, "2 *#rows"],
) -> Float[Tensor, "2 *#rows"]:
    """Pixel error of one point in one camera, as the benchmark defines it: a point behind the camera counts too."""
    R = se3.so3_exp(camera[:3].movedim(0, -1)).movedim((-2, -1), (1, 0))
    at = components(R, point) + camera[3:6]
    p = -at[:2] / at[2]
    r2 = p.square().sum(0)
    return camera[6] * (1 + r2 * (camera[7] + r2 * camera[8])) * p - px


def reprojection_jacobian(
    camera: Float[Tensor, "9 m"], point: Float[Tensor, "3 m"], px: Float[Tensor, "2 m"]
) -> tuple[Float[Tensor, "2 m"], tuple[Float[Tensor, "2 9 m"], Float[Tensor, "2 3 m"]]]:
    """`reprojection` of many rows, with its Jacobians in closed form: a seventh of the time of autograd."""
    w, (f, k1, k2) = camera[:3], camera[6:]
    R = se3.so3_exp(w.mT).permute(1, 2, 0)
    turned = components(R.transpose(0, 1), point)
    x, y, z = turned + camera[3:6]
    p = torch.stack((x, y)) / -z
    r2 = p.square().sum(0)
    scale = 1 + r2 * (k1 + r2 * k2)
    # By the point before the lens, [I p] / -z, then through the lens.
    by_p = p[:, None] * p * (2 * (k1 + 2 * r2 * k2))
    by_p[(0, 1), (0, 1)] += scale
    by_p = by_p * (f / -z)
    by_at = torch.cat((by_p, (by_p * p).sum(1, keepdim=True)), dim=1)
    # Rows times -skew(turned) J_l(w), the left Jacobian of the rotation vector.
    by_turn = torch.linalg.cross(turned.expand_as(by_at), by_at, dim=1)
    first, second = _left_jacobian(w)
    axis = w.expand_as(by_at)
    once = torch.linalg.cross(axis, by_turn, dim=1)
    by_w = by_turn - first * once + second * torch.linalg.cross(axis, once, dim=1)
    by_lens = torch.stack((scale * p, f * r2 * p, f * r2 * r2 * p), dim=1)
    by_point = torch.stack([components(R, row) for row in by_at])
    return f * scale * p - px, (torch.cat((by_w, by_at, by_lens), dim=1), by_point)


def _left_jacobian(w: Float[Tensor, "3 m"]) -> tuple[Float[Tensor, " m"], Float[Tensor, " m"]]:
    """The factors of skew(w) and of its square: (1 - cos t) / t^2 and (t - sin t) / t^3."""
    theta_sq = w.square().sum(0)
    # Below this the differences lose more than the series leave out.
    small = theta_sq < 1e-4
    theta = torch.where(small, torch.ones_like(theta_sq), theta_sq).sqrt()
    return (
        torch.where(small, 0.5 - theta_sq / 24, (1 - theta.cos()) / theta**2),
        torch.where(small, 1 / 6 - theta_sq / 120, (theta - theta.sin()) / theta**3),
    )


def bundle(problem: Bal) -> tuple[Problem, dict[str, Tensor], ChainBackend]:
    """The problem, the values to start from, and the back end that eliminates the points."""
    term = CostTerm(
        reprojection,
        (("camera", torch.tensor(problem.camera_of)), ("point", torch.tensor(problem.point_of))),
        (torch.tensor(problem.px),),
        jacobian=reprojection_jacobian,
    )
    variables = {"camera": Variable(9, euclidean), "point": Variable(3, euclidean)}
    values = {"camera": torch.tensor(problem.camera), "point": torch.tensor(problem.point)}
    # A point is seen by few cameras: windows that several points share would be mostly zeros.
    plan = EliminationPlan("point", torch.arange(len(problem.point)))
    backend = ChainBackend(plan, group_size=1)
    return Problem(variables, {"reprojection": term}), values, backend


def cost(problem: Bal, camera: Array, point: Array) -> float:
    """Half the sum of squares at these cameras and points: the one judge of all solvers."""
    of = camera[problem.camera_of]
    at = Rotation.from_rotvec(of[:, :3]).apply(point[problem.point_of]) + of[:, 3:6]
    p = -at[:, :2] / at[:, 2:]
    r2 = (p**2).sum(1)
    scale = of[:, 6] * (1 + r2 * (of[:, 7] + r2 * of[:, 8]))
    return float(((scale[:, None] * p - problem.px) ** 2).sum() / 2)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `crowdmap benchmark ladybug`."""
    parser.add_argument("file", type=Path, help="problem as published, unpacked")
    parser.add_argument("--out", type=Path, help="solve with ours alone; npz file of camera, point")
    parser.add_argument("--threads", type=argument(Workers), default=2)
    parser.add_argument(
        "--repeats", type=argument(Rounds), default=3, help="runs of each; the median counts"
    )
    parser.add_argument(
        "--solvers", nargs="+", default=["ours", "ceres"], choices=["ours", "ceres"]
    )


def run(options: argparse.Namespace) -> None:
    """Solves the problem with ours alone, or prints the table of both."""
    torch.set_num_threads(options.threads)
    problem = load(options.file)
    if options.out is not None:
        print(json.dumps(solve(problem, options.out)))
        return
    print(f"cost at the start {cost(problem, problem.camera, problem.point):.4f}")
    print(f"{'solver':>7} {'setup':>8} {'solve':>8} {'steps':>6} {'memory':>8} {'cost':>16}")
    _race(problem, options)


def solve(problem: Bal, out: Path) -> dict[str, Any]:
    """Solves the problem with ours; writes camera and point, and gives time, steps and memory."""
    if not out.parent.is_dir():
        raise InputError(f"{out}: the folder {out.parent} does not exist")
    start = time.perf_counter()
    built, values, backend = bundle(problem)
    backend.prepare(built, values)
    # What a process loads at its first operations (threads, kernels) is set-up.
    lm.step(built, lm.init(built, values, LM), LM, backend=backend)
    ready = time.perf_counter()
    last = lm.solve(built, values, LM, backend=backend)
    done = time.perf_counter()
    camera, point = last.values["camera"].numpy(), last.values["point"].numpy()
    beside = out.with_name(f".{out.name}.tmp.npz")
    np.savez(beside, camera=camera, point=point)
    os.replace(beside, out)
    return {
        "setup_s": ready - start,
        "solve_s": done - ready,
        "iterations": last.iterations,
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "cost": cost(problem, camera, point),
        "reason": last.reasons[0],
    }


def _race(problem: Bal, options: argparse.Namespace) -> None:
    """Both in turns, each in a fresh process; a line of medians for each."""
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in options.solvers}
    failed: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as folder:
        arrays, out = Path(folder) / "problem.npz", Path(folder) / "result.npz"
        np.savez(arrays, **{f.name: getattr(problem, f.name) for f in fields(problem)})
        threads = str(options.threads)
        ours = ["-m", "crowdmap_torch", "benchmark", "ladybug"]
        commands = {
            "ours": [*ours, options.file, "--out", out, "--threads", threads],
            "ceres": [Path(__file__).parent / PEER, arrays, out, threads],
        }
        limits = {"OMP_NUM_THREADS": threads, "MKL_NUM_THREADS": threads}
        for _ in range(options.repeats):
            for name in options.solvers:
                done = subprocess.run(
                    [sys.executable, *map(str, commands[name])],
                    capture_output=True,
                    text=True,
                    env={**os.environ, **limits},
                    check=False,
                )
                if done.returncode:
                    said = (done.stderr.strip().splitlines() or ["no message"])[-1]
                    failed[name] = f"exit code {done.returncode}: {said}"
                    continue
                figures = json.loads(done.stdout.strip().splitlines()[-1])
                with np.load(out) as result:
                    figures["cost"] = cost(problem, result["camera"], result["point"])
                runs[name].append(figures)
    for name, done in runs.items():
        if name in failed:
            print(f"{name:>7} {failed[name]}")
            continue
        middle = {
            key: statistics.median(one[key] for one in done)
            for key in ("setup_s", "solve_s", "iterations", "peak_gb", "cost")
        }
        print(
            f"{name:>7} {middle['setup_s']:>6.2f} s {middle['solve_s']:>6.2f} s "
            f"{middle['iterations']:>6.0f} {middle['peak_gb']:>5.2f} GB {middle['cost']:>16.4f}",
            flush=True,
        )
