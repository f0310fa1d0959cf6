"""Ceres on a problem of `free_corners`: `ceres.py PROBLEM.npz OUT.npz THREADS`, C++ cost functions only.

Needs pyceres 2.6 and pycolmap 3.13. pyceres binds no Tukey loss: a few lines of C++, compiled here, put one in place of
a loss that it does bind.
"""

import ctypes
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyceres
import pycolmap
from pycolmap import cost_functions
from scipy.spatial.transform import Rotation

TUKEY = """
#include <new>
struct Loss { virtual ~Loss() {} virtual void Evaluate(double s, double* rho) const = 0; };
struct Tukey final : Loss {
  double c2;
  explicit Tukey(double c) : c2(c * c) {}
  void Evaluate(double s, double* rho) const override {
    const double rest = s < c2 ? 1 - s / c2 : 0;
    rho[0] = c2 / 3 * (1 - rest * rest * rest);
    rho[1] = rest * rest;
    rho[2] = -2 / c2 * rest;
  }
};
extern "C" void put_tukey(void* at, double c) { new (at) Tukey(c); }
"""


def tukey_loss(c: float, folder: Path):
    """A loss object of pyceres whose C++ part is replaced by Tukey's biweight."""
    source, library = folder / "tukey.cpp", folder / "tukey.so"
    source.write_text(TUKEY)
    compiler = os.environ.get("CXX", "c++")
    subprocess.run(
        [compiler, "-O2", "-shared", "-fPIC", str(source), "-o", str(library)], check=True
    )
    put = ctypes.CDLL(str(library)).put_tukey
    put.argtypes = [ctypes.c_void_p, ctypes.c_double]
    loss = pyceres.LossFunction({"name": "arctan", "params": [1.0]})
    # Behind the Python object's head stands the table of the C++ objects that it holds.
    held = ctypes.cast(id(loss) + 16, ctypes.POINTER(ctypes.POINTER(ctypes.c_void_p)))
    put(held[0][0], c)
    return loss


def main() -> None:
    """Huber's stage, then Tukey's; writes q, p, X and prints one JSON line."""
    given = dict(np.load(sys.argv[1]))
    out, threads = sys.argv[2], int(sys.argv[3])
    start = time.perf_counter()
    R = Rotation.from_quat(given["prior_q"]).inv()
    q = [np.ascontiguousarray(row) for row in R.as_quat()]
    t = [np.ascontiguousarray(row) for row in -R.apply(given["prior_p"])]
    X = [np.ascontiguousarray(row) for row in given["pt_init"]]
    camera = given["K"][[0, 2, 3]].copy()

    def rigid(rotation, translation):
        return pycolmap.Rigid3d(pycolmap.Rotation3d(np.array(rotation)), translation)

    model = pycolmap.CameraModelId.SIMPLE_PINHOLE
    noise = np.eye(2) * given["sig_px"] ** 2
    corners = [cost_functions.ReprojErrorCost(model, noise, uv) for uv in given["obs_uv"]]
    cov = np.diag(np.repeat([given["sig_prior_r"], given["sig_prior_t"]], 3) ** 2)
    priors = [
        cost_functions.AbsolutePosePriorCost(cov, rigid(*pair)) for pair in zip(q, t, strict=True)
    ]
    turn = Rotation.from_quat(given["odo_q"]).inv()
    cov = np.diag(np.repeat([given["sig_odo_r"], given["sig_odo_t"]], 3) ** 2)
    steps = [
        cost_functions.RelativePosePriorCost(cov, rigid(*pair))
        for pair in zip(turn.as_quat(), -turn.apply(given["odo_p"]), strict=True)
    ]

    def build(loss):
        problem = pyceres.Problem()
        for cost, i, k in zip(corners, given["obs_pose"], given["obs_pt"], strict=True):
            problem.add_residual_block(cost, loss, [q[i], t[i], X[k], camera])
        for i, cost in enumerate(priors):
            problem.add_residual_block(cost, None, [q[i], t[i]])
        for cost, i in zip(steps, given["odo_i"], strict=True):
            problem.add_residual_block(cost, None, [q[i + 1], t[i + 1], q[i], t[i]])
        sphere = pyceres.EigenQuaternionManifold()
        for rotation in q:
            problem.set_manifold(rotation, sphere)
        problem.set_parameter_block_constant(camera)
        return problem

    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.SPARSE_NORMAL_CHOLESKY
    options.num_threads = threads
    options.function_tolerance = 1e-6
    options.gradient_tolerance = options.parameter_tolerance = 0
    options.max_num_iterations = 100
    options.minimizer_progress_to_stdout = False
    setup, solve, iterations = time.perf_counter() - start, 0.0, 0
    with tempfile.TemporaryDirectory() as folder:
        losses = (
            pyceres.HuberLoss(float(given["huber_c"])),
            tukey_loss(float(given["tukey_c"]), Path(folder)),
        )
        for loss in losses:
            start = time.perf_counter()
            problem, summary = build(loss), pyceres.SolverSummary()
            built = time.perf_counter()
            pyceres.solve(options, problem, summary)
            solve += time.perf_counter() - built
            setup += built - start
            iterations += summary.num_successful_steps + summary.num_unsuccessful_steps
    R = Rotation.from_quat(np.array(q)).inv()
    np.savez(out, q=R.as_quat(), p=-R.apply(np.array(t)), X=np.array(X))
    figures = {
        "setup_s": setup,
        "solve_s": solve,
        "iterations": iterations,
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }
    print(json.dumps(figures), flush=True)
    # The C++ objects that were exchanged must not be destroyed.
    os._exit(0)


if __name__ == "__main__":
    main()
