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
from crowdmap_torch.geometry import se3
from crowdmap_torch.noise.bias_wander import LEAST_SHARE, WANDER_SHARE
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.optim.band_cholesky import cholesky_banded
from crowdmap_torch.optim.robust import Tukey
from crowdmap_torch.ranges import Rounds, Settings, Share, Sigma, Spacing
from crowdmap_torch.tables import Signs

METHODS = ("robust", "paper2017")

_CHI_SQUARE_MEDIAN = 2.366
"""Median squared length of a three-dimensional standard normal vector."""
_AT_REST_M = 1e-4
"""How far the bias of a drive wanders that is too short for it [m]."""
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


@dataclass(frozen=True)
class JourneyBias:
    """What each journey's poses have wrong, measured place minus true place, up to what all journeys share.

    At a place of a journey it is `translation + heading x (place - centroid) + drift(station)`. The station is the
    distance driven; the drift is linear between nodes, which are equally spaced, and constant outside them. On long drives
    part of it is how the bias wanders.
    """

    translation: Float[Tensor, "j 3"]
    """[m]"""
    heading: Float[Tensor, " j"]
    """About the up axis through the journey's centroid [rad]."""
    centroid: Float[Tensor, "j 3"]
    """Mean place of the journey's landmarks, as measured [m]."""
    covariance: Float[Tensor, "j 3 3"]
    """Of the translation, given the places of the clusters [m^2]."""
    shared_covariance: Float[Tensor, "3 3"]
    """Of what all journeys share and nobody can tell from them: that of the prior's mean [m^2]."""
    node_start: Int[Tensor, " j"]
    """First row of `node_drift` of each journey."""
    node_count: Int[Tensor, " j"]
    """Nodes of each journey, at least two."""
    node_origin: Float[Tensor, " j"]
    """Station of the first node [m]."""
    node_spacing: Float[Tensor, " j"]
    """Distance between nodes [m]."""
    node_drift: Float[Tensor, "k 3"]
    """Drift at the nodes [m]."""
    node_wander: Float[Tensor, "k 3"]
    """What of it is the bias's that wanders [m]; zero on drives that are too short for it."""

    def __len__(self) -> int:
        return len(self.heading)

    @property
    def journey_of_node(self) -> Int[Tensor, " k"]:
        """The journey that each node is on."""
        journey = torch.arange(len(self), device=self.node_count.device)
        return torch.repeat_interleave(journey, self.node_count)

    @property
    def node_station(self) -> Float[Tensor, " k"]:
        """Distance driven at each node [m]."""
        owner = self.journey_of_node
        rank = torch.arange(len(owner), device=owner.device) - self.node_start[owner]
        return self.node_origin[owner] + rank * self.node_spacing[owner]

    @property
    def length(self) -> Float[Tensor, " j"]:
        """Way from the first to the last node of each journey [m]."""
        return self.node_spacing * (self.node_count - 1)


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


def bias_at(
    bias: JourneyBias,
    journey: Int[Tensor, " n"],
    station: Float[Tensor, " n"],
    place: Float[Tensor, "n 3"],
) -> Float[Tensor, "n 3"]:
    """What is wrong with measured places [m]: subtract it from them."""
    node, along = _node_at(bias, journey, station)
    drift = torch.lerp(bias.node_drift[node], bias.node_drift[node + 1], along[:, None])
    lever = _lever(place - bias.centroid[journey])
    return bias.translation[journey] + bias.heading[journey, None] * lever + drift


def largest_drift(bias: JourneyBias) -> Float[Tensor, " j"]:
    """Length of the largest drift along each journey, about its bias wherever that wanders [m]."""
    length = (bias.node_drift - bias.node_wander).norm(dim=1)
    return length.new_zeros(len(bias)).scatter_reduce(0, bias.journey_of_node, length, "amax")


