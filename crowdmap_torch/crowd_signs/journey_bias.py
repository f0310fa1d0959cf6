"""What each journey's poses have wrong, and how it follows from where clusters are: V-B (sec:mj-landmark) with a drift.

The drift's nodes form a chain in each journey. They are eliminated by one banded solve over the nodes of all journeys; bias
and heading of each remain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.trajectory import station
from crowdmap_torch.noise.bias_wander import LEAST_SHARE, WANDER_SHARE
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.optim.band_cholesky import BandFactor, cholesky_banded
from crowdmap_torch.tables import Signs

_AT_REST_M = 1e-4
"""How far the bias of a drive wanders that is too short for it [m]."""


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


def without_bias(
    given: Sequence[Float[Tensor, "_ 4 4"]], bias: JourneyBias
) -> tuple[list[Float[Tensor, "_ 4 4"]], tuple[Float[Tensor, "_ 6"], ...]]:
    """The `unbiased_poses` of all journeys, and the tangents that lead to them from those given."""
    poses = [unbiased_poses(T, bias, number, station(T)) for number, T in enumerate(given)]
    return poses, tuple(se3.local(T, start) for T, start in zip(given, poses, strict=True))


@dataclass(frozen=True)
class BiasEquations:
    """What signs say of all that journeys' poses have wrong, the places of their clusters given; drifts are eliminated.

    The last column is the right-hand side.
    """

    bias: JourneyBias
    """Where the drives' nodes are; what it knows of their biases is of no account."""
    schur: Float[Tensor, "j 5 5"]
    """Of translation and heading, with the prior in its first four rows."""
    prior: Float[Tensor, "j 4"]
    """Information on them."""
    solved: Float[Tensor, "k s 5"]
    """The nodes' own equations solved for those columns."""
    chain: BandFactor
    """Of the nodes' equations."""
    node_prior: tuple[Float[Tensor, "k s s"], Float[Tensor, "k s s"]]
    """Information on the nodes: diagonal blocks, and those between a node and the next."""

    @classmethod
    def of(
        cls,
        bias: JourneyBias,
        members: Signs,
        station: Float[Tensor, " n"],
        place: Float[Tensor, "n 3"],
        information: Float[Tensor, "n 3 3"],
        bias_sigma: Float[Tensor, "j 3"],
        positioning: PositioningNoise,
    ) -> BiasEquations:
        """Of all journeys at once: no entry couples two. How biases wander is beside the drift where one does."""
        J, K = len(bias), len(bias.node_drift)
        journey = members.journey
        measured = members.center_world
        node, along = _node_at(bias, journey, station)
        lever = _lever(measured - bias.centroid[journey])
        eye = torch.eye(3).to(lever).expand(len(journey), 3, 3)
        B = torch.cat(
            (eye, lever[..., None], (measured - place)[..., None]), dim=2
        )  # [n, 3, 4 + 1]
        WB = information @ B

        node_prior = diagonal, below = _node_prior(bias, bias_sigma, positioning)
        parts = diagonal.shape[1] // 3
        # Whatever a node's state consists of, what is seen is its sum.
        of_sum = information.repeat(1, parts, parts)
        a, WB_sum = along[:, None, None], WB.repeat(1, parts, 1)
        diagonal = diagonal.index_add(0, node, (1 - a).square() * of_sum)
        diagonal = diagonal.index_add(0, node + 1, a.square() * of_sum)
        below = below.index_add(0, node, a * (1 - a) * of_sum)
        right = WB.new_zeros(K, 3 * parts, 5).index_add(0, node, (1 - a) * WB_sum)
        right = right.index_add(0, node + 1, a * WB_sum)
        chain = _solver(diagonal, below)
        solved = chain.solve(right.reshape(3 * parts * K, -1)).reshape(right.shape)

        schur = WB.new_zeros(J, 5, 5).index_add(0, journey, B.mT @ WB)
        schur = schur.index_add(0, bias.journey_of_node, -right.mT @ solved)
        # What turns with the car leaves no mark on where it is kilometres ahead.
        short = (LEAST_SHARE * positioning.wander_length_m / bias.length).clamp_max(1)
        heading_sigma = positioning.bias_sigma_rad * short[:, None]
        prior = torch.cat((bias_sigma, heading_sigma), dim=1).pow(-2)
        schur[:, range(4), range(4)] += prior
        return cls(bias, schur, prior, solved, chain, node_prior)

    def most_likely(self) -> JourneyBias:
        """Translation, heading and drift of all journeys."""
        bias, solved = self.bias, self.solved
        inverse = torch.linalg.inv(self.schur[..., :4, :4])
        constant = (inverse @ self.schur[..., :4, 4:])[..., 0]
        owner = bias.journey_of_node
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

    def log_evidence(self) -> Float[Tensor, " j"]:
        """Log-likelihood of each journey's signs, all that its poses may have wrong marginalised.

        But for what the priors have no part in: only differences between priors mean something.
        """
        lower = torch.linalg.cholesky(self.schur[..., :4, :4])
        missed = torch.linalg.solve_triangular(lower, self.schur[..., :4, 4:], upper=False)
        square = self.schur[:, 4, 4] - missed.square().sum((1, 2))
        schur = 2 * lower.diagonal(dim1=1, dim2=2).log().sum(1)
        prior = self.prior.log().sum(1)
        chain = _chain_log_determinant(self.bias, self.chain)
        alone = _chain_log_determinant(self.bias, _solver(*self.node_prior))
        return -0.5 * (square + schur - prior + chain - alone)


def _chain_log_determinant(bias: JourneyBias, chain: BandFactor) -> Float[Tensor, " j"]:
    """By journey, of the matrix of its nodes."""
    diagonal = chain.band[:, 0]
    of_node = 2 * diagonal.log().view(len(bias.node_drift), -1).sum(1)
    return of_node.new_zeros(len(bias)).index_add_(0, bias.journey_of_node, of_node)


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


def _solver(diagonal: Float[Tensor, "k s s"], below: Float[Tensor, "k s s"]) -> BandFactor:
    """The factor of a symmetric block-tridiagonal matrix; `below[k]` couples k and k + 1 and is symmetric."""
    K, s = diagonal.shape[:2]
    lower = diagonal.new_zeros(K, s, 2 * s)
    for column in range(s):
        lower[:, column, : s - column] = diagonal[:, column:, column]
        lower[:, column, s - column : 2 * s - column] = below[:, :, column]
    factor = cholesky_banded(lower.view(s * K, 2 * s))
    if factor is None:
        raise ArithmeticError("a chain of biases without a prior")
    return factor


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
