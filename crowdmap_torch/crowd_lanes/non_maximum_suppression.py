"""Non-maximum suppression of points on density ridges: one stands for all in its neighbourhood."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from crowdmap_torch.clustering.neighbours import pairs_in_radius
from crowdmap_torch.crowd_lanes.density_ridge import RidgePoints
from crowdmap_torch.crowd_lanes.line_samples import MAX_ANGLE_COS, along_axis, left_of_axis


def local_maxima(
    points: RidgePoints,
    *,
    along: float,
    sideways: float,
    beside_stronger: float,
    height_gate: float,
) -> Int[Tensor, " k"]:
    """Rows of points that represent all: the densest of each neighbourhood, which suppresses its neighbours.

    A neighbourhood reaches `along` and `sideways` [m]; a point that is less than a third as dense as a neighbour is
    noise of that neighbour's ridge up to `beside_stronger` beside it, unless their kinds differ.
    """
    n = len(points)
    device = points.point.device
    reach = (along**2 + max(sideways, beside_stronger) ** 2) ** 0.5
    flat = points.point[:, :2].detach().cpu().numpy()
    pair = pairs_in_radius(points.point[:, :2], reach)
    pair = torch.cat((pair, pair.flip(1)))
    # The order of the rows must not matter among equals more than it has to: denser first, then by place.
    strength = torch.empty(n, dtype=torch.int64, device=device)
    order = np.lexsort((flat[:, 1], flat[:, 0], points.density.detach().cpu().numpy()))
    strength[torch.from_numpy(order).to(device)] = torch.arange(n, device=device)
    i, j = pair.T
    delta = points.point[j] - points.point[i]
    axis = points.direction[i]
    is_parallel = along_axis(points.direction[j], axis).abs() > MAX_ANGLE_COS
    share = points.density[j] / points.density[i].clamp_min(1e-12)
    same_kind = (points.kind[i] == points.kind[j]) | (points.kind[i] < 0) | (points.kind[j] < 0)
    is_noise = share < torch.where(same_kind, 1 / 3, 0.1)
    limit = torch.where(is_noise, max(sideways, beside_stronger), sideways)
    hit = (
        is_parallel
        & (along_axis(delta, axis).abs() < along)
        & (left_of_axis(delta, axis).abs() < limit)
        & (delta[:, 2].abs() < height_gate)
        & (strength[i] > strength[j])
    )
    i, j = i[hit], j[hit]  # i suppresses j if i is kept
    state = torch.zeros(n, dtype=torch.int64, device=device)  # 0 open, 1 kept, 2 suppressed
    while True:
        threatened = torch.zeros(n, dtype=torch.bool, device=device)
        threatened[j[state[i] == 0]] = True
        kept = (state == 0) & ~threatened
        if not kept.any():
            break
        state[kept] = 1
        lost = j[state[i] == 1]
        state[lost[state[lost] == 0]] = 2
    return (state == 1).nonzero()[:, 0]
