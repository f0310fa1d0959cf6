"""Way along a trajectory."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def station(T_world_camera: Float[Tensor, "f 4 4"], *, half_window: int = 7) -> Float[Tensor, " f"]:
    """Distance travelled up to each frame [m], from positions smoothed over about a second.

    The white noise of positions would add metres while a car stands at a light.
    """
    position = T_world_camera[:, :3, 3]
    last = len(position) - 1
    index = torch.arange(len(position), device=position.device)
    ahead, behind = (index + half_window).clamp_max(last), (index - half_window).clamp_min(0)
    speed = (position[ahead] - position[behind]).norm(dim=-1) / (ahead - behind).clamp_min(1)
    return torch.cat((speed.new_zeros(1), ((speed[1:] + speed[:-1]) / 2).cumsum(0)))[: last + 1]
