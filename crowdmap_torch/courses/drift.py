"""The slow error of each journey's poses as the lane markers show it: how far beside the common courses it saw them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.courses.curves import Match, overlap
from crowdmap_torch.courses.samples import LaneSamples
from crowdmap_torch.optim.banded import solve_banded


@dataclass(frozen=True)
class DriftConfig:
    """How a journey's offset may change along it."""

    node_spacing_m: float = 40.0
    """Offsets are estimated this far apart, linear in between."""
    sigma_m: float = 0.25
    """1-sigma of the offset along each axis, a priori."""
    length_m: float = 150.0
    """Distance over which the offset forgets itself (Ornstein-Uhlenbeck)."""
    noise_m: float = 0.3
    """1-sigma of what one metre of one marker shows about the offset, neighbouring metres being alike."""
    scale_m: float = 0.5
    """Beyond this misfit a sample, and beyond twice `sigma_m` a journey's offset, is taken for an outlier's."""
    iterations: int = 4
    """Rounds of reweighting."""


def journey_offsets(
    samples: LaneSamples, matched: Match, config: DriftConfig
) -> Float[Tensor, "s 3"]:
    """How far from the curves the journey of each sample sees the markers there, for samples matched or not.

    Each journey's offset is a chain of nodes under an Ornstein-Uhlenbeck prior, seen across the matched curves
    (sideways and in height). Samples that do not fit the rest of their journey lose their say, and a journey far off is
    not held back.
    """
    line = samples.line
    journeys, journey_of = torch.unique(line.owner, return_inverse=True)
    n = len(journeys)
    low = line.point.new_full((n,), torch.inf)
    low = low.scatter_reduce(0, journey_of, samples.station, "amin")
    high = line.point.new_full((n,), -torch.inf)
    high = high.scatter_reduce(0, journey_of, samples.station, "amax")
    spans = ((high - low) / config.node_spacing_m).ceil().long().clamp_min(1)
    spacing = (high - low).clamp_min(1e-6) / spans
    first = (spans + 1).cumsum(0) - (spans + 1)
    nodes = int((spans + 1).sum())
    place = (samples.station - low[journey_of]) / spacing[journey_of]
    below = torch.minimum(place.floor().long(), spans[journey_of] - 1)
    share = place - below
    node = first[journey_of] + below

    used = (matched.curve >= 0).nonzero()[:, 0]
    a, u = node[used], share[used]
    normal, lateral, height = matched.normal[used], matched.lateral[used], matched.height[used]
    curves = int(matched.curve.max()) + 1 if len(used) else 1
    shared = overlap(line.owner[used], matched.curve[used], matched.station[used], curves)
    base = line.weight[used] * 4.0 / shared / config.noise_m**2  # a stretch is four metres
    base = base / (config.noise_m / 0.1)  # neighbouring stretches of a marker err alike
    up = torch.zeros_like(normal[:, :1])
    across = torch.cat((normal, up), dim=1)
    upward = torch.cat((torch.zeros_like(normal), up + 1), dim=1)
    rows = torch.cat(
        [
            torch.cat(((1 - u)[:, None] * axis, u[:, None] * axis), dim=1)
            for axis in (across, upward)
        ]
    )
    target = torch.cat((lateral, height))[:, None]

    owner_of_node = torch.repeat_interleave(torch.arange(n, device=a.device), spans + 1)
    inner = (owner_of_node[1:] == owner_of_node[:-1]).nonzero()[:, 0]
    keep = (-spacing[owner_of_node[inner]] / config.length_m).exp()
    innovation = config.sigma_m * (1 - keep.square()).sqrt()
    prior_rows, prior_start, prior_weight, prior_owner = [], [], [], []
    for axis in range(3):
        step = line.point.new_zeros(len(inner), 6)
        step[:, axis], step[:, axis + 3] = -keep, 1.0
        prior_rows.append(step)
        prior_start.append(3 * inner)
        prior_weight.append(1 / innovation.square())
        prior_owner.append(owner_of_node[inner])
        stay = line.point.new_zeros(n, 6)
        stay[:, axis] = 1.0
        prior_rows.append(stay)
        prior_start.append(3 * first)
        prior_weight.append(torch.full_like(low, 1 / config.sigma_m**2))
        prior_owner.append(torch.arange(n, device=a.device))
    prior_row, prior_start = torch.cat(prior_rows), torch.cat(prior_start)
    prior_weight, prior_owner = torch.cat(prior_weight), torch.cat(prior_owner)

    offset = line.point.new_zeros(nodes, 3)
    for _ in range(config.iterations):
        there = (1 - u)[:, None] * offset[a] + u[:, None] * offset[a + 1]
        misfit = torch.cat((lateral - (there * across).sum(1), height - there[:, 2]))
        trust = 1 / (1 + (misfit / config.scale_m).square()).square()
        # A journey that is far off as a whole is freed of the prior, so that it does not pull the others over.
        mean_square = offset.new_zeros(n).index_add(0, owner_of_node, offset.square().sum(1) / 3)
        mean_square = mean_square / (spans + 1)
        free = 1 / (1 + mean_square / (2 * config.sigma_m) ** 2)
        offset = solve_banded(
            torch.cat((3 * a, 3 * a, prior_start)),
            torch.cat((rows, prior_row)),
            torch.cat((target, target.new_zeros(len(prior_row), 1))),
            torch.cat((trust * torch.cat((base, base)), prior_weight * free[prior_owner])),
            3 * nodes,
        ).reshape(nodes, 3)
    return (1 - share)[:, None] * offset[node] + share[:, None] * offset[node + 1]
