"""The slow error of each journey's poses as the lane markers show it: how far beside the common curves it saw them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import group_range
from crowdmap_torch.crowd_lanes.samples import LaneSamples
from crowdmap_torch.crowd_lanes.splines import Match, overlap
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.optim.banded_least_squares import solve_banded
from crowdmap_torch.ranges import Length, Rounds, Settings, Spacing


@dataclass(frozen=True)
class LateralOffsetConfig(Settings):
    """How a journey's offset may change along it."""

    node_spacing_m: Spacing = 40.0
    """Offsets are estimated this far apart, linear in between."""
    noise_m: Length = 0.3
    """1-sigma of what one metre of one marker shows about the offset, neighbouring metres being alike."""
    scale_m: Length = 0.5
    """Beyond this misfit a sample, and beyond twice the drift's sigma a journey's offset, is taken for an outlier's."""
    iterations: Rounds = 4
    """Rounds of reweighting."""


def journey_offsets(
    samples: LaneSamples, matched: Match, positioning: PositioningNoise, config: LateralOffsetConfig
) -> Float[Tensor, "s 3"]:
    """How far from the curves the journey of each sample sees the markers there, for samples matched or not.

    Each journey's offset is linear between nodes under an Ornstein-Uhlenbeck prior, seen across the matched curves
    (sideways and in height). Samples that do not fit the rest of their journey lose their say, and a journey far off is
    not held back.
    """
    line, nodes = samples.line, _lay_nodes(samples, config)
    used = (matched.curve >= 0).nonzero()[:, 0]
    a, u = nodes.below[used], nodes.share[used]
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
    prior_start, prior_row, prior_weight, prior_journey = _prior(nodes, positioning)

    n, count = len(nodes.spans), len(nodes.journey)
    offset = line.point.new_zeros(count, 3)
    for _ in range(config.iterations):
        there = (1 - u)[:, None] * offset[a] + u[:, None] * offset[a + 1]
        misfit = torch.cat((lateral - (there * across).sum(1), height - there[:, 2]))
        trust = 1 / (1 + (misfit / config.scale_m).square()).square()
        # A journey that is far off as a whole is freed of the prior, so that it does not pull the others over.
        mean_square = offset.new_zeros(n).index_add(0, nodes.journey, offset.square().sum(1) / 3)
        mean_square = mean_square / (nodes.spans + 1)
        free = 1 / (1 + mean_square / (2 * positioning.drift_sigma_m) ** 2)
        offset = solve_banded(
            torch.cat((3 * a, 3 * a, prior_start)),
            torch.cat((rows, prior_row)),
            torch.cat((target, target.new_zeros(len(prior_row), 1))),
            torch.cat((trust * torch.cat((base, base)), prior_weight * free[prior_journey])),
            3 * count,
        ).reshape(count, 3)
    share = nodes.share[:, None]
    return (1 - share) * offset[nodes.below] + share * offset[nodes.below + 1]


@dataclass(frozen=True)
class _Nodes:
    """Nodes of the offsets, those of one journey adjacent, and between which of them samples lie."""

    spans: Int[Tensor, " j"]
    """Of each journey one less than it has nodes."""
    spacing: Float[Tensor, " j"]
    journey: Int[Tensor, " n"]
    below: Int[Tensor, " s"]
    """The node before each sample."""
    share: Float[Tensor, " s"]
    """Of the way from that node to the next at which the sample lies."""


def _lay_nodes(samples: LaneSamples, config: LateralOffsetConfig) -> _Nodes:
    """Nodes at equal distances from the first to the last sample of each journey."""
    journeys, journey_of = torch.unique(samples.line.owner, return_inverse=True)
    n = len(journeys)
    low, high = group_range(samples.station, journey_of, n)
    spans = ((high - low) / config.node_spacing_m).ceil().long().clamp_min(1)
    spacing = (high - low).clamp_min(1e-6) / spans
    first = (spans + 1).cumsum(0) - (spans + 1)
    place = (samples.station - low[journey_of]) / spacing[journey_of]
    below = torch.minimum(place.floor().long(), spans[journey_of] - 1)
    journey = torch.repeat_interleave(torch.arange(n, device=spans.device), spans + 1)
    return _Nodes(spans, spacing, journey, first[journey_of] + below, place - below)


def _prior(
    nodes: _Nodes, positioning: PositioningNoise
) -> tuple[Int[Tensor, " p"], Float[Tensor, "p 6"], Float[Tensor, " p"], Int[Tensor, " p"]]:
    """Equations that draw offsets to those of the node before and to zero: start, row, weight and journey of each."""
    journey, n = nodes.journey, len(nodes.spans)
    inner = (journey[1:] == journey[:-1]).nonzero()[:, 0]
    keep = (-nodes.spacing[journey[inner]] / positioning.drift_length_m).exp()
    innovation = positioning.drift_sigma_m * (1 - keep.square()).sqrt()
    first = (nodes.spans + 1).cumsum(0) - (nodes.spans + 1)
    equations = []
    for axis in range(3):
        step = keep.new_zeros(len(inner), 6)
        step[:, axis], step[:, axis + 3] = -keep, 1.0
        equations.append((3 * inner, step, 1 / innovation.square(), journey[inner]))
        stay = keep.new_zeros(n, 6)
        stay[:, axis] = 1.0
        weight = keep.new_full((n,), 1 / positioning.drift_sigma_m**2)
        equations.append((3 * first, stay, weight, torch.arange(n, device=inner.device)))
    start, row, weight, owner = (torch.cat(column) for column in zip(*equations, strict=True))
    return start, row, weight, owner