def unbiased_poses(
    T_world_camera: Float[Tensor, "f 4 4"],
    bias: JourneyBias,
    journey: int,
    station: Float[Tensor, " f"],
) -> Float[Tensor, "f 4 4"]:
    """The poses of one journey with its bias taken off: where bundle adjustment starts."""
    rows = torch.full_like(station, journey, dtype=torch.int64)
    position = T_world_camera[:, :3, 3]
    heading = bias.heading[journey]
    turn = se3.so3_exp(torch.stack((0 * heading, 0 * heading, -heading)))
    return se3.make(
        turn @ T_world_camera[:, :3, :3], position - bias_at(bias, rows, station, position)
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
    used = _in_shared_clusters(signs.journey, label)
    members, label, station = signs[used], label[used], station[used]
    covariance = members.covariance + config.noise_sigma_m**2 * torch.eye(3).to(station)
    information = torch.linalg.inv(covariance)
    if certainty is not None:
        sure = certainty[used].clamp_min(config.least_certainty)
        information = information * sure[:, None, None]
    # A journey without weight has no say in the places of the clusters, yet its own bias is found from them.
    say = weight[members.journey].clamp_min(1e-6)[:, None, None]
    component = _connected_journeys(members.journey, label, journeys)
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
        scale = (squared.median() / _CHI_SQUARE_MEDIAN).clamp_min(1)
        trust = Tukey().weight(squared / scale)
        trusted = information * trust.clamp_min(1e-4)[:, None, None]
        place = _places(corrected, say * trusted, label, clusters)
        before = bias
        bias = _bias_given_places(
            bias, members, station, place[label], trusted, bias_sigma, positioning
        )
        shift = group_sum(gauge * bias.translation, component, journeys)
        mean = shift / group_sum(gauge, component, journeys).clamp_min(1e-300)
        bias = replace(bias, translation=bias.translation - mean[component])
        if _largest_change(bias, before) < _STANDS_STILL_M:
            break
    return replace(bias, shared_covariance=shared)


def mean_differences(
    signs: Signs, label: Int[Tensor, " n"], station: Float[Tensor, " n"], start: JourneyBias
) -> JourneyBias:
    """The paper's bias of each journey (V-B): the mean difference of its reconstructions from everybody's mean.

    Everybody's mean of a cluster is that of its members with the biases of `start` taken off; those are zero where the
    paper is followed.
    """
    used = _in_shared_clusters(signs.journey, label)
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


def _bias_given_places(
    bias: JourneyBias,
    members: Signs,
    station: Float[Tensor, " n"],
    place: Float[Tensor, "n 3"],
    information: Float[Tensor, "n 3 3"],
    bias_sigma: Float[Tensor, "j 3"],
    positioning: PositioningNoise,
) -> JourneyBias:
    """Translation, heading and drift of all journeys at once, the places of the clusters given.

    The drift's nodes form a chain in each journey, with how the bias wanders beside the drift where there is a long one.
    They are eliminated by one banded solve over the nodes of all journeys (no entry couples two journeys); four unknowns a
    journey remain.
    """
    J, K = len(bias), len(bias.node_drift)
    journey = members.journey
    measured = members.center_world
    node, along = _node_at(bias, journey, station)
    lever = _lever(measured - bias.centroid[journey])
    eye = torch.eye(3).to(lever).expand(len(journey), 3, 3)
    B = torch.cat((eye, lever[..., None], (measured - place)[..., None]), dim=2)  # [n, 3, 4 + 1]
    WB = information @ B

    diagonal, below = _node_prior(bias, bias_sigma, positioning)
    parts = diagonal.shape[1] // 3
    # Whatever a node's state consists of, what is seen is its sum.
    of_sum = information.repeat(1, parts, parts)
    a, WB_sum = along[:, None, None], WB.repeat(1, parts, 1)
    diagonal = diagonal.index_add(0, node, (1 - a).square() * of_sum)
    diagonal = diagonal.index_add(0, node + 1, a.square() * of_sum)
    below = below.index_add(0, node, a * (1 - a) * of_sum)
    right = WB.new_zeros(K, 3 * parts, 5).index_add(0, node, (1 - a) * WB_sum)
    right = right.index_add(0, node + 1, a * WB_sum)
    solved = _solve_chain(diagonal, below, right)

    owner = bias.journey_of_node
    border = B[..., :4].mT @ WB
    schur = WB.new_zeros(J, 4, 5).index_add(0, journey, border)
    schur = schur.index_add(0, owner, -right[..., :4].mT @ solved)
    # What turns with the car leaves no mark on where it is kilometres ahead.
    short = (LEAST_SHARE * positioning.wander_length_m / bias.length).clamp_max(1)
    heading_sigma = positioning.bias_sigma_rad * short[:, None]
    prior = torch.diag_embed(torch.cat((bias_sigma, heading_sigma), dim=1).pow(-2))
    inverse = torch.linalg.inv(schur[..., :4] + prior)
    constant = (inverse @ schur[..., 4:])[..., 0]
    drift = solved[..., 4] - (solved[..., :4] @ constant[owner, :, None])[..., 0]
    drift, *wander = drift.split(3, dim=1)
    node_wander = wander[0] if wander else torch.zeros_like(drift)
    return replace(
        bias,
        translation=constant[:, :3],
        heading=constant[:, 3],
        covariance=inverse[:, :3, :3],
        node_drift=drift + node_wander,
        node_wander=node_wander,
    )


def _node_prior(
    bias: JourneyBias, bias_sigma: Float[Tensor, "j 3"], positioning: PositioningNoise
) -> tuple[Float[Tensor, "k s s"], Float[Tensor, "k s s"]]:
    """Information of the nodes' states: diagonal blocks, and those between a node and the next."""
    drift = torch.full_like(bias_sigma, positioning.drift_sigma_m)
    chains = [_chain_prior(bias, drift, positioning.drift_length_m)]
    is_long = bias.length >= LEAST_SHARE * positioning.wander_length_m
    if positioning.wander_sigma_m and bool(is_long.any()):
        # By how much it wanders shows in the adjustment: of what is known of the bias all but little may.
        sigma = torch.where(is_long[:, None], WANDER_SHARE**0.5 * bias_sigma, _AT_REST_M)
        chains.append(_chain_prior(bias, sigma, positioning.wander_length_m))
    diagonal, between = (torch.cat(part, dim=1) for part in zip(*chains, strict=True))
    return torch.diag_embed(diagonal), torch.diag_embed(between)


def _chain_prior(
    bias: JourneyBias, sigma: Float[Tensor, "j 3"], length_m: float
) -> tuple[Float[Tensor, "k 3"], Float[Tensor, "k 3"]]:
    """Information of an Ornstein-Uhlenbeck chain by axis: of every node, and between it and the next."""
    owner = bias.journey_of_node
    decay = torch.exp(-bias.node_spacing / length_m)[owner, None]
    variance = sigma[owner].square()
    step = 1 / (variance * (1 - decay.square()))
    rank = torch.arange(len(owner), device=owner.device) - bias.node_start[owner]
    is_first = (rank == 0)[:, None]
    is_last = (rank == bias.node_count[owner] - 1)[:, None]
    # A chain without its first step is stationary: sigma^-2 at the first node, decay^2 more where a step leaves a node.
    into = torch.where(is_first, 1 / variance, step)
    out = torch.where(is_last, 0.0, decay.square() * step)
    return into + out, torch.where(is_last, 0.0, -decay * step)


def _solve_chain(
    diagonal: Float[Tensor, "k s s"], below: Float[Tensor, "k s s"], right: Float[Tensor, "k s m"]
) -> Float[Tensor, "k s m"]:
    """Solution of a symmetric block-tridiagonal system; `below[k]` couples k and k + 1 and is symmetric."""
    K, s = diagonal.shape[:2]
    lower = diagonal.new_zeros(K, s, 2 * s)
    for column in range(s):
        lower[:, column, : s - column] = diagonal[:, column:, column]
        lower[:, column, s - column : 2 * s - column] = below[:, :, column]
    factor = cholesky_banded(lower.view(s * K, 2 * s))
    if factor is None:
        raise ArithmeticError("a chain of biases without a prior")
    return factor.solve(right.reshape(s * K, -1)).reshape(right.shape)


def _node_at(
    bias: JourneyBias, journey: Int[Tensor, " n"], station: Float[Tensor, " n"]
) -> tuple[Int[Tensor, " n"], Float[Tensor, " n"]]:
    """The node before each station, and how far along to the next it is, 0 to 1."""
    position = (station - bias.node_origin[journey]) / bias.node_spacing[journey]
    last = (bias.node_count[journey] - 2).to(position)
    rank = position.floor().clamp_min(0).minimum(last)
    return bias.node_start[journey] + rank.long(), (position - rank).clamp(0, 1)


def _lever(arm: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Displacement of a place per radian of heading: up x arm."""
    return torch.stack((-arm[:, 1], arm[:, 0], torch.zeros_like(arm[:, 0])), dim=1)


def _in_shared_clusters(journey: Int[Tensor, " n"], label: Int[Tensor, " n"]) -> Tensor:
    """True for members of clusters that two or more journeys are in; others say nothing about biases."""
    used = label >= 0
    groups = int(label.max()) + 1 if len(label) else 0
    owner, _, _ = distinct_pairs(label[used], journey[used])
    number = group_count(owner, max(groups, 1))
    return used & (number[label.clamp_min(0)] >= 2)


def _connected_journeys(
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
