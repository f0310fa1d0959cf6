"""What signs are like, and where they probably face."""

from __future__ import annotations

import torch
from worlds.sign_drive import F64, signs_at, straight_poses

from crowdmap_torch.geometry import se3
from crowdmap_torch.optim.levenberg_marquardt import LmConfig, solve
from crowdmap_torch.optim.problem import Problem, Variable, positive
from crowdmap_torch.optim.solvers.dense import DenseBackend
from crowdmap_torch.residuals.sign_prior import SignHabit, against_the_drive, habit_term

FACING_SOUTH = torch.tensor([0.0, -1.0, 0.0], dtype=F64)


def test_signs_face_the_cars_that_see_them():
    poses = straight_poses(4)
    sign = torch.tensor([0, 0, 1, 1])
    found = against_the_drive(poses, sign, 2)
    torch.testing.assert_close(found, FACING_SOUTH.expand(2, 3), rtol=0, atol=1e-12)


def test_nothing_but_habit_makes_a_sign_usual():
    """A sign that leans and is eleven metres wide ends upright, facing the drive, of typical size."""
    T = se3.retract(
        signs_at([(1.0, 2.0, 3.0)]), torch.tensor([[0, 0, 0, 0.4, 0.3, 0.2]], dtype=F64)
    )
    values = {"sign": T, "size": torch.tensor([[10.9, 0.5]], dtype=F64)}
    habit = SignHabit()
    term = habit_term(FACING_SOUTH[None], torch.tensor([0]), habit)
    variables = {"sign": Variable(6, se3.retract), "size": Variable(2, positive)}
    found = solve(Problem(variables, {"habit": term}), values, LmConfig(), backend=DenseBackend())
    sign, size = found.values["sign"][0], found.values["size"][0]
    torch.testing.assert_close(sign[:3, 2], FACING_SOUTH, rtol=0, atol=1e-3)
    torch.testing.assert_close(size, torch.full_like(size, habit.typical_size_m), rtol=1e-3, atol=0)
    torch.testing.assert_close(sign[:3, 3], T[0, :3, 3])
