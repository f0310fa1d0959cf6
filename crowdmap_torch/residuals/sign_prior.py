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
from crowdmap_torch.ranges import Length, Settings, SigmaOrOff
from crowdmap_torch.residuals.reprojection import components, corner_world


@dataclass(frozen=True)
class SignHabit(Settings):
    """How far signs are from what is usual, 1-sigma."""

    facing_rad: SigmaOrOff = 0.5
    """Angle between a sign's normal and the direction it is driven at."""
    upright_rad: SigmaOrOff = 0.1
    """Roll and tilt."""
    typical_size_m: Length = 0.75
    """Median width and height; in the adjustment of many signs their own."""
    log_size: SigmaOrOff = 0.8
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
        takes_rows=True,
    )


def sign_habit(
    T_world_sign: Float[Tensor, "4 4 *#rows"],
    size: Float[Tensor, "2 *#rows"],
    facing: Float[Tensor, "3 *#rows"],
    typical_size: Float[Tensor, "2 *#rows"],
) -> Float[Tensor, "5 *#rows"]:
    """How unusual a sign is: small angles [rad] off facing the drive and off upright, and logarithms of its size (IV-B).

    `facing` is the horizontal direction in the world that the sign probably faces, `typical_size` a width and height [m].
    """
    R = T_world_sign[:3, :3]
    angles = torch.stack((components(facing, R[:, 0]), R[2, 0], R[2, 2]))
    return torch.cat((angles, size_class(size, typical_size)))


def size_class(
    size: Float[Tensor, "2 *#rows"], usual: Float[Tensor, "2 *#rows"]
) -> Float[Tensor, "2 *#rows"]:
    """How far a sign's width and height are from a usual size, as logarithms."""
    return (size / usual).log()


def sign_place(
    T_world_sign: Float[Tensor, "4 4 *#rows"],
    size: Float[Tensor, "2 *#rows"],
    template: Float[Tensor, "2 *#rows"],
    surveyed: Float[Tensor, "3 *#rows"],
) -> Float[Tensor, "3 *#rows"]:
    """Displacement of a point of a sign's plane from where a survey puts it in the world [m]."""
    return corner_world(T_world_sign, template * size) - surveyed
