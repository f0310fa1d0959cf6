"""The non-holonomic constraint against positions: what slides sideways is drift, what the car does is not."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from worlds.drives import make_journey
from worlds.sign_drive import F64, RIG, straight_poses

from crowdmap_torch.geometry import se3
from crowdmap_torch.noise.positioning import (
    DriftPathConfig,
    PositioningNoise,
    drift_terms,
    knot_count,
    places_on_path,
)
from crowdmap_torch.optim.linearize import residuals
from crowdmap_torch.optim.problem import Problem, Variable, euclidean
from crowdmap_torch.optim.solvers.dense import DenseBackend
from crowdmap_torch.road.nonholonomic import DrivePath, NonholonomicConfig, drive_path

NOISE, DRIFT, CAR = PositioningNoise(), DriftPathConfig(), NonholonomicConfig()


def bend(frames: int = 300, *, turn: float = 4e-3, lever: float = 0.0, yaw: float = 0.0) -> Tensor:
    """A level drive whose heading turns by `turn` a frame, to the left and back again.

    The camera is `lever` metres ahead of the axle that does not steer, and looks `yaw` to the left of the way.
    """
    poses = straight_poses(frames, step_m=0.5)
    rate = turn * torch.sin(torch.arange(frames) / 30.0).to(F64)
    heading = rate.cumsum(0)
    ahead = torch.stack((-heading.sin(), heading.cos()), dim=-1)
    # Chords of the bend, as reckoning takes them.
    middle = torch.nn.functional.normalize(ahead[1:] + ahead[:-1], dim=-1)
    p = poses[:, :3, 3].clone()
    p[1:, :2] = (0.5 * middle).cumsum(0)
    p[:, :2] = p[:, :2] + lever * ahead
    angle = -(heading + yaw)
    zero = torch.zeros_like(angle)
    R = poses[:, :3, :3] @ se3.so3_exp(torch.stack((zero, angle, zero), dim=-1))
    return se3.make(R, p)


def path_of(poses: Tensor) -> DrivePath:
    return drive_path(make_journey(RIG, poses), NOISE, CAR, DRIFT)


def parting(path: DrivePath, values: dict[str, Tensor]) -> Tensor:
    """How far the paths part from knot to knot [m]."""
    assert path.nonholonomic.weight is not None
    return residuals(path.nonholonomic, values)[:, 0] / path.nonholonomic.weight


def likeliest(path: DrivePath) -> Tensor:
    """The drift at the frames that constraint and prior make likeliest."""
    knots = knot_count(path.station, DRIFT)
    terms = {
        "nonholonomic": path.nonholonomic,
        **drift_terms(knots, 1.0, path.station, NOISE, DRIFT),
    }
    problem = Problem({"drift": Variable(8, euclidean)}, terms)
    normal = DenseBackend().assemble(problem, {"drift": path.station.new_zeros(knots, 8)})
    step = normal.solve(torch.zeros(1, dtype=F64)).delta["drift"]
    return places_on_path(path.station, DRIFT).drift(step)


@pytest.mark.parametrize(("lever", "yaw"), [(0.0, 0.0), (1.6, 0.0), (0.0, 0.02), (1.6, -0.015)])
def test_a_drive_without_drift_shows_none(lever, yaw):
    """However the camera stands in the car: reckoning learns that by itself."""
    path = path_of(bend(lever=lever, yaw=yaw))
    knots = knot_count(path.station, DRIFT)
    still = {"drift": path.station.new_zeros(knots, 8)}
    seen = parting(path, still)
    # A tenth of what positions drift from knot to knot.
    assert float(seen.abs().max()) < 0.1 * NOISE.walk_m * DRIFT.knot_m**0.5
    assert float(likeliest(path)[:, :3].norm(dim=-1).max()) < 0.02


def test_sideways_drift_is_seen_and_drift_ahead_is_not():
    # Straight, so that no lever can stand in for the drift.
    poses = bend(turn=0.0)
    place = torch.arange(len(poses)) / 12.0
    wave = 0.15 * torch.sin(place).to(F64)
    ahead, right = poses[:, :3, 2], poses[:, :3, 0]
    given = poses.clone()
    given[:, :3, 3] += wave[:, None] * right
    # The drift is what takes the given pose to the true one.
    found = (likeliest(path_of(given))[:, :3] * right).sum(-1)
    change = (found + wave) - (found + wave).mean()
    assert float(change.square().mean().sqrt()) < 0.3 * float(wave.square().mean().sqrt())
    given = poses.clone()
    given[:, :3, 3] += wave[:, None] * ahead
    assert float(likeliest(path_of(given))[:, :3].norm(dim=-1).max()) < 0.03


def test_a_turned_heading_parts_the_paths():
    """The drift's rotation has its sign right: a car that truly heads left of what it says moves to its left."""
    poses = straight_poses(100, step_m=0.5)
    angle = 0.01
    turn = se3.so3_exp(torch.tensor([0.0, angle, 0.0], dtype=F64))
    # Headings are off by a constant angle from the middle on.
    given = poses.clone()
    given[50:, :3, :3] = poses[50:, :3, :3] @ turn
    path = path_of(given)
    knots = knot_count(path.station, DRIFT)
    true = path.station.new_zeros(knots, 8)
    true[int(25.0 / DRIFT.knot_m) + 1 :, 4] = -angle

    def worst(drift: Tensor) -> float:
        # Slip is fitted to the whole drive, and shows as a constant.
        seen = parting(path, {"drift": drift})
        return float((seen - seen.median()).abs().max())

    assert worst(true) < 0.6 * worst(torch.zeros_like(true))


def test_a_standing_car_is_not_constrained():
    poses = straight_poses(1).expand(50, 4, 4)
    path = path_of(poses)
    assert len(path.nonholonomic) <= 1
    assert bool(path.station.isfinite().all()) and float(path.station.max()) == 0.0


def test_a_gap_in_the_frames_is_not_reckoned_across():
    poses = bend()
    whole = path_of(poses)
    path = path_of(torch.cat((poses[:100], poses[150:])))
    assert float(path.station[-1]) == pytest.approx(float(whole.station[-1]), rel=0.02)
    (_, before), (_, after) = path.nonholonomic.slots
    inside = torch.arange(int(52.0 / DRIFT.knot_m) + 1, int(72.0 / DRIFT.knot_m) + 1)
    assert not bool(torch.isin(before, inside).any()) and not bool(torch.isin(after, inside).any())
    assert len(path.nonholonomic) >= len(whole.nonholonomic) - len(inside) - 2


def test_where_frames_are_missing_the_constraint_says_less():
    poses = bend()
    kept = torch.ones(len(poses), dtype=torch.bool)
    kept[102:109] = False
    path = path_of(poses[kept])
    assert path.nonholonomic.weight is not None
    sigma = 1 / path.nonholonomic.weight
    assert float(sigma.max()) > 1.5 * float(sigma.median())
