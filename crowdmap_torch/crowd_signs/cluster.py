"""V-A.1 (sec:mj-cluster-signs): which triangulations of many journeys are one physical sign, and the sign they head."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.clustering.groups import (
    distinct_pairs,
    group_argmin,
    group_count,
    group_median,
    group_mode,
    group_sum,
)
from crowdmap_torch.clustering.neighbours import near_pairs, pairs_in_radius
from crowdmap_torch.clustering.spectral import SpectralConfig, cluster_graph, renumber
from crowdmap_torch.crowd_signs.distance import SimilarityConfig, mahalanobis, sign_distance
from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.optim.robust import Tukey
from crowdmap_torch.ranges import FILLED, Count, Deviations, Length, Settings
from crowdmap_torch.tables import Signs

METHODS = ("joint", "paper2017")

_DENSE = 4096
"""Most nodes of a component whose spectrum the paper's rounds compute whole."""


@dataclass(frozen=True)
class SignClusterConfig(Settings):
    """How triangulated signs are grouped."""

    method: str = "joint"
    """`joint`: distances in units of their own uncertainty, appearance counts. `paper2017`: the paper's two rounds."""
    scales_m: Annotated[tuple[Length, ...], FILLED] = (4.0, 1.0)
    """`paper2017`: critical distance d_c of each round, coarse to fine [m]."""
    critical_sigmas: Deviations = 2.0
    """`joint`: critical distance d_c in standard deviations."""
    reach: Deviations = 4.0
    """Similarities beyond this many d_c are taken for zero."""
    reach_paper: Deviations = 6.0
    """`paper2017`: the same; they are 1.5e-8 there."""
    neighbours: Count = 48
    """`joint`: nearest neighbours of a sign in the graph."""
    min_signs: Count = 2
    """Clusters of fewer triangulations are discarded (the paper's singletons)."""
    spectral: SpectralConfig = field(default_factory=SpectralConfig)
    """How the graph is cut."""
    similarity: SimilarityConfig = field(default_factory=SimilarityConfig)
    """`joint`: what differences of appearance cost."""

    def __post_init__(self) -> None:
        """Refuses an unknown method."""
        super().__post_init__()
        if self.method not in METHODS:
            raise ValueError(f"method: expected one of {METHODS}, found {self.method!r}")


@dataclass(frozen=True)
class Spectrum:
    """The eigenvalues a round of clustering chose its number of clusters from."""

    scale: float
    """d_c of the round: metres (`paper2017`) or standard deviations (`joint`)."""
    eigenvalues: Float[Tensor, " m"]
    """Of the normalised Laplacian, ascending, all components together."""
    count: int
    """Clusters found: the chosen gap follows about this many eigenvalues."""
    miss: float
    """Largest residual of eigenpairs, where one did not come to its tolerance; else 0."""


@dataclass(frozen=True)
class SignClusters:
    """Groups of triangulations that are one physical sign."""

    label: Int[Tensor, " n"]
    """Cluster of each triangulation, 0 .. count - 1; -1 where the cluster was too small."""
    count: int
    spectra: tuple[Spectrum, ...]
    """One a round, for the report."""


def cluster_signs(
    signs: Signs,
    config: SignClusterConfig,
    *,
    generator: torch.Generator | None = None,
    shift_sigma: Float[Tensor, " 3"] | None = None,
) -> SignClusters:
    """Groups of signs of different journeys that are one physical sign, from places as they are (V-A.1).

    `shift_sigma` [m], east north up, is how uncertain the journeys' shifts still are (`joint` only; default 0.3 m).
    Unlike the paper, with `joint` the graph holds the nearest neighbours of each sign only, each of its connected
    components has its own eigenvalue gap, distance is in standard deviations and differences of appearance add to it.
    """
    if config.method == "paper2017":
        return _cluster_paper(signs, config, generator)
    sigma = signs.size.new_full((3,), 0.3) if shift_sigma is None else shift_sigma
    return _cluster_joint(signs, config, sigma, generator)


def _cluster_paper(
    signs: Signs, config: SignClusterConfig, generator: torch.Generator | None
) -> SignClusters:
    label = torch.zeros_like(signs.journey)
    spectra = []
    spectral = replace(config.spectral, dense_limit=_DENSE)
    for scale in config.scales_m:
        edge = pairs_in_radius(signs.center_world, config.reach_paper * scale)
        i, j = edge.T
        # A round only divides the clusters of the one before.
        edge = edge[label[i] == label[j]]
        similarity = center_similarity(signs, edge, critical_m=scale)
        # One number of clusters for all signs, then one for those of each cluster.
        found = cluster_graph(
            edge, similarity, len(signs), spectral, generator=generator, whole=label
        )
        label = found.label
        spectra.append(Spectrum(scale, found.eigenvalues, found.count, found.miss))
    return _without_small(label, tuple(spectra), config)


