"""Leaps of positions, such as a receiver makes that takes other satellites, or comes out from under a bridge.

The car seems to be elsewhere from one frame to the next, and drives on from there.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.optim.robust import median_along
from crowdmap_torch.processes.sums import running_sum

_FASTEST_MPS = 70.0
"""Speed that no car exceeds."""
_HARDEST_MPS2 = 12.0
"""Acceleration that no car exceeds."""
_LEAST_M = 0.5
"""Shorter leaps are left where they are: drift goes as far within some frames."""
_OF_NOISE = 6.0
"""Times by which a leap stands out against what steps usually change by from one to the next, in the drive and there."""
_MOST_M = 15.0
"""Longer leaps are left where they are: positioning lost its way there, or two drives stand in one file."""
_TURNS_RADPS = 1.0
"""No car turns faster: where rotations do the drive does not go on behind a leap."""
_LOOKS_ON_RAD = 0.05
"""Noise of rotations from one frame to the next that is none."""
_MOST_OFTEN = 0.05
"""Where more steps leap positions are not those of each frame."""
_HALF_WINDOW = 3
"""Steps before and behind one whose median is how the car drives there."""
_NOISE_WINDOW = 8
"""Steps before and behind one whose changes say how noisy positions are there: between buildings they may be for seconds."""


def largest_leap(position: Float[Tensor, "f 3"], t_ns: Int[Tensor, " f"]) -> Float[Tensor, ""]:
    """The largest step [m] beyond what a car can drive; 0 if there is none."""
    found = _beyond_driving(position, t_ns)
    return found.max() if len(found) else found.sum()


def _beyond_driving(position: Float[Tensor, "f 3"], t_ns: Int[Tensor, " f"]) -> Float[Tensor, " g"]:
    """How much of each step [m] neither the steps before and behind it nor a car's brakes and tyres explain.

    By their times or by their lengths: times say why the step over a gap in the frames is long, lengths that a step is
    like the others whatever its times.
    """
    step = position.diff(dim=0)
    seconds = t_ns.diff().to(step) * 1e-9
    if len(step) < 2:
        return (step.norm(dim=1) - _FASTEST_MPS * seconds).clamp_min(0)
    by_time = _against_both(beyond_brakes(step, seconds)) * seconds
    return torch.minimum(by_time, _against_both(step.diff(dim=0).norm(dim=1)))


def beyond_brakes(step: Float[Tensor, "s 3"], seconds: Float[Tensor, " s"]) -> Float[Tensor, " c"]:
    """How much more the velocity changes from each step to the next than a car's brakes and tyres can do [m/s]."""
    # The speed of a step is that of its middle: from there to the next step's middle it may change.
    change = _HARDEST_MPS2 * (seconds[1:] + seconds[:-1]) / 2
    return ((step / seconds[:, None]).diff(dim=0).norm(dim=1) - change).clamp_min(0)


def _against_both(change: Float[Tensor, " f"]) -> Float[Tensor, " g"]:
    """The lesser of a step's changes from the step before and to the one behind it.

    A leap stands out against both of its neighbours, a car that pulls away after one does not.
    """
    none = change.new_full((1,), torch.inf)
    return torch.minimum(torch.cat((none, change)), torch.cat((change, none)))


def _goes_on(
    T_world_camera: Float[Tensor, "f 4 4"],
    t_ns: Int[Tensor, " f"],
    at: Int[Tensor, " l"],
    around: Float[Tensor, "l w 3"],
    usual: Float[Tensor, ""],
) -> Bool[Tensor, " l"]:
    """Whether a car looks and drives behind these steps as before, as far as the steps `around` each tell."""
    R = T_world_camera[:, :3, :3]
    seconds = t_ns.diff().to(R) * 1e-9
    turn = se3.so3_log(R[at].mT @ R[at + 1]).norm(dim=-1)
    before, behind = around[:, :_HALF_WINDOW], around[:, _HALF_WINDOW + 1 :]
    change = (median_along(behind, 1) - median_along(before, 1)).norm(dim=-1)
    # From the middle of those before to the middle of those behind.
    between = (_HALF_WINDOW + 1) * seconds[at]
    brakes = _HARDEST_MPS2 * seconds[at] * between
    return (turn < _LOOKS_ON_RAD + _TURNS_RADPS * seconds[at]) & (
        change < brakes + _OF_NOISE * usual
    )


def without_leaps(
    T_world_camera: Float[Tensor, "f 4 4"], t_ns: Int[Tensor, " f"]
) -> tuple[Float[Tensor, "f 4 4"], Float[Tensor, " l"]]:
    """The poses of a drive that goes on where its positions leap, and how far each leap was [m].

    Which side of a leap is nearer to where the car was nobody knows: the drive's mean stays where it is.
    """
    position = T_world_camera[:, :3, 3]
    step = position.diff(dim=0)
    if len(step) < 2 * _HALF_WINDOW:
        return T_world_camera, step.new_zeros(0)
    change = step.diff(dim=0).norm(dim=1)
    usual = median_along(change, 0)
    beyond = _beyond_driving(position, t_ns)
    at = torch.nonzero(beyond > (_OF_NOISE * usual).clamp_min(_LEAST_M))[:, 0]
    beside = torch.arange(2 * _NOISE_WINDOW, device=at.device)
    first = (at - _NOISE_WINDOW).clamp(0, max(len(change) - len(beside), 0))
    there = change[(first[:, None] + beside).clamp_max(len(change) - 1)]
    least = (_OF_NOISE * torch.maximum(usual, median_along(there, 1))).clamp_min(_LEAST_M)
    at, least = at[beyond[at] > least], least[beyond[at] > least]
    near = torch.arange(-_HALF_WINDOW, _HALF_WINDOW + 1, device=at.device)
    around = (at[:, None] + near).clamp(0, len(step) - 1)
    seconds = t_ns.diff().to(step) * 1e-9
    velocity = step[around] / seconds[around, None]
    by_time = step[at] - median_along(velocity, 1) * seconds[at, None]
    by_length = step[at] - median_along(step[around], 1)
    is_less = by_time.norm(dim=1) < by_length.norm(dim=1)
    leap = torch.where(is_less[:, None], by_time, by_length)
    length = leap.norm(dim=1)
    # Between steps of nothing a car may drive on to the next fix.
    moves = (step[around[:, _HALF_WINDOW - 1 : _HALF_WINDOW + 2]] != 0).any(-1).all(-1)
    goes_on = _goes_on(T_world_camera, t_ns, at, step[around], usual)
    is_taken = moves & goes_on & (length > least) & (length <= _MOST_M)
    if not 0 < int(is_taken.sum()) <= _MOST_OFTEN * len(step):
        return T_world_camera, length[:0]
    off = torch.zeros_like(position)
    off[at[is_taken] + 1] = leap[is_taken]
    off = running_sum(off)
    moved = position - (off - off.mean(0))
    return se3.make(T_world_camera[:, :3, :3], moved), length[is_taken]
