"""Poses that freeze: positioning is lost for a moment, says the last it knew, and is then where the car is again."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.optim.robust import median_along

_LEAST_M = 0.5
"""Behind a freeze the car is as far away at least."""
_FACTOR = 2.0
"""Factor, either way, by which the car may have driven otherwise meanwhile than before and behind."""
_MOST_SHARE = 0.25
"""Where more frames are frozen poses are not those of each frame, or the drive is not to be trusted."""
_AROUND = 3
"""Steps before and behind a freeze whose median is how fast the car was."""


def frozen_frames(T: Float[Tensor, "f 4 4"], t_ns: Int[Tensor, " f"]) -> Bool[Tensor, " f"]:
    """Frames of a car that drives on while its position stays the same to the last digit; none where those are many."""
    position = T[:, :3, 3]
    none = torch.zeros(len(position), dtype=torch.bool, device=position.device)
    step = position.diff(dim=0).norm(dim=1)
    moves = torch.nonzero(step != 0)[:, 0]
    # Frozen are the frames between two steps that are none, from behind the first to the second's beginning.
    before, behind = moves[:-1], moves[1:]
    lasts = behind > before + 1
    before, behind = before[lasts], behind[lasts]
    if not len(before) or len(step) < 2 * _AROUND:
        return none
    seconds = t_ns.diff().to(step) * 1e-9
    speed = step / seconds
    near = torch.arange(_AROUND, device=step.device)
    around = torch.stack((before[:, None] - near, behind[:, None] + 1 + near))
    around = median_along(speed[around.clamp(0, len(step) - 1)], -1)
    meanwhile = step[behind] / ((t_ns[behind + 1] - t_ns[before + 1]).to(step) * 1e-9)
    drives = (meanwhile > around.amin(0) / _FACTOR) & (meanwhile < around.amax(0) * _FACTOR)
    drives &= step[behind] > _LEAST_M
    change = torch.zeros(len(position) + 1, dtype=torch.long, device=step.device)
    change[before[drives] + 2] = 1
    change[behind[drives] + 1] = -1
    frozen = change.cumsum(0)[:-1] > 0
    return frozen if int(frozen.sum()) <= _MOST_SHARE * len(frozen) else none


def driven_on(
    T: Float[Tensor, "f 4 4"], t_ns: Int[Tensor, " f"], frozen: Bool[Tensor, " f"]
) -> Float[Tensor, "f 4 4"]:
    """The poses with those that are `frozen` between the ones before and behind, evenly; rotations that go on stay."""
    row = torch.nonzero(frozen)[:, 0]
    known = torch.nonzero(~frozen)[:, 0]
    place = torch.searchsorted(known, row)
    before, behind = known[place - 1], known[place]
    share = ((t_ns[row] - t_ns[before]).to(T) / (t_ns[behind] - t_ns[before]).to(T))[:, None]
    p, R = T[:, :3, 3], T[:, :3, :3]
    between = R[before] @ se3.so3_exp(share * se3.so3_log(R[before].mT @ R[behind]))
    is_frozen = (R[row] == R[before]).all(-1).all(-1)
    result = T.clone()
    result[row, :3, 3] = p[before] + share * (p[behind] - p[before])
    result[row, :3, :3] = torch.where(is_frozen[:, None, None], between, R[row])
    return result