def center_similarity(
    signs: Signs, edge: Int[Tensor, "m 2"], *, critical_m: float
) -> Float[Tensor, " m"]:
    """The paper's similarity of pairs of signs (V-A.1, eq:simsign), `critical_m` its d_c.

    Zero for triangulations of one journey, which are taken for distinct, and for those of different shapes.
    """
    i, j = edge.T
    distance = (signs.center_world[i] - signs.center_world[j]).norm(dim=1)
    distinct = (signs.journey[i] == signs.journey[j]) | (signs.shape[i] != signs.shape[j])
    return torch.exp(-0.5 * (distance / critical_m).square()).masked_fill(distinct, 0.0)


def _cluster_joint(
    signs: Signs,
    config: SignClusterConfig,
    sigma: Float[Tensor, " 3"],
    generator: torch.Generator | None,
) -> SignClusters:
    # Two places are compared: each has its own shift.
    pair_sigma = sigma * 2**0.5
    spread = signs.covariance.diagonal(dim1=1, dim2=2).amax(1)
    typical = spread.median() if len(spread) else sigma.new_zeros(())
    limit = config.reach * config.critical_sigmas
    radius = limit * float((pair_sigma.square().max() + 2 * typical).sqrt())
    edge = near_pairs(signs.center_world, radius=radius, count=config.neighbours)
    i, j = edge.T
    edge = edge[signs.journey[i] != signs.journey[j]]
    squared = sign_distance(signs, signs, edge, config.similarity, pair_sigma)
    near = squared < limit**2
    similarity = torch.exp(-0.5 * squared[near] / config.critical_sigmas**2)
    found = cluster_graph(edge[near], similarity, len(signs), config.spectral, generator=generator)
    spectrum = Spectrum(config.critical_sigmas, found.eigenvalues, found.count, found.miss)
    return _without_small(found.label, (spectrum,), config)


def _without_small(
    label: Int[Tensor, " n"], spectra: tuple[Spectrum, ...], config: SignClusterConfig
) -> SignClusters:
    groups = int(label.max()) + 1 if len(label) else 0
    small = group_count(label, groups)[label] < config.min_signs
    kept = renumber(label.masked_fill(small, -1))
    return SignClusters(label=kept, count=int(kept.max()) + 1 if len(kept) else 0, spectra=spectra)


def sign_heads(
    signs: Signs,
    label: Int[Tensor, " n"],
    *,
    method: str = "joint",
    weight: Float[Tensor, " n"] | None = None,
    shift_sigma: float = 0.15,
) -> Signs:
    """The sign that stands for each cluster, row c for label c; every label 0 .. count - 1 must occur.

    `paper2017`: mean corners of the members. `joint`: a robust mean of the centres weighted by covariance
    (`shift_sigma` [m] is added to each) and by `weight` (0 to 1), and of the corners about them. Both are refitted to a
    plane and the shape that most members have; members of other shapes give their centre only.
    """
    members, label, given, count = _members(signs, label, weight)
    shape, kind = _majority(members, label, given if method == "joint" else None, count)
    corners = _aligned_corners(members, label, shape)
    same_shape = (members.shape == shape[label]).to(given)
    if method == "paper2017":
        share = same_shape / group_sum(same_shape, label, count)[label]
        mean_corners = group_sum(share[:, None, None] * corners, label, count)
        covariance = _covariance_of_mean(members, label, count, shift_sigma)
    else:
        center, covariance, trust = _robust_center(members, given, label, count, shift_sigma)
        offsets = corners - members.center_world[:, None]
        say = same_shape * given * _views(members) * trust.clamp_min(0.01)
        mean_corners = center[:, None] + _robust_offsets(offsets, say, label, count)
    facing = group_sum(members.normal_world * same_shape[:, None], label, count)
    T_world_sign, size, _ = polygon.fit_sign(mean_corners, shape, facing)
    return _head_table(members, label, shape, kind, T_world_sign, size, covariance)


def rough_heads(
    signs: Signs,
    label: Int[Tensor, " n"],
    *,
    weight: Float[Tensor, " n"] | None = None,
    shift_sigma: float = 0.15,
) -> Signs:
    """As `sign_heads` with `joint`, but upright signs of median size, no corners fitted: enough to match against."""
    members, label, given, count = _members(signs, label, weight)
    shape, kind = _majority(members, label, given, count)
    center, covariance, _ = _robust_center(members, given, label, count, shift_sigma)
    same_shape = members.shape == shape[label]
    size = group_median(members.size, label.masked_fill(~same_shape, -1), count)
    facing = group_sum(members.normal_world * same_shape[:, None], label, count)
    z = torch.nn.functional.normalize(facing, dim=1)
    up = torch.zeros_like(z)
    up[:, 2] = 1
    x = torch.nn.functional.normalize(torch.linalg.cross(up, z), dim=1)
    R = torch.stack((x, torch.linalg.cross(z, x), z), dim=2)
    return _head_table(members, label, shape, kind, se3.make(R, center), size, covariance)


def _members(
    signs: Signs, label: Int[Tensor, " n"], weight: Float[Tensor, " n"] | None
) -> tuple[Signs, Int[Tensor, " m"], Float[Tensor, " m"], int]:
    """The signs in clusters, their labels, the weights given to them, and the number of clusters."""
    used = label >= 0
    given = torch.ones_like(signs.confidence) if weight is None else weight.clamp_min(1e-6)
    count = int(label.max()) + 1 if len(label) else 0
    return signs[used], label[used], given[used], count


