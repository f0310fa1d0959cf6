"""V-B (sec:mj-landmark): the bias of each journey's poses, inferred from what all journeys saw."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from crowdmap_torch.clustering.groups import distinct_pairs, group_count, group_median, group_sum
from crowdmap_torch.crowd_signs.distance import mahalanobis
from crowdmap_torch.crowd_signs.journey_bias import BiasEquations, JourneyBias, bias_at
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.optim.robust import Tukey
from crowdmap_torch.ranges import Rounds, Settings, Share, Sigma, Spacing
from crowdmap_torch.tables import Signs

METHODS = ("robust", "paper2017")

_CHI_SQUARE_MEDIAN = 2.366
"""Median squared length of a three-dimensional standard normal vector."""
_STANDS_STILL_M = 1e-3
"""Alternation ends when no bias moves by more [m]."""


@dataclass(frozen=True)
class AlignConfig(Settings):
    """How what a journey's poses have wrong is found."""

    method: str = "robust"
    """`robust`: bias, heading and slow drift, outliers down-weighted. `paper2017`: mean differences, nothing else."""
    node_spacing_m: Spacing = 50.0
    """Distance between the places where the drift is estimated; linear in between [m]."""
    noise_sigma_m: Sigma = 0.08
    """What a sign's place has wrong beside its covariance, the bias and the drift: 1-sigma along each axis [m]."""
    least_certainty: Share = 0.05
    """Weight of signs that fit another cluster as well: they must not bend the drift towards a wrong one."""
    sweeps: Rounds = 6
    """Most alternations between journeys' biases and the places of clusters."""

    def __post_init__(self) -> None:
        """Refuses an unknown method."""
        super().__post_init__()
        if self.method not in METHODS:
            raise ValueError(f"method: expected one of {METHODS}, found {self.method!r}")


def no_bias(
    signs: Signs,
    station: Float[Tensor, " n"],
    positioning: PositioningNoise,
    config: AlignConfig,
    *,
    journeys: int,
) -> JourneyBias:
    """A bias of zero for each of `journeys` journeys, with nodes from the first to the last sign of each."""
    number = group_count(signs.journey, journeys)
    centroid = group_sum(signs.center_world, signs.journey, journeys) / number.clamp_min(1)[:, None]
    zero = station.new_zeros(journeys)
    low = zero.scatter_reduce(0, signs.journey, station, "amin", include_self=False)
    high = zero.scatter_reduce(0, signs.journey, station, "amax", include_self=False)
    length = (high - low).clamp_min(1.0)
    count = (length / config.node_spacing_m).ceil().long() + 1
    covariance = torch.diag_embed(station.new_tensor(positioning.bias_sigma_m).square())
    return JourneyBias(
        translation=station.new_zeros(journeys, 3),
        heading=zero,
        centroid=centroid,
        covariance=covariance.expand(journeys, 3, 3),
        shared_covariance=covariance,
        node_start=count.cumsum(0) - count,
        node_count=count,
        node_origin=low,
        node_spacing=length / (count - 1),
        node_drift=station.new_zeros(int(count.sum()), 3),
        node_wander=station.new_zeros(int(count.sum()), 3),
    )


