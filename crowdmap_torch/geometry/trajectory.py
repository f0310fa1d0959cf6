"""Way along a trajectory, and how it is moved along."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.processes.sums import running_sum

_HALF_WINDOW_S = 1.5
"""Velocities are those of cubics through the poses up to this far in time: over less the poses' own noise is most of how
velocities change from frame to frame, and a delay found by them far too small."""
_BENDING = (0.0, 0.0, 1e-3, 1e-2)
"""What the coefficients of these cubics count as known to be zero, in frames: few frames make lines, or nothing."""
_AT_ONCE = 2**18
"""Poses around frames that are looked at together, all frames counted: a long drive takes no more memory."""


def station(T_world_camera: Float[Tensor, "f 4 4"], *, half_window: int = 7) -> Float[Tensor, " f"]:
    """Distance travelled up to each frame [m], from positions smoothed over about a second.

    The white noise of positions would add metres while a car stands at a light.
    """
    position = T_world_camera[:, :3, 3]
    last = len(position) - 1
    index = torch.arange(len(position), device=position.device)
    ahead, behind = (index + half_window).clamp_max(last), (index - half_window).clamp_min(0)
    speed = (position[ahead] - position[behind]).norm(dim=-1) / (ahead - behind).clamp_min(1)
    return torch.cat((speed.new_zeros(1), running_sum((speed[1:] + speed[:-1]) / 2)))[: last + 1]


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
    """Velocity along the world's axes [m/s] and turning about the camera's own [rad/s], of every frame.

    Those of cubics in time, fitted to the poses around each frame (Savitzky and Golay 1964).
    """
    T = T_world_camera
    if len(T) < 2:
        return torch.zeros_like(T[:, :3, 3]), torch.zeros_like(T[:, :3, 3])
    t_s = (t_ns - t_ns[0]).to(T) * 1e-9
    turned = running_sum(se3.so3_log(T[:-1, :3, :3].mT @ T[1:, :3, :3]))
    moved = torch.cat((T[:, :3, 3], torch.cat((torch.zeros_like(turned[:1]), turned))), dim=1)
    low = torch.searchsorted(t_s, t_s - _HALF_WINDOW_S)
    high = torch.searchsorted(t_s, t_s + _HALF_WINDOW_S, right=True)
    most = max(int((high - low).max()), 1)
    every = torch.arange(len(T), device=low.device)
    slopes = [_slope(t_s, moved, at, low[at], high[at]) for at in every.split(_AT_ONCE // most + 1)]
    velocity, turning = torch.cat(slopes).split(3, dim=1)
    return velocity, turning


def _slope(
    t_s: Float[Tensor, " f"],
    moved: Float[Tensor, "f k"],
    at: Int[Tensor, " n"],
    low: Int[Tensor, " n"],
    high: Int[Tensor, " n"],
) -> Float[Tensor, "n k"]:
    """Derivatives at some frames `at` of the cubics through what lies from `low` up to `high` [1/s]."""
    around = low[:, None] + torch.arange(int((high - low).max()), device=low.device)
    inside = (around < high[:, None]).to(moved)
    around = around.clamp_max(len(moved) - 1)
    ahead = (t_s[around] - t_s[at, None]) / _HALF_WINDOW_S
    basis = inside[..., None] * torch.stack([ahead**power for power in range(4)], dim=-1)
    normal = basis.mT @ basis + torch.diag(moved.new_tensor(_BENDING))
    # A frame that nothing is near to stands still, for all that is known.
    normal[:, 1, 1] += 1e-9
    right_side = basis.mT @ (moved[around] - moved[at, None])
    return torch.linalg.solve(normal, right_side)[:, 1] / _HALF_WINDOW_S
