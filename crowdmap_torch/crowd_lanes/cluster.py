"""V-A.2 (sec:mj-cluster-lanes): lane pieces of many journeys clustered as the paper does, and the cluster heads."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from crowdmap_torch.clustering.groups import (
    distinct_pairs,
    group_argmin,
    group_mode,
    group_range,
    group_sum,
)
from crowdmap_torch.clustering.spectral import SpectralConfig, cluster_graph, renumber
from crowdmap_torch.geometry import spline_basis, spline_fit, spline_length
from crowdmap_torch.ranges import FILLED, Count, Length, RoundsOrNone, Settings, Spacing
from crowdmap_torch.tables import ControlPoints, Lanes

SIMILARITIES = ("gaussian", "ratio")

_POINTS_AT_ONCE = 8192
_DENSE = 4096
"""Most nodes of a component whose spectrum is computed whole."""


@dataclass(frozen=True)
class LaneClusterConfig(Settings):
    """The paper's way to group lane pieces."""

    similarity: str = "gaussian"
    """`gaussian`: eq:simlane. `ratio`: N / D_min."""
    radius_m: Length = 1.5
    """Threshold r: sample points of two splines nearer than this run alongside each other."""
    critical_m: Annotated[tuple[Length, ...], FILLED] = (8.0, 16.0, 32.0)
    """Parameter d of eq:simlane, one a round; each round clusters the heads of the round before, which are longer."""
    touch_m: Length = 0.1
    """Least D_min: splines that touch would be infinitely similar."""
    knot_spacing_m: Spacing = 8.0
    """Distance of the control points of cluster heads."""
    refinements: RoundsOrNone = 3
    """How often the points of a cluster are moved to their nearest place on its head, and the head fitted again."""
    min_journeys: Count = 2
    """Clusters seen by fewer journeys are discarded and counted."""
    spectral: SpectralConfig = field(default_factory=SpectralConfig)
    """How the similarity graph is cut."""

    def __post_init__(self) -> None:
        """Refuses an unknown similarity."""
        super().__post_init__()
        if self.similarity not in SIMILARITIES:
            raise ValueError(
                f"similarity: expected one of {SIMILARITIES}, found {self.similarity!r}"
            )


@dataclass(frozen=True)
class LaneRound:
    """What one round of clustering saw."""

    splines: int
    """Splines before the round."""
    clusters: int
    eigenvalues: Float[Tensor, " m"]
    """Of the normalised Laplacian, ascending."""
    miss: float
    """Largest residual of eigenpairs, where one did not come to its tolerance; else 0."""


@dataclass(frozen=True)
class LaneClusters:
    """Groups of lane pieces that are one stretch of a marker."""

    label: Int[Tensor, " n"]
    """Cluster of each piece, 0 .. count - 1; -1 where too few journeys saw it."""
    count: int
    heads: Lanes
    """The spline that stands for each cluster, row c for label c."""
    rounds: tuple[LaneRound, ...]
    discarded: int
    """Pieces in clusters that were too small."""


def cluster_lanes(
    lanes: Lanes, config: LaneClusterConfig, *, generator: torch.Generator | None = None
) -> LaneClusters:
    """Groups of pieces that are one stretch of a marker, found in rounds, and their heads (V-A.2).

    Unlike the paper, only splines that come within r of each other are compared (all others have N = 0), and N / D_min
    is divided by that of each spline with itself, so that it stays in [0, 1].
    """
    label = torch.arange(len(lanes), device=lanes.journey.device)
    packed = lanes.select(label)
    spectral = replace(config.spectral, dense_limit=_DENSE)
    control, count = packed.control.point_world, packed.control_count
    rounds = []
    for critical in config.critical_m:
        edge, similarity = lane_similarity(control, count, config, critical=critical)
        one = torch.zeros_like(count)
        found = cluster_graph(
            edge, similarity, len(count), spectral, generator=generator, whole=one
        )
        rounds.append(LaneRound(len(count), found.count, found.eigenvalues, found.miss))
        stands_still = found.count == len(count)
        label = found.label[label]
        control, count = _heads(packed, label, found.count, config)
        if stands_still:
            break
    label, kept = _seen_enough(lanes, label, len(count), config)
    owner, _ = spline_basis.rows(count)
    control, count = control[kept[owner]], count[kept]
    return LaneClusters(
        label=label,
        count=len(count),
        heads=_head_table(lanes, label, control, count),
        rounds=tuple(rounds),
        discarded=int((label < 0).sum()),
    )


def lane_similarity(
    control: Float[Tensor, "c 3"],
    count: Int[Tensor, " n"],
    config: LaneClusterConfig,
    *,
    critical: float,
) -> tuple[Int[Tensor, "m 2"], Float[Tensor, " m"]]:
    """Pairs of packed splines that come within r of each other, and their similarities (V-A.2, eq:simlane)."""
    point, _, owner = spline_length.sample_flat(control, count, 1.0)
    number = torch.bincount(owner, minlength=len(count))
    edge, near, closest = alongside(point, owner, len(count), config.radius_m)
    own = edge[:, 0] == edge[:, 1]
    # The paper's N; whole numbers would be divided in single precision.
    share = near.to(closest) / (number[edge[:, 0]] * number[edge[:, 1]])
    if config.similarity == "gaussian":
        similarity = (-0.5 * (closest / (critical * share)).square()).exp()
    else:
        ratio = share / closest.clamp_min(config.touch_m)
        itself = ratio.new_zeros(len(count))
        itself[edge[own, 0]] = ratio[own]
        similarity = ratio / (itself[edge[:, 0]] * itself[edge[:, 1]]).sqrt()
    return edge[~own], similarity[~own].clamp_max(1.0)


