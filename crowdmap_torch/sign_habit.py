"""What signs are like before anything is seen of them: they face the drive, stand upright and have a usual size (IV-B).

It holds signs of which detections do not tell enough: a few far views, or boxes drawn around them.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_sum
from crowdmap_torch.optim.problem import CostTerm


@dataclass(frozen=True)
class SignHabit:
    """How far signs are from what is usual, 1-sigma."""

    facing_rad: float = 0.5
    """Angle between a sign's normal and the direction it is driven at."""
    upright_rad: float = 0.1
    """Roll and tilt."""
    typical_size_m: float = 0.75
    """Median width and height."""
    log_size: float = 0.8
    """Logarithms of width and height about that."""


def against_the_drive(
    T_world_camera: Float[Tensor, "m 4 4"], sign: Int[Tensor, " m"], count: int
) -> Float[Tensor, "count 3"]:
    """Horizontal direction against the mean optical axis of each sign's views: where it probably faces."""
    axis = T_world_camera[:, :3, 2] * T_world_camera.new_tensor([1.0, 1.0, 0.0])
    return -torch.nn.functional.normalize(group_sum(axis, sign, count), dim=-1)


def habit_term(facing: Float[Tensor, "n 3"], own: Int[Tensor, " n"], habit: SignHabit) -> CostTerm:
    """What is usual of the signs `own`, by their poses and sizes; `facing` is where they probably face."""
    angles = (habit.facing_rad, habit.upright_rad, habit.upright_rad)
    sigma = facing.new_tensor((*angles, habit.log_size, habit.log_size))
    usual = facing.new_full((len(own), 2), habit.typical_size_m)
    return CostTerm(
        sign_habit,
        (("sign", own), ("size", own)),
        (facing, usual),
        weight=(1 / sigma).expand(len(own), 5),
        jacobian=sign_habit_jacobian,
    )


def sign_habit(
    T_world_sign: Float[Tensor, "4 4"],
    size: Float[Tensor, " 2"],
    facing: Float[Tensor, " 3"],
    typical_size: Float[Tensor, " 2"],
) -> Float[Tensor, " 5"]:
    """How unusual a sign is, as small angles and logarithms: it faces the drive, stands upright and has a usual size."""
    R = T_world_sign[:3, :3]
    right = facing @ R[:, 0]
    log_size = (size / typical_size).log()
    return torch.stack((right, R[2, 0], R[2, 2], log_size[0], log_size[1]))


def sign_habit_jacobian(
    T_world_sign: Float[Tensor, "n 4 4"],
    size: Float[Tensor, "n 2"],
    facing: Float[Tensor, "n 3"],
    typical_size: Float[Tensor, "n 2"],
) -> tuple[Float[Tensor, "n 5"], tuple[Tensor, Tensor]]:
    """`sign_habit` and its Jacobians by sign pose and relative size."""
    R = T_world_sign[:, :3, :3]
    across = (R * facing[..., None]).sum(1)
    up = R[:, 2]
    log_size = (size / typical_size).log()
    habit = torch.cat((across[:, :1], up[:, :1], up[:, 2:], log_size), dim=-1)
    zero = torch.zeros_like(up[:, 0])
    # A turn by w takes the axes x and z to x + w_z y - w_y z and z + w_y x - w_x y.
    by_turn = torch.stack(
        (
            torch.stack((zero, -across[:, 2], across[:, 1]), dim=-1),
            torch.stack((zero, -up[:, 2], up[:, 1]), dim=-1),
            torch.stack((-up[:, 1], up[:, 0], zero), dim=-1),
        ),
        dim=1,
    )
    by_size = torch.eye(5, 2, dtype=size.dtype, device=size.device).roll(3, 0)
    return habit, (
        torch.nn.functional.pad(by_turn, (3, 0, 0, 2)),
        by_size.expand(len(size), 5, 2),
    )
