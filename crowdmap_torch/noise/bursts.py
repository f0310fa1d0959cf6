"""Bursts of noise: positions that jump to and fro from frame to frame for some seconds, as between tall buildings.

The car drives on as cars do, and all frames together tell where: positions meanwhile are those of the likeliest drive whose
jerk is white noise.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.noise.leaps import beyond_brakes
from crowdmap_torch.optim.banded_least_squares import solve_banded
from crowdmap_torch.optim.robust import median_along
from crowdmap_torch.processes.sums import running_sum

_LEAST_M = 0.1
"""Where steps change by less beyond what cars do, from one to the next, positions are as they are: noise as everywhere."""
_OF_USUAL = 6.0
"""Times by which they change more than they usually do."""
_HALF_WINDOW = 8
"""Steps before and behind one over which noise is told."""
_MOST_SHARE = 0.25
"""Where more frames are noisy the whole drive is."""
_CHANGE_OF_NOISE = 3.9
"""How much steps change from one to the next, in the mean, per standard deviation of white noise along each axis."""
_SURE_M = 0.005
"""1-sigma of positions elsewhere, beside what their noise is."""
_JERK = 2.0
"""Root of the spectral density of a car's jerk [m / s^2.5]."""
_AT_ONCE_S = 0.005
"""Frames closer together than this are taken to be so far apart."""


def _noise(
    step: Float[Tensor, "s 3"], t_ns: Int[Tensor, " f"], usual: Float[Tensor, ""]
) -> Float[Tensor, " f"]:
    """1-sigma of positions along each axis [m] where they jump as no car does and far more than is `usual`, else zero."""
    noise = step.new_zeros(len(t_ns))
    seconds = t_ns.diff().to(step) * 1e-9
    beyond = beyond_brakes(step, seconds) * (seconds[1:] + seconds[:-1]) / 2
    there = median_along(beyond.unfold(0, 2 * _HALF_WINDOW + 1, 1), 1)
    there = _wider(torch.where(there > (_OF_USUAL * usual).clamp_min(_LEAST_M), there, 0))
    # Where noise begins and ends few of a window are noisy.
    noise[1:-1] = _wider(there).unfold(0, 2 * _HALF_WINDOW + 1, 1).amax(1) / _CHANGE_OF_NOISE
    return noise if float((noise > 0).float().mean()) <= _MOST_SHARE else torch.zeros_like(noise)


def _wider(each: Float[Tensor, " n"]) -> Float[Tensor, " w"]:
    """Each, the first and the last for half a window before and behind."""
    first, last = each[:1].expand(_HALF_WINDOW), each[-1:].expand(_HALF_WINDOW)
    return torch.cat((first, each, last))


def without_bursts(
    T: Float[Tensor, "f 4 4"], t_ns: Int[Tensor, " f"]
) -> tuple[Float[Tensor, "f 4 4"], int]:
    """The poses of a drive with smooth positions where they are noisy for a while, and in how many frames they were."""
    position = T[:, :3, 3]
    step = position.diff(dim=0)
    if len(step) <= 2 * _HALF_WINDOW + 1:
        return T, 0
    usual = median_along(step.diff(dim=0).norm(dim=1), 0)
    noise = _noise(step, t_ns, usual)
    noisy = noise > 0
    if not bool(noisy.any()):
        return T, 0
    sigma = torch.maximum(noise, usual / _CHANGE_OF_NOISE + _SURE_M)
    t = running_sum((t_ns.diff().to(T) * 1e-9).clamp_min(_AT_ONCE_S))
    t = torch.cat((torch.zeros_like(t[:1]), t))
    at = torch.stack([t[k : len(t) - 3 + k] for k in range(4)], dim=1)
    jerk = 6 / (at[:, :, None] - at[:, None] + torch.eye(4).to(at)).prod(2)
    seen = torch.zeros(len(t), 4).to(T)
    seen[:, 0] = 1
    every = torch.arange(len(t), device=T.device)
    smooth = solve_banded(
        torch.cat((every, every[:-3])),
        torch.cat((seen, jerk)),
        torch.cat((position - position[0], torch.zeros_like(position[3:]))),
        torch.cat((1 / sigma.square(), (at[:, 3] - at[:, 0]) / (3 * _JERK**2))),
        len(t),
    )
    moved = torch.where(noisy[:, None], smooth + position[0], position)
    return se3.make(T[:, :3, :3], moved), int(noisy.sum())
