"""Way along a trajectory, and how it is moved along."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.geometry import se3

_HALF_WINDOW_S = 0.2
"""Velocities are differences over about twice this: over single frames the poses' own noise would be most of them."""


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


def passes(
    T_world_camera: Float[Tensor, "f 4 4"], *, near_m: float = 15.0, way_m: float = 50.0
) -> list[slice]:
    """The frames in pieces none of which comes back to a place, `near_m` from it, after `way_m` or more."""
    position, way = T_world_camera[:, :2, 3].contiguous(), station(T_world_camera)
    starts, start = [0], 0
    for frame in range(1, len(position)):
        before = position[start:frame][way[start:frame] < way[frame] - way_m]
        if len(before) and float((before - position[frame]).square().sum(-1).min()) < near_m**2:
            start = frame
            starts.append(frame)
    return [slice(*ends) for ends in zip(starts, [*starts[1:], len(position)], strict=True)]


def motion(
    T_world_camera: Float[Tensor, "f 4 4"], t_ns: Int[Tensor, " f"]
) -> tuple[Float[Tensor, "f 3"], Float[Tensor, "f 3"]]:
    """Velocity along the world's axes [m/s] and turning about the camera's own [rad/s], of every frame."""
    T = T_world_camera
    if not len(T):
        return T[:, :3, 3], T[:, :3, 3]
    t_s = (t_ns - t_ns[0]).to(T) * 1e-9
    low = torch.searchsorted(t_s, t_s - _HALF_WINDOW_S).clamp_max(len(t_s) - 1)
    high = (torch.searchsorted(t_s, t_s + _HALF_WINDOW_S, right=True) - 1).clamp_min(0)
    step = (t_s[high] - t_s[low]).clamp_min(1e-3)[:, None]
    turned = T[low, :3, :3].mT @ T[high, :3, :3]
    return (T[high, :3, 3] - T[low, :3, 3]) / step, se3.so3_log(turned) / step
