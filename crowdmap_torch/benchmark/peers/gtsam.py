"""GTSAM on a problem of `free_corners`: `gtsam.py PROBLEM.npz OUT.npz THREADS`, C++ factors only."""

import json
import resource
import sys
import time

# This file has the name of the package that it needs.
sys.path.pop(0)

import gtsam
import numpy as np


def main() -> None:
    """Huber's stage, then Tukey's; writes q, p, X and prints one JSON line."""
    given, out = dict(np.load(sys.argv[1])), sys.argv[2]
    start = time.perf_counter()
    n, points = len(given["prior_q"]), len(given["pt_init"])
    camera = gtsam.Cal3_S2(given["K"][0], given["K"][1], 0.0, given["K"][2], given["K"][3])

    def pose(q, p):
        return gtsam.Pose3(gtsam.Rot3(q[3], q[0], q[1], q[2]), p)

    def sigmas(rotation, translation):
        both = np.repeat([given[rotation], given[translation]], 3)
        return gtsam.noiseModel.Diagonal.Sigmas(both)

    values = gtsam.Values()
    for i in range(n):
        values.insert(i, pose(given["prior_q"][i], given["prior_p"][i]))
    for k in range(points):
        values.insert(n + k, given["pt_init"][k])
    prior, step = sigmas("sig_prior_r", "sig_prior_t"), sigmas("sig_odo_r", "sig_odo_t")
    fixed = [
        gtsam.PriorFactorPose3(i, pose(q, p), prior)
        for i, (q, p) in enumerate(zip(given["prior_q"], given["prior_p"], strict=True))
    ]
    fixed += [
        gtsam.BetweenFactorPose3(i, i + 1, pose(q, p), step)
        for i, q, p in zip(given["odo_i"].tolist(), given["odo_q"], given["odo_p"], strict=True)
    ]
    noise = gtsam.noiseModel.Isotropic.Sigma(2, float(given["sig_px"]))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-6)
    params.setAbsoluteErrorTol(0)
    params.setMaxIterations(100)
    params.setOrderingType("COLAMD")
    kinds = gtsam.noiseModel.mEstimator
    setup, solve, iterations = time.perf_counter() - start, 0.0, 0
    for loss in (
        kinds.Huber.Create(float(given["huber_c"])),
        kinds.Tukey.Create(float(given["tukey_c"])),
    ):
        start = time.perf_counter()
        graph, robust = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Robust.Create(loss, noise)
        for factor in fixed:
            graph.add(factor)
        rows = (given["obs_uv"], given["obs_pose"].tolist(), (given["obs_pt"] + n).tolist())
        for uv, i, k in zip(*rows, strict=True):
            graph.add(gtsam.GenericProjectionFactorCal3_S2(uv, robust, i, k, camera))
        built = time.perf_counter()
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
        values = optimizer.optimize()
        solve += time.perf_counter() - built
        setup += built - start
        iterations += optimizer.iterations()
    poses = [values.atPose3(i) for i in range(n)]
    rotations = [p.rotation().toQuaternion() for p in poses]
    np.savez(
        out,
        q=np.array([[r.x(), r.y(), r.z(), r.w()] for r in rotations]),
        p=np.array([p.translation() for p in poses]),
        X=np.array([values.atPoint3(n + k) for k in range(points)]),
    )
    figures = {
        "setup_s": setup,
        "solve_s": solve,
        "iterations": iterations,
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }
    print(json.dumps(figures), flush=True)


if __name__ == "__main__":
    main()