def _views(members: Signs) -> Float[Tensor, " n"]:
    """What a sign seen in many frames has more to say about its outline: views share the errors of their poses."""
    return members.n_observations.clamp_min(1).to(members.size).sqrt()


def _majority(
    members: Signs, label: Int[Tensor, " n"], given: Float[Tensor, " n"] | None, count: int
) -> tuple[Int[Tensor, " c"], Int[Tensor, " c"]]:
    """Shape and type that most members have; by the weights given and their views, or by number."""
    one = torch.ones_like(members.confidence)
    weight = one if given is None else given * _views(members)
    shape = group_mode(members.shape, weight, label, count)
    return shape, group_mode(members.type, weight, label, count)


def _head_table(
    members: Signs,
    label: Int[Tensor, " n"],
    shape: Int[Tensor, " c"],
    kind: Int[Tensor, " c"],
    T_world_sign: Float[Tensor, "c 4 4"],
    size: Float[Tensor, "c 2"],
    covariance: Float[Tensor, "c 3 3"],
) -> Signs:
    count = len(shape)
    seen, _, _ = distinct_pairs(label, members.journey)
    none = torch.full((count,), -1, dtype=label.dtype, device=label.device)
    extreme = partial(torch.zeros_like(none).scatter_reduce, 0, label, include_self=False)
    return Signs(
        shape=shape,
        type=kind,
        T_world_sign=T_world_sign,
        size=size,
        covariance=covariance,
        journey=none,
        tracklet=none,
        frame=none,
        n_journeys=group_count(seen, count),
        n_observations=torch.zeros_like(none).index_add(0, label, members.n_observations),
        first_seen_ns=extreme(members.first_seen_ns, "amin"),
        last_seen_ns=extreme(members.last_seen_ns, "amax"),
        confidence=size.new_ones(count),
    )


def moved(signs: Signs, offset: Float[Tensor, "n 3"]) -> Signs:
    """The same signs, each moved by its row of `offset` [m]."""
    T = signs.T_world_sign.clone()
    T[:, :3, 3] += offset
    return replace(signs, T_world_sign=T)


def _aligned_corners(
    members: Signs, label: Int[Tensor, " n"], shape: Int[Tensor, " c"]
) -> Float[Tensor, "n 8 3"]:
    """Corners of the members, each in the cyclic order that fits its cluster's best observed member."""
    corners = members.corners_world - members.center_world[:, None]
    same = members.shape == shape[label]
    reference = corners[group_argmin(-(members.n_observations * same).to(corners), label)]
    number = polygon.corner_count(shape)[label]
    shift, _ = polygon.best_shift(reference[label], corners, number)
    # A member of another shape is not used: its order does not matter.
    return polygon.roll(members.corners_world, shift, number)


def _robust_center(
    members: Signs,
    given: Float[Tensor, " n"],
    label: Int[Tensor, " n"],
    count: int,
    shift_sigma: float,
) -> tuple[Float[Tensor, "c 3"], Float[Tensor, "c 3 3"], Float[Tensor, " n"]]:
    """Centres of the clusters, their covariances, and how far each member was trusted; from the medians on."""
    position = members.center_world
    eye = torch.eye(3).to(position)
    covariance = members.covariance + shift_sigma**2 * eye
    information = torch.linalg.inv(covariance) * given[:, None, None]
    center = group_median(position, label, count)
    loss = Tukey()
    trust = torch.ones_like(members.confidence)
    total = information
    for _ in range(3):
        trust = loss.weight(mahalanobis(position - center[label], covariance)).clamp_min(1e-6)
        weighted = trust[:, None, None] * information
        total = group_sum(weighted, label, count)
        right = group_sum((weighted @ position[..., None])[..., 0], label, count)
        center = torch.linalg.solve(total, right)
    return center, torch.linalg.inv(total), trust


def _robust_offsets(
    offsets: Float[Tensor, "n 8 3"],
    weight: Float[Tensor, " n"],
    label: Int[Tensor, " n"],
    count: int,
) -> Float[Tensor, "c 8 3"]:
    """Mean corners about the centre; a member whose corners are turned or stretched has less say."""
    weight = weight.clamp_min(1e-12)
    mean = offsets.new_zeros(count, *offsets.shape[1:])
    trust = weight
    for _ in range(4):
        share = trust / group_sum(trust, label, count)[label]
        mean = group_sum(share[:, None, None] * offsets, label, count)
        miss = (offsets - mean[label]).norm(dim=2).mean(1)
        trust = weight / (miss / 0.05).clamp_min(1)  # Huber at 5 cm
    return mean


def _covariance_of_mean(
    members: Signs, label: Int[Tensor, " n"], count: int, sigma: float
) -> Float[Tensor, "c 3 3"]:
    own = members.covariance + sigma**2 * torch.eye(3).to(members.covariance)
    number = group_count(label, count).to(own)
    return group_sum(own, label, count) / number.square()[:, None, None]
