"""V-A.2, unlike the paper: how often lanes of the map are detected where drives see them, in what is usual of these drives.

What a detector takes for a marker now and then, beside one or on a seam of the road, adds up over many drives to a line
that all of them have seen. It is told from a marker by how seldom that is: by the detections of each drive for every metre
on which it has any there, beside those that the markers of its drive have.
"""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_sum
from crowdmap_torch.processes.sums import running_sum

_STRETCH_M = 4.0
_USUAL = 0.75
"""Of what a drive sees, by length, this share is detected less often than usual markers: much of it may be none."""


def how_often(
    curve: Int[Tensor, " s"],
    station: Float[Tensor, " s"],
    journey: Int[Tensor, " s"],
    detections: Float[Tensor, " s"],
    curves: int,
) -> Float[Tensor, " curves"]:
    """Detections of each curve, as a share of those that markers usually have where the same drives see as much of them.

    Of samples of the drives' pieces on curves: the `curve`, where on it [m], whose it is, and how many `detections` it
    stands for. One for curves of which there is no sample.
    """
    if not len(curve):
        return station.new_ones(curves)
    journeys = int(journey.max()) + 1
    seen, pair = torch.unique(curve * journeys + journey, return_inverse=True)
    metres = metres_seen(pair, station, len(seen))
    number = group_sum(detections, pair, len(seen))
    of_curve, of_journey = seen // journeys, seen % journeys
    usual = _weighted_quantile(number / metres, metres, of_journey, journeys)
    expected = group_sum(usual[of_journey] * metres, of_curve, curves)
    found = group_sum(number, of_curve, curves)
    return torch.where(expected > 0, found / expected, 1.0)


def metres_seen(
    group: Int[Tensor, " s"], station: Float[Tensor, " s"], groups: int
) -> Float[Tensor, " g"]:
    """Length of the stretches of a curve, of four metres, on which each group of its samples has any [m].

    Stretches, not samples: pieces overlap.
    """
    stretch = (station / _STRETCH_M).floor().long().clamp_min(0)
    stretches = int(stretch.max()) + 1 if len(stretch) else 1
    seen = torch.unique(group * stretches + stretch) // stretches
    return (_STRETCH_M * torch.bincount(seen, minlength=groups)).to(station)


def _weighted_quantile(
    value: Float[Tensor, " n"], weight: Float[Tensor, " n"], group: Int[Tensor, " n"], groups: int
) -> Float[Tensor, " g"]:
    """Of each group the least value that `_USUAL` of its weight does not exceed."""
    order = value.argsort(stable=True)
    order = order[group[order].argsort(stable=True)]
    value, weight, group = value[order], weight[order], group[order]
    total = group_sum(weight, group, groups)
    before = running_sum(weight) - (running_sum(total) - total)[group]
    reached = torch.where(before >= _USUAL * total[group] - 1e-9, value, torch.inf)
    return value.new_full((groups,), torch.inf).scatter_reduce(0, group, reached, "amin")
