"""Where long drives are cut, and which drives are adjusted together.

All are cut at the same places, so that what lies within a square is bound to little else.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.processes.sums import running_sum

_OVER = 0.1
"""Share of a square's width that a drive goes beyond it before it has left: along a border it is not cut to pieces."""
_ROAD_M = 50.0
"""Width of the squares by which the length of the roads driven is told."""
_WHOLE = 2.0
"""Maps of at most so many times the unknowns of a square are not cut."""
_LEAST = 100
"""Unknowns of the landmarks in a square from which it is not halved any more."""
_JOINTS = 0.5
"""Unknowns at the cuts, at most, as a share of those of all landmarks: squares are halved as long as there are no more."""


def cut_drives(
    position: Float[Tensor, "n 2"],
    journey: Int[Tensor, " n"],
    unknowns: int,
    in_square: int,
    *,
    at_cut: int,
) -> Int[Tensor, " s"]:
    """The nodes that drives are cut before, where the landmarks of a square have at most about `in_square` unknowns.

    `unknowns` are those of all landmarks along the roads that the nodes are on, `at_cut` those of one cut. What lies in a
    square is bound to all else in it, and what is cut to the cuts: where few drives pass, squares are small.
    """
    if not in_square or unknowns <= _WHOLE * in_square or not len(position):
        return journey[:0]
    way_m = len(torch.unique((position / _ROAD_M).floor(), dim=0)) * _ROAD_M
    share = in_square / unknowns
    found = cut_at_squares(position, journey, share * way_m)
    while share * unknowns >= 2 * _LEAST:
        share /= 2
        finer = cut_at_squares(position, journey, share * way_m)
        if len(finer) * at_cut > _JOINTS * unknowns:
            break
        found = finer
    return found


def cut_at_squares(
    position: Float[Tensor, "n 2"], journey: Int[Tensor, " n"], width_m: float
) -> Int[Tensor, " s"]:
    """The nodes at which drives leave one of the squares of this width; journeys one by one, in order."""
    square = (position / width_m).floor()
    ends = torch.nonzero(journey[1:] != journey[:-1])[:, 0] + 1
    found, start = [], 0
    for stop in [*ends.tolist(), len(journey)]:
        at = start
        while at < stop:
            beyond = position[at:stop] / width_m - square[at]
            outside = ((beyond < -_OVER) | (beyond > 1 + _OVER)).any(1)
            if not bool(outside.any()):
                break
            gone = int(outside.long().argmax())
            # Where it crossed the border for good: those who come the other way are cut there as well.
            within = ((beyond[:gone] >= 0) & (beyond[:gone] < 1)).all(1)
            found.append(at + int(torch.nonzero(within)[-1]) + 1)
            at += gone
        start = stop
    return torch.tensor(found, dtype=torch.long, device=position.device)


def convoys(
    journey: Int[Tensor, " n"], way: Float[Tensor, " n"], journeys: int, at_least_m: float
) -> list[tuple[int, int]]:
    """The first drive of every convoy and the one behind its last; one convoy where the way is not worth two.

    Drives are `journeys` one behind the other, with nodes of which each has the `way` driven to it. A convoy drives so
    much or more, but for what drives are longer than others. They are an even number: all wait for the host that has most.
    """
    driven = way.new_zeros(journeys).scatter_reduce(0, journey, way, "amax")
    total = float(driven.sum())
    count = min(int(total / at_least_m), journeys) if at_least_m else 1
    if count < 2:
        return [(0, journeys)]
    count -= count % 2
    of = ((running_sum(driven) - driven / 2) / total * count).long().clamp_max(count - 1)
    first = [0, *(torch.nonzero(of.diff())[:, 0] + 1).tolist(), journeys]
    return list(pairwise(first))