def align_journeys(
    signs: Signs,
    label: Int[Tensor, " n"],
    station: Float[Tensor, " n"],
    positioning: PositioningNoise,
    config: AlignConfig,
    *,
    start: JourneyBias,
    bias_sigma: Float[Tensor, "j 3"] | None = None,
    journey_weight: Float[Tensor, " j"] | None = None,
    certainty: Float[Tensor, " n"] | None = None,
) -> JourneyBias:
    """The bias of each journey that brings its signs to the clusters they are in (V-B).

    `station` [m] is the distance driven to where each sign was closest; `start` the bias known so far; `bias_sigma` [m]
    its prior; `journey_weight` and the `certainty` of each sign being in the right cluster are 0 to 1. What all
    journeys share cannot be seen: the mean of the biases, weighted by their priors, is zero. Unlike the paper, the
    bias drifts along the journey and turns with it, and outliers have no say; `paper2017`: `mean_differences`.
    """
    journeys = len(start)
    if bias_sigma is None:
        bias_sigma = station.new_tensor(positioning.bias_sigma_m).expand(journeys, 3)
    weight = station.new_ones(journeys) if journey_weight is None else journey_weight
    gauge = (1e-6 + weight)[:, None] / bias_sigma.square()
    shared = torch.diag(1 / gauge.sum(0))
    if config.method == "paper2017":
        bias = mean_differences(signs, label, station, start)
        return replace(bias, shared_covariance=shared)
    used = in_shared_clusters(signs.journey, label)
    members, label, station = signs[used], label[used], station[used]
    covariance = members.covariance + config.noise_sigma_m**2 * torch.eye(3).to(station)
    information = torch.linalg.inv(covariance)
    if certainty is not None:
        sure = certainty[used].clamp_min(config.least_certainty)
        information = information * sure[:, None, None]
    # A journey without weight has no say in the places of the clusters, yet its own bias is found from them.
    say = weight[members.journey].clamp_min(1e-6)[:, None, None]
    component = connected_journeys(members.journey, label, journeys)
    clusters = int(label.max()) + 1 if len(label) else 0

    bias = start
    measured = members.center_world
    place = group_median(
        measured - bias_at(bias, members.journey, station, measured), label, clusters
    )
    for _ in range(config.sweeps):
        corrected = measured - bias_at(bias, members.journey, station, measured)
        squared = mahalanobis(corrected - place[label], covariance)
        # Before the biases are found everything misses: the scale starts wide and narrows by itself.
        scale = scale_of_misses(squared)
        trust = Tukey().weight(squared / scale)
        trusted = information * trust.clamp_min(1e-4)[:, None, None]
        place = _places(corrected, say * trusted, label, clusters)
        before = bias
        given = members, station, place[label], trusted, bias_sigma, positioning
        bias = BiasEquations.of(bias, *given).most_likely()
        shift = group_sum(gauge * bias.translation, component, journeys)
        mean = shift / group_sum(gauge, component, journeys).clamp_min(1e-300)
        bias = replace(bias, translation=bias.translation - mean[component])
        if _largest_change(bias, before) < _STANDS_STILL_M:
            break
    return replace(bias, shared_covariance=shared)


def scale_of_misses(squared: Float[Tensor, " n"]) -> Float[Tensor, ""]:
    """How far squared misses of places, in their standard deviations, are above what these say: 1 at least."""
    return (squared.median() / _CHI_SQUARE_MEDIAN).clamp_min(1)


def mean_differences(
    signs: Signs, label: Int[Tensor, " n"], station: Float[Tensor, " n"], start: JourneyBias
) -> JourneyBias:
    """The paper's bias of each journey (V-B): the mean difference of its reconstructions from everybody's mean.

    Everybody's mean of a cluster is that of its members with the biases of `start` taken off; those are zero where the
    paper is followed.
    """
    used = in_shared_clusters(signs.journey, label)
    members, label, station = signs[used], label[used], station[used]
    measured = members.center_world
    clusters = int(label.max()) + 1 if len(label) else 0
    total = group_sum(
        measured - bias_at(start, members.journey, station, measured), label, clusters
    )
    place = total / group_count(label, clusters).clamp_min(1)[:, None]
    difference = group_sum(measured - place[label], members.journey, len(start))
    number = group_count(members.journey, len(start)).clamp_min(1)
    return replace(start, translation=difference / number[:, None])


def _largest_change(bias: JourneyBias, before: JourneyBias) -> float:
    translation = (bias.translation - before.translation).abs().sum(1)
    drift = (bias.node_drift - before.node_drift).abs().sum(1)
    return float(torch.cat((translation, drift, drift.new_zeros(1))).amax())


def _places(
    corrected: Float[Tensor, "n 3"],
    information: Float[Tensor, "n 3 3"],
    label: Int[Tensor, " n"],
    clusters: int,
) -> Float[Tensor, "c 3"]:
    total = group_sum(information, label, clusters)
    right = group_sum((information @ corrected[..., None])[..., 0], label, clusters)
    empty = group_count(label, clusters) == 0
    total[empty] = torch.eye(3).to(total)
    return torch.linalg.solve(total, right)


def in_shared_clusters(journey: Int[Tensor, " n"], label: Int[Tensor, " n"]) -> Tensor:
    """True for members of clusters that two or more journeys are in; others say nothing about biases."""
    used = label >= 0
    groups = int(label.max()) + 1 if len(label) else 0
    owner, _, _ = distinct_pairs(label[used], journey[used])
    number = group_count(owner, max(groups, 1))
    return used & (number[label.clamp_min(0)] >= 2)


def connected_journeys(
    journey: Int[Tensor, " n"], label: Int[Tensor, " n"], journeys: int
) -> Int[Tensor, " j"]:
    """Component of each journey in the graph that joins journeys with the clusters they are in."""
    clusters = int(label.max()) + 1 if len(label) else 0
    i, j = journey.cpu().numpy(), journeys + label.cpu().numpy()
    size = journeys + clusters
    graph = sparse.coo_matrix((np.ones(len(i)), (i, j)), shape=(size, size))
    _, component = connected_components(graph, directed=False)
    _, compact = np.unique(component[:journeys], return_inverse=True)
    return torch.from_numpy(compact.astype(np.int64)).to(journey.device)
