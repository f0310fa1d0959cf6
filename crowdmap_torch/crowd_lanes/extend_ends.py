"""Lane curves extended as far as the samples go: ridges end early, and where a branch leaves its trunk."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import distinct_pairs, group_range
from crowdmap_torch.crowd_lanes.line_samples import LineSamples
from crowdmap_torch.crowd_lanes.splines import Curves, Match

_BIN = 1.0
"""Support is counted over stretches of this length [m]."""


def extended(curves: Curves, by: float) -> tuple[Float[Tensor, "m 3"], Int[Tensor, " m"]]:
    """The points of curves with straight ends of `by` [m] put on, a metre between points, and the curve of each.

    Rings, whose ends meet already, stay as they are.
    """
    n = len(curves)
    size = torch.bincount(curves.curve, minlength=n)
    first = size.cumsum(0) - size
    last = first + size - 1
    steps = torch.arange(1, int(by) + 1, device=size.device).to(curves.point)
    pieces = []
    for end, way in ((first, -steps.flip(0)), (last, steps)):
        along = torch.cat((curves.direction[end], curves.slope[end, None]), dim=1)
        pieces.append(curves.point[end][:, None] + way[:, None] * along[:, None])
    point = torch.cat((pieces[0].flatten(0, 1), curves.point, pieces[1].flatten(0, 1)))
    own = torch.arange(n, device=size.device).repeat_interleave(len(steps))
    curve = torch.cat((own, curves.curve, own))
    gap = (curves.point[first] - curves.point[last]).norm(dim=1)
    is_ring = (gap < 1.0) & (curves.length > 4 * by)
    is_new = torch.ones_like(curve, dtype=torch.bool)
    is_new[len(own) : len(own) + len(curves.curve)] = False
    rows = (~(is_new & is_ring[curve])).nonzero()[:, 0]
    rows = rows[curve[rows].argsort(stable=True)]
    return point[rows], curve[rows]


def supported_rows(
    curves: Curves, samples: LineSamples, matched: Match, min_owners: int
) -> Bool[Tensor, " k"]:
    """Points of curves from the first to the last place that at least `min_owners` owners saw."""
    used = (matched.curve >= 0) & samples.is_witness
    bins = int((curves.station / _BIN).max()) + 3 if len(curves.station) else 1
    at = (matched.station[used] / _BIN).floor().long() + 1
    # A sample stands for a stretch of its own: the bins beside its own are seen too.
    place = torch.cat([(at + k).clamp(0, bins - 1) for k in (-1, 0, 1)])
    place = place + matched.curve[used].repeat(3) * bins
    seen, _, _ = distinct_pairs(place, samples.owner[used].repeat(3))
    enough = torch.bincount(seen, minlength=len(curves) * bins) >= min_owners
    own = (curves.station / _BIN).floor().long() + 1
    is_seen = enough[curves.curve * bins + own]
    row = torch.arange(len(own), device=own.device)
    first, last = group_range(row[is_seen], curves.curve[is_seen], len(curves))
    is_between = (row >= first[curves.curve]) & (row <= last[curves.curve])
    return is_between & torch.isin(curves.curve, curves.curve[is_seen])