def alongside(
    point: Float[Tensor, "s 3"], owner: Int[Tensor, " s"], n: int, radius: float
) -> tuple[Int[Tensor, "m 2"], Int[Tensor, " m"], Float[Tensor, " m"]]:
    """Pairs (i <= j) of owners with points within `radius`: how many pairs of points, and the least distance."""
    tree = KDTree(point.detach().cpu().numpy())
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    for rows in torch.arange(len(point), device=point.device).split(_POINTS_AT_ONCE):
        part = KDTree(point[rows].detach().cpu().numpy())
        found = part.sparse_distance_matrix(tree, radius, output_type="ndarray")
        i = owner[rows[torch.from_numpy(found["i"]).to(rows)]]
        j = owner[torch.from_numpy(found["j"]).to(rows)]
        distance = torch.from_numpy(found["v"]).to(point)
        once = i <= j
        parts.append(_counted(i[once] * n + j[once], None, distance[once]))
    if not parts:
        none = torch.zeros(0, dtype=torch.int64, device=point.device)
        return torch.stack((none, none), dim=1), none, point.new_zeros(0)
    key, near, closest = _counted(*(torch.cat(column) for column in zip(*parts, strict=True)))
    return torch.stack((key // n, key % n), dim=1), near, closest


def _counted(
    key: Int[Tensor, " p"], number: Int[Tensor, " p"] | None, distance: Float[Tensor, " p"]
) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"], Float[Tensor, " m"]]:
    """Of every key the total number (or how often it stands there) and the least distance."""
    unique, group = torch.unique(key, return_inverse=True)
    number = torch.ones_like(key) if number is None else number
    total = torch.zeros_like(unique).index_add(0, group, number)
    low = distance.new_full((len(unique),), torch.inf)
    return unique, total, low.scatter_reduce(0, group, distance, "amin")


def _heads(
    packed: Lanes, label: Int[Tensor, " n"], clusters: int, config: LaneClusterConfig
) -> tuple[Float[Tensor, "c 3"], Int[Tensor, " k"]]:
    """Splines fitted to the control points of each cluster's pieces; all pieces must be in a cluster."""
    point = packed.control.point_world
    owner = label[packed.piece_of_control]
    two = torch.full((clusters,), 2, dtype=torch.int64, device=label.device)
    # The reach along the principal axis tells how many control points a head needs.
    along = spline_fit.principal_parameter(point, owner, two)
    last, first = point[group_argmin(-along, owner)], point[group_argmin(along, owner)]
    length = (last - first).norm(dim=1)
    count = (length / config.knot_spacing_m).round().long().clamp(2, 200) + 1
    t = along * (count[owner] - 1)
    control = spline_fit.fit_flat(point, owner, t, count)
    control = spline_fit.refine_flat(point, owner, control, count, refinements=config.refinements)
    return control, count


def _seen_enough(
    lanes: Lanes, label: Int[Tensor, " n"], clusters: int, config: LaneClusterConfig
) -> tuple[Int[Tensor, " n"], Tensor]:
    """Labels without the clusters that too few journeys saw, and which clusters are kept."""
    journeys = _journeys(label, lanes.journey, clusters)
    needed = min(config.min_journeys, len(torch.unique(lanes.journey)))
    kept = journeys >= needed
    return renumber(label.masked_fill(~kept[label], -1)), kept


def _journeys(
    label: Int[Tensor, " n"], journey: Int[Tensor, " n"], clusters: int
) -> Int[Tensor, " k"]:
    """How many journeys each cluster has pieces of."""
    return torch.bincount(distinct_pairs(label, journey)[0], minlength=clusters)


def _head_table(
    lanes: Lanes, label: Int[Tensor, " n"], control: Float[Tensor, "c 3"], count: Int[Tensor, " k"]
) -> Lanes:
    n = len(count)
    member, own = lanes[label >= 0], label[label >= 0]
    n_journeys = _journeys(own, member.journey, n)
    none = torch.full((n,), -1, dtype=torch.int64, device=label.device)
    # Sigma of the members, as if journeys' errors were independent.
    packed = lanes.select(torch.arange(len(lanes), device=label.device))
    owner = label[packed.piece_of_control]
    number = torch.bincount(owner[owner >= 0], minlength=n).clamp_min(1)
    mean_square = group_sum(packed.control.sigma.square(), owner, n) / number
    sigma = (mean_square / n_journeys.clamp_min(1)).sqrt()
    return Lanes(
        type=group_mode(member.type, torch.ones_like(member.confidence), own, n),
        control_start=spline_basis.starts(count),
        control_count=count,
        journey=none,
        tracklet=none,
        frame=none,
        n_journeys=n_journeys,
        n_observations=group_sum(member.n_observations, own, n),
        first_seen_ns=group_range(member.first_seen_ns, own, n)[0],
        last_seen_ns=group_range(member.last_seen_ns, own, n)[1],
        confidence=sigma.new_ones(n),
        control=ControlPoints(control, sigma[spline_basis.rows(count)[0]]),
    )
