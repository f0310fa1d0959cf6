"""Lane curves that cover one another: the same marker twice, unless journeys saw both side by side."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_range, group_sum, rows_of_ranges
from crowdmap_torch.clustering.neighbours import pairs_in_radius
from crowdmap_torch.crowd_lanes.line_samples import (
    LineSamples,
    along_axis,
    left_of_axis,
    runs_along,
)
from crowdmap_torch.crowd_lanes.splines import Curves, Match, nearest_row

_STRETCH = 10.0
"""Side by side means: both seen by one journey on the same ten metres."""
_ALONG = 0.75
"""Points of curves no farther than this along one of them are side by side [m]."""
_CROSSING_REACH = 2.0
"""How far beside a curve points of another are compared with it [m]."""
_CROSSED = 0.4
"""How far a curve must be on both sides of another to cross it [m]."""
_END = 3.0
"""How near to its end a curve ends [m]."""


def covered_twice(
    curves: Curves,
    samples: LineSamples,
    matched: Match,
    *,
    gate: float,
    min_seen_together: float,
    height_gate: float = 2.0,
) -> Bool[Tensor, " k"]:
    """Points of curves that another curve covers, within `gate` [m] sideways, and that end there or have less support.

    Two curves that at least the share `min_seen_together` of the journeys on the lesser one saw at once are two
    markers.
    """
    k = len(curves.point)
    device = curves.point.device
    dropped = torch.zeros(k, dtype=torch.bool, device=device)
    pair = pairs_in_radius(curves.point[:, :2], (gate**2 + _ALONG**2) ** 0.5)
    pair = pair[curves.curve[pair[:, 0]] != curves.curve[pair[:, 1]]]
    i, j = torch.cat((pair, pair.flip(1))).T
    axis, other = curves.direction[i], curves.direction[j]
    delta = curves.point[j] - curves.point[i]
    fits = runs_along(delta, axis, other, within=gate, along=_ALONG, height=height_gate)
    i, j = i[fits], j[fits]
    if not len(i):
        return dropped
    support = _support(curves, matched, samples.weight)
    n = len(curves)
    a, b = curves.curve[i], curves.curve[j]
    pairs, pair_of = torch.unique(a * n + b, return_inverse=True)
    own = group_sum(support[i], pair_of, len(pairs))
    # The same overlap seen from the other curve.
    mirrored = torch.searchsorted(pairs, (pairs % n) * n + pairs // n).clamp_max(len(pairs) - 1)
    other = own[mirrored]
    together = _seen_together(curves, samples, matched, i, j, pairs)
    # A branch that ends beside a trunk gives way, whichever is seen by more.
    at_end = (curves.station < _END) | (curves.station > curves.length[curves.curve] - _END)
    ends = torch.zeros_like(own, dtype=torch.bool)
    ends[pair_of[at_end[i]]] = True
    other_ends = ends[mirrored]
    weaker = (own < other) | ((own == other) & (pairs // n > pairs % n))
    lesser = torch.where(ends == other_ends, weaker, ends)
    lost = lesser & (together < min_seen_together)
    dropped[i[lost[pair_of]]] = True
    return dropped


def crosses_longer(curves: Curves, *, height_gate: float = 2.0) -> Bool[Tensor, " n"]:
    """Curves that pass from one side of a curve twice as long to the other: paint does not, strayed pieces do."""
    n = len(curves)
    pair = pairs_in_radius(curves.point[:, :2], _CROSSING_REACH)
    i, j = torch.cat((pair, pair.flip(1))).T
    a, b = curves.curve[i], curves.curve[j]
    length = curves.length
    delta = curves.point[i] - curves.point[j]
    axis = curves.direction[j]
    left = left_of_axis(delta, axis)
    near = (a != b) & (2 * length[a] <= length[b]) & (delta[:, 2].abs() < height_gate)
    near &= along_axis(delta, axis).abs() < _ALONG
    pairs, pair_of = torch.unique((a * n + b)[near], return_inverse=True)
    least, most = group_range(left[near], pair_of, len(pairs))
    result = torch.zeros(n, dtype=torch.bool, device=pair.device)
    result[(pairs // n)[(most > _CROSSED) & (least < -_CROSSED)]] = True
    return result


def _support(curves: Curves, matched: Match, weight: Float[Tensor, " s"]) -> Float[Tensor, " k"]:
    """Weight of the samples at each point of the curves."""
    used = matched.curve >= 0
    return group_sum(weight[used], nearest_row(curves, matched)[used], len(curves.point))


def _seen_together(
    curves: Curves,
    samples: LineSamples,
    matched: Match,
    i: Int[Tensor, " p"],
    j: Int[Tensor, " p"],
    pairs: Int[Tensor, " q"],
) -> Float[Tensor, " q"]:
    """For each pair of curves (a, b): of the stretches on which journeys saw a beside b, where they saw b too."""
    n = len(curves)
    owners = int(samples.owner.max()) + 1
    used = matched.curve >= 0
    row, owner = nearest_row(curves, matched)[used], samples.owner[used]
    stretch = (curves.station / _STRETCH).floor().long()
    stretches = int(stretch.max()) + 1
    # Where on a the place of each point is: for points of a themselves, and for those of b beside them.
    key = curves.curve[i] * n + curves.curve[j]
    on_a = _journeys_at(i, key, stretch[i], row, owner, owners, stretches)
    on_b = _journeys_at(j, key, stretch[i], row, owner, owners, stretches)
    both = on_a[torch.isin(on_a, on_b)]
    size = owners * stretches
    seen = torch.bincount(torch.searchsorted(pairs, on_a // size), minlength=len(pairs))
    shared = torch.bincount(torch.searchsorted(pairs, both // size), minlength=len(pairs))
    return shared / seen.clamp_min(1)


def _journeys_at(
    point: Int[Tensor, " p"],
    key: Int[Tensor, " p"],
    stretch: Int[Tensor, " p"],
    row: Int[Tensor, " s"],
    owner: Int[Tensor, " s"],
    owners: int,
    stretches: int,
) -> Int[Tensor, " u"]:
    """Unique (pair, stretch, owner) of samples at points that stand in a list of overlaps, one sorted number each."""
    order = row.argsort(stable=True)
    row, owner = row[order], owner[order]
    low = torch.searchsorted(row, point)
    size = torch.searchsorted(row, point, right=True) - low
    overlap, at = rows_of_ranges(low, size)
    return torch.unique((key[overlap] * stretches + stretch[overlap]) * owners + owner[at])
