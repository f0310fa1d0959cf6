"""What signs are like: the residual's derivatives, and where signs probably face."""

from __future__ import annotations

import torch
from sign_drive import F64, signs_at, straight_poses
from torch.func import jacfwd

from crowdmap_torch.geometry import se3
from crowdmap_torch.optim.levenberg_marquardt import LmConfig, solve
from crowdmap_torch.optim.linear import DenseBackend
from crowdmap_torch.optim.problem import Problem, Variable, positive
from crowdmap_torch.sign_habit import (
    SignHabit,
    against_the_drive,
    habit_term,
    sign_habit,
    sign_habit_jacobian,
)

FACING_SOUTH = torch.tensor([0.0, -1.0, 0.0], dtype=F64)


def test_the_habits_jacobian_is_that_of_autograd(generator):
    T = se3.retract(signs_at([(1.0, 2.0, 3.0)]), torch.full((1, 6), 0.2, dtype=F64))
    size, typical = torch.rand(2, 1, 2, dtype=F64, generator=generator) + 0.5

    def habit(xi, log_size):
        moved = se3.retract(T[0], xi)
        return sign_habit(moved, positive(size[0], log_size), FACING_SOUTH, typical[0])

    zeros = torch.zeros(6, dtype=F64), torch.zeros(2, dtype=F64)
    value, found = sign_habit_jacobian(T, size, FACING_SOUTH[None], typical)
    torch.testing.assert_close(value[0], habit(*zeros))
    for exact, J in zip(jacfwd(habit, (0, 1))(*zeros), found, strict=True):
        torch.testing.assert_close(J[0], exact)


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
