"""A bundle adjustment that every solver can be given: free 3D corners, pose priors, odometry.

The problem is plain numpy in an npz file, and one neutral function computes its cost, so that solvers in other
languages race on the same objective:

    1/2 sum rho(|projection - pixel|^2 / sig_px^2)
    + 1/2 sum over poses (|p - prior|^2 / sig_prior_t^2 + angle^2 / sig_prior_r^2)
    + 1/2 sum over odometry (|R_k^T (p_k+1 - p_k) - measured|^2 / sig_odo_t^2 + angle^2 / sig_odo_r^2)

Poses are world from camera: a unit quaternion (x, y, z, w) and the camera's centre [m]. Almost all corners start
outside Tukey's basin: solvers minimise with Huber's loss first, then with Tukey's.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.optim.problem import CostTerm, Problem, Variable, euclidean
from crowdmap_torch.optim.robust import Loss
from crowdmap_torch.residuals import pose as residuals
from crowdmap_torch.residuals import reprojection

Array = NDArray[Any]


_SPACING_M = 2.0
"""Way between two frames [m]."""


@dataclass(frozen=True)
class FreeCorners:
    """The arrays of one problem, as they stand in its file."""

    J: int
    """Journeys."""
    F: int
    """Frames of each."""
    S: int
    """Signs of four corners each."""
    K: Array
    """fx, fy, cx, cy [px]."""
    prior_q: Array
    prior_p: Array
    """Priors of the poses of all journeys, one behind the other; every solver starts there."""
    odo_q: Array
    odo_p: Array
    """Measured poses of frame `odo_i + 1` in frame `odo_i`."""
    odo_i: Array
    obs_pose: Array
    obs_pt: Array
    obs_uv: Array
    """Observed corners [px]."""
    pt_init: Array
    """Corners at the start [m]."""
    sig_px: float
    sig_prior_t: float
    sig_prior_r: float
    sig_odo_t: float
    sig_odo_r: float
    tukey_c: float
    huber_c: float

    def save(self, path: Path) -> None:
        """Writes the arrays into an npz file."""
        np.savez(path, **{f.name: getattr(self, f.name) for f in fields(self)})


def load(path: Path) -> FreeCorners:
    """The problem of an npz file; arrays that no solver needs are ignored."""
    try:
        with np.load(path) as arrays:
            given = {f.name: arrays[f.name] for f in fields(FreeCorners)}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: expected an npz file of arrays: {error}") from None
    except KeyError as error:
        raise InputError(f"{path}: expected an array named {error.args[0]}") from None
    return FreeCorners(**{k: v.item() if v.ndim == 0 else v for k, v in given.items()})


def simulate(journeys: int, frames: int, signs: int, seed: int = 0) -> FreeCorners:
    """Drives along one winding road, a frame every two metres, past signs on both sides."""
    rng = np.random.default_rng([seed, journeys, frames, signs])
    length, n = _SPACING_M * frames, journeys * frames
    road = _winding_road(length)
    s = rng.uniform(0, _SPACING_M, (journeys, 1)) + _SPACING_M * np.arange(frames)
    R, p = _drive(road, s, rng)
    where, point = _plates(road, length, signs, rng)
    K = np.array([1000.0, 1000.0, 640.0, 400.0])
    obs_pose, obs_pt = _seen(K, R, p, s.reshape(n), where, point)
    uv = _project(K, R.as_quat(), p, point, obs_pose, obs_pt)
    uv += 0.7 * rng.standard_normal(uv.shape)
    wrong = rng.random(len(uv)) < 0.03
    uv[wrong] += 50 * rng.standard_normal((wrong.sum(), 2))
    error = _pose_errors(journeys, frames, rng)
    sig_r, odo_r = np.radians(0.3), np.radians(0.02)
    first = (np.arange(journeys)[:, None] * frames + np.arange(frames - 1)).ravel()
    step = _rows(R, first).inv().apply(p[first + 1] - p[first])
    turn = _rows(R, first).inv() * _rows(R, first + 1) * _turns(rng, odo_r, len(first))
    return FreeCorners(
        J=journeys,
        F=frames,
        S=signs,
        K=K,
        prior_q=(R * _turns(rng, np.radians(0.2), n)).as_quat(),
        prior_p=p + error,
        odo_q=turn.as_quat(),
        odo_p=step + 0.02 * rng.standard_normal(step.shape),
        odo_i=first,
        obs_pose=obs_pose,
        obs_pt=obs_pt,
        obs_uv=uv,
        pt_init=point + 0.4 * rng.standard_normal(point.shape),
        sig_px=0.7,
        sig_prior_t=0.5,
        sig_prior_r=sig_r,
        sig_odo_t=0.02,
        sig_odo_r=odo_r,
        tukey_c=4.685,
        huber_c=1.345,
    )


@dataclass(frozen=True)
class _Road:
    """The middle of a road, sampled by its stations."""

    station: Array
    heading: Array
    x: Array
    y: Array

    def at(self, s: Array, aside: Array) -> tuple[Array, Array]:
        """Points beside the stations `s`, positive to the left, and the road's headings there."""
        h = np.interp(s, self.station, self.heading)
        east = np.interp(s, self.station, self.x) - np.sin(h) * aside
        north = np.interp(s, self.station, self.y) + np.cos(h) * aside
        return np.stack((east, north, 3 * np.sin(s / 145)), axis=-1), h


