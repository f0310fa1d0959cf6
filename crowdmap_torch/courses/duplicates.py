"""Courses that cover one another: the same marker twice, unless journeys saw both side by side."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from crowdmap_torch.clustering.groups import group_sum
from crowdmap_torch.clustering.lines import LineSamples
from crowdmap_torch.courses.curves import Curves, Match

_STRETCH = 10.0
"""Side by side means: both seen by one journey on the same ten metres."""
_CROSSING_REACH = 2.0
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
    flat = curves.point[:, :2].detach().cpu().numpy()
    found = KDTree(flat).query_pairs((gate**2 + 0.75**2) ** 0.5, output_type="ndarray")
    pair = torch.from_numpy(found.astype(np.int64)).to(device)
    pair = pair[curves.curve[pair[:, 0]] != curves.curve[pair[:, 1]]]
    i, j = torch.cat((pair, pair.flip(1))).T
    axis = curves.direction[i]
    delta = curves.point[j] - curves.point[i]
    beside = (axis[:, 0] * delta[:, 1] - axis[:, 1] * delta[:, 0]).abs()
    fits = (
        (beside < gate)
        & ((delta[:, :2] * axis).sum(1).abs() < 0.75)
        & ((curves.direction[j] * axis).sum(1).abs() > 0.94)
        & (delta[:, 2].abs() < height_gate)
    )
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
    flat = curves.point[:, :2].detach().cpu().numpy()
    found = KDTree(flat).query_pairs(_CROSSING_REACH, output_type="ndarray")
    pair = torch.from_numpy(found.astype(np.int64)).to(curves.point.device)
    i, j = torch.cat((pair, pair.flip(1))).T
    a, b = curves.curve[i], curves.curve[j]
    length = curves.length
    delta = curves.point[i] - curves.point[j]
    axis = curves.direction[j]
    along = delta[:, 0] * axis[:, 0] + delta[:, 1] * axis[:, 1]
    left = axis[:, 0] * delta[:, 1] - axis[:, 1] * delta[:, 0]
    near = (a != b) & (2 * length[a] <= length[b]) & (delta[:, 2].abs() < height_gate)
    near &= along.abs() < 0.75
    pairs, pair_of = torch.unique((a * n + b)[near], return_inverse=True)
    none = left.new_zeros(len(pairs))
    most = none.scatter_reduce(0, pair_of, left[near], "amax")
    least = none.scatter_reduce(0, pair_of, left[near], "amin")
    result = torch.zeros(n, dtype=torch.bool, device=pair.device)
    result[(pairs // n)[(most > _CROSSED) & (least < -_CROSSED)]] = True
    return result


def _support(curves: Curves, matched: Match, weight: Float[Tensor, " s"]) -> Float[Tensor, " k"]:
    """Weight of the samples at each point of the curves."""
    used = matched.curve >= 0
    return group_sum(weight[used], nearest_row(curves, matched)[used], len(curves.point))


def nearest_row(curves: Curves, matched: Match) -> Int[Tensor, " s"]:
    """The point of its curve that each matched sample is nearest to; -1 for the others."""
    if not len(curves):
        return torch.full_like(matched.curve, -1)
    far = float(curves.station.max()) + 10.0
    x = curves.station + curves.curve * far
    y = matched.station.clamp_min(0) + matched.curve.clamp_min(0) * far
    above = torch.searchsorted(x, y).clamp(1, max(len(x) - 1, 1))
    row = torch.where(y - x[above - 1] < x[above.clamp_max(len(x) - 1)] - y, above - 1, above)
    return torch.where(matched.curve >= 0, row, -1)


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
    key_b = curves.curve[i] * n + curves.curve[j]
    on_b = _journeys_at(j, key_b, stretch[i], row, owner, owners, stretches)
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
    overlap = torch.repeat_interleave(size)
    rank = torch.arange(len(overlap), device=row.device) - (size.cumsum(0) - size)[overlap]
    seen_by = owner[low[overlap] + rank]
    return torch.unique((key[overlap] * stretches + stretch[overlap]) * owners + seen_by)
