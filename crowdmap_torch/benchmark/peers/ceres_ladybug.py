"""Ceres on a problem of `ladybug`: `ceres_ladybug.py PROBLEM.npz OUT.npz THREADS`, C++ cost functions only.

Needs pyceres 2.6 and pycolmap 3.13. COLMAP's RADIAL model is the benchmark's in a frame turned half round x, which looks
along +z with y down. It gives no residual to what lies behind the camera, where the benchmark does: what lies there at the
start is projected in the frame that is not turned, where it lies in front, and comes out mirrored.
"""

import json
import os
import resource
import sys
import time

import numpy as np
import pyceres
import pycolmap
from pycolmap import cost_functions
from scipy.spatial.transform import Rotation

TURN = np.array([1.0, -1.0, -1.0])
"""The turned frame's axes along the benchmark's."""


def main() -> None:
    """Solves it as Ceres' own bundle_adjuster does; writes camera, point and prints one JSON line."""
    given, out, threads = dict(np.load(sys.argv[1])), sys.argv[2], int(sys.argv[3])
    start = time.perf_counter()
    camera, point, px = given["camera"], given["point"], given["px"]
    R = Rotation.from_rotvec(camera[:, :3])
    turn = Rotation.from_matrix(np.diag(TURN))
    q = [np.ascontiguousarray(row) for row in (turn * R).as_quat()]
    t = [np.ascontiguousarray(row) for row in camera[:, 3:6] * TURN]
    X = [np.ascontiguousarray(row) for row in point]
    lens = [np.array([f, 0.0, 0.0, k1, k2]) for f, k1, k2 in camera[:, 6:]]
    at = R[given["camera_of"]].apply(point[given["point_of"]]) + camera[given["camera_of"], 3:6]
    model = pycolmap.CameraModelId.RADIAL
    turn_back = pycolmap.Rigid3d(pycolmap.Rotation3d(turn.as_quat()), np.zeros(3))
    in_front = [cost_functions.ReprojErrorCost(model, [u, -v]) for u, v in px]
    behind = {
        row: cost_functions.RigReprojErrorCost(model, -px[row], turn_back)
        for row in np.nonzero(at[:, 2] > 0)[0].tolist()
    }
    problem, summary = pyceres.Problem(), pyceres.SolverSummary()
    rows = zip(given["camera_of"], given["point_of"], strict=True)
    for row, (i, k) in enumerate(rows):
        residual = behind.get(row, in_front[row])
        problem.add_residual_block(residual, None, [q[i], t[i], X[k], lens[i]])
    sphere, centred = pyceres.EigenQuaternionManifold(), pyceres.SubsetManifold(5, [1, 2])
    for i in range(len(camera)):
        problem.set_manifold(q[i], sphere)
        problem.set_manifold(lens[i], centred)

    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_SCHUR
    options.num_threads = threads
    options.function_tolerance = 1e-6
    options.gradient_tolerance = options.parameter_tolerance = 0
    options.max_num_iterations = 100
    options.minimizer_progress_to_stdout = False
    built = time.perf_counter()
    pyceres.solve(options, problem, summary)
    done = time.perf_counter()
    R = Rotation.from_quat(np.array(q))
    camera = np.hstack(((turn * R).as_rotvec(), np.array(t) * TURN, np.array(lens)[:, [0, 3, 4]]))
    np.savez(out, camera=camera, point=np.array(X))
    figures = {
        "setup_s": built - start,
        "solve_s": done - built,
        "iterations": summary.num_successful_steps + summary.num_unsuccessful_steps,
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "own_cost": summary.final_cost,
    }
    print(json.dumps(figures), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()