def _winding_road(length: float) -> _Road:
    station = np.arange(-20.0, length + 90, 0.1)
    heading = 0.35 * np.sin(station / 110) + 0.12 * np.sin(station / 37)
    x, y = np.cumsum(np.cos(heading)) * 0.1, np.cumsum(np.sin(heading)) * 0.1
    return _Road(station, heading, x, y)


def _drive(road: _Road, s: Array, rng: np.random.Generator) -> tuple[Rotation, Array]:
    """True poses of the cameras at the stations `s` of each journey."""
    p, h = road.at(s, 0.25 * np.sin(s / 24 + rng.uniform(0, 6.28, (len(s), 1))))
    p[..., 2] += 1.4
    h = h + 0.01 * np.sin(s / 14)
    # Camera axes as columns: right, down, forward.
    none = np.zeros_like(h)
    right = np.stack((np.sin(h), -np.cos(h), none), axis=-1)
    ahead = np.stack((np.cos(h), np.sin(h), none), axis=-1)
    axes = np.stack((right, np.stack((none, none, none - 1), axis=-1), ahead), axis=-1)
    R = Rotation.from_matrix(axes.reshape(s.size, 3, 3)) * _turns(rng, 0.003, s.size)
    return R, p.reshape(s.size, 3)


def _plates(
    road: _Road, length: float, signs: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Stations of square signs beside the road, and their corners, four of each."""
    where = np.sort(rng.uniform(10, length + 8, signs))
    centre, facing = road.at(where, rng.choice([-1.0, 1.0], signs) * rng.uniform(2, 8, signs))
    centre[:, 2] += rng.uniform(2, 5, signs)
    half = rng.uniform(0.3, 0.45, signs)[:, None, None]
    aside = np.stack((np.sin(facing), -np.cos(facing), 0 * facing), axis=-1)[:, None]
    corner = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
    point = centre[:, None] + half * (corner[:, :1] * aside + corner[:, 1:] * np.array([0, 0, 1.0]))
    return where, point.reshape(-1, 3)


def _seen(
    K: Array, R: Rotation, p: Array, frame_station: Array, where: Array, point: Array
) -> tuple[Array, Array]:
    """Pose and point of every corner of the signs that are wholly in the image, 8 to 60 m ahead."""
    seen: list[tuple[Array, Array]] = []
    for sign in range(len(where)):
        near = np.nonzero(np.abs(where[sign] - frame_station - 34) < 26)[0]
        local = point[4 * sign : 4 * sign + 4][None] - p[near, None]
        local = np.einsum("nji,ncj->nci", _rows(R, near).as_matrix(), local)
        px = local[..., :2] / local[..., 2:] * K[:2] + K[2:]
        inside = (local[..., 2] > 1) & (px > 0).all(-1) & (px < 2 * K[2:]).all(-1)
        near = near[inside.all(1)]
        seen.append((near, np.full(len(near), sign)))
    pose, sign = (np.concatenate(part) for part in zip(*seen, strict=True))
    order = np.lexsort((sign, pose))
    return np.repeat(pose[order], 4), (4 * sign[order][:, None] + np.arange(4)).ravel()


def _pose_errors(journeys: int, frames: int, rng: np.random.Generator) -> Array:
    """What positioning gets wrong of each frame's place: a bias of the journey and a slow drift."""
    keeps = np.exp(-_SPACING_M / 100)
    drift = rng.standard_normal((journeys, frames, 3))
    for k in range(1, frames):
        drift[:, k] = keeps * drift[:, k - 1] + np.sqrt(1 - keeps**2) * drift[:, k]
    bias = rng.standard_normal((journeys, 1, 3)) * [0.5, 0.5, 0.1]
    return (bias + drift * [0.2, 0.2, 0.1]).reshape(journeys * frames, 3)


def _turns(rng: np.random.Generator, sigma: float, n: int) -> Rotation:
    return Rotation.from_rotvec(sigma * rng.standard_normal((n, 3)))


def _rows(R: Rotation, rows: Array) -> Rotation:
    return Rotation.from_quat(R.as_quat()[rows])


def _project(K: Array, q: Array, p: Array, X: Array, pose: Array, point: Array) -> Array:
    # Rotation by the transpose of R: the world offset in camera axes.
    local = Rotation.from_quat(q[pose]).inv().apply(X[point] - p[pose])
    return local[:, :2] / local[:, 2:] * K[:2] + K[2:]


def cost(problem: FreeCorners, q: Array, p: Array, X: Array) -> float:
    """The objective with Tukey's loss at poses (q, p) and corners X: the one judge of all solvers."""
    error = _project(problem.K, q, p, X, problem.obs_pose, problem.obs_pt) - problem.obs_uv
    squared = (error**2).sum(1) / problem.sig_px**2
    c2 = problem.tukey_c**2
    total = (c2 / 3 * (1 - np.clip(1 - squared / c2, 0, None) ** 3)).sum()
    R, prior = Rotation.from_quat(q), Rotation.from_quat(problem.prior_q)
    total += ((p - problem.prior_p) ** 2).sum() / problem.sig_prior_t**2
    total += ((prior.inv() * R).magnitude() ** 2).sum() / problem.sig_prior_r**2
    k = problem.odo_i
    step = _rows(R, k).inv().apply(p[k + 1] - p[k]) - problem.odo_p
    turn = Rotation.from_quat(problem.odo_q).inv() * _rows(R, k).inv() * _rows(R, k + 1)
    total += (step**2).sum() / problem.sig_odo_t**2
    total += (turn.magnitude() ** 2).sum() / problem.sig_odo_r**2
    return float(total / 2)


def bundle(
    problem: FreeCorners, loss: Loss, device: torch.device
) -> tuple[Problem, dict[str, torch.Tensor]]:
    """The same as a Problem of `optim`, corners under `loss`, and the values to start from."""

    def tensor(array: Array) -> torch.Tensor:
        return torch.as_tensor(array, device=device)

    def poses(q: Array, p: Array) -> torch.Tensor:
        return se3.make(se3.from_quaternion(tensor(q)), tensor(p))

    def weights(sigma_t: float, sigma_r: float, rows: int) -> torch.Tensor:
        return tensor(np.repeat([1 / sigma_t, 1 / sigma_r], 3)).expand(rows, 6)

    prior = poses(problem.prior_q, problem.prior_p)
    fx, fy, cx, cy = tensor(problem.K)
    uv, n = tensor(problem.obs_uv), len(prior)
    observation = uv.new_zeros(3, 3, len(uv))
    observation[0, 0], observation[1, 1], observation[2, 2] = fx, fy, 1.0
    observation[0, 2], observation[1, 2] = cx - uv[:, 0], cy - uv[:, 1]
    first = tensor(problem.odo_i)
    terms = {
        "corner": CostTerm(
            reprojection.point_reprojection,
            (("pose", tensor(problem.obs_pose)), ("point", tensor(problem.obs_pt))),
            (observation.movedim(-1, 0),),
            uv.new_full((len(uv),), 1 / problem.sig_px),
            loss,
            reprojection.point_reprojection_jacobian,
        ),
        "prior": CostTerm(
            residuals.pose_prior,
            (("pose", torch.arange(n, device=device)),),
            (prior,),
            weights(problem.sig_prior_t, problem.sig_prior_r, n),
            jacobian=residuals.pose_prior_jacobian,
        ),
        "odometry": CostTerm(
            residuals.relative_pose,
            (("pose", first), ("pose", first + 1)),
            (poses(problem.odo_q, problem.odo_p),),
            weights(problem.sig_odo_t, problem.sig_odo_r, len(first)),
            jacobian=residuals.relative_pose_jacobian,
        ),
    }
    variables = {"pose": Variable(6, se3.retract), "point": Variable(3, euclidean)}
    return Problem(variables, terms), {"pose": prior, "point": tensor(problem.pt_init)}
