"""V-A.1 and V-B as one problem: clusters give biases, biases sharpen clusters, coarse to fine, until nothing moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.clustering.spectral import renumber, singles_behind
from crowdmap_torch.crowd_signs.align import AlignConfig, align_journeys, no_bias
from crowdmap_torch.crowd_signs.cluster import (
    SignClusterConfig,
    Spectrum,
    cluster_signs,
    moved,
    rough_heads,
    sign_heads,
)
from crowdmap_torch.crowd_signs.existence import (
    ExistenceConfig,
    existence,
    has_company,
    passing_journeys,
)
from crowdmap_torch.crowd_signs.gather import (
    CrowdSigns,
    enough_to_tell,
    miss_sigma,
    unexplained_covariance,
    with_covariance,
)
from crowdmap_torch.crowd_signs.journey_bias import JourneyBias, bias_at, largest_drift
from crowdmap_torch.crowd_signs.match import (
    HeadMatchConfig,
    join_leftovers,
    match_heads,
    split_by_conflicts,
    without_small,
)
from crowdmap_torch.crowd_signs.merge import (
    SignMergeConfig,
    dissolve_weak,
    join_passes,
    merge_heads,
)
from crowdmap_torch.crowd_signs.outages import (
    Outage,
    OutageConfig,
    displaced_by,
    find_outages,
    outside_outages,
)
from crowdmap_torch.crowd_signs.outlier_journeys import (
    JourneyStatistics,
    OutlierJourney,
    OutlierJourneyConfig,
    find_outlier_journeys,
    journey_statistics,
)
from crowdmap_torch.crowd_signs.rounds import CrowdRound, crowd_round
from crowdmap_torch.crowd_signs.stretches import FirstBiases, first_biases
from crowdmap_torch.crowd_signs.vote import VoteConfig
from crowdmap_torch.crowd_signs.wander_length import likely_wander
from crowdmap_torch.geometry.trajectory import station
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.ranges import FILLED, Count, Rounds, Settings, Share, Sigma, Spacing
from crowdmap_torch.tables import Journey, Signs

METHODS = ("joint", "paper2017")


@dataclass(frozen=True)
class CrowdConfig(Settings):
    """How the signs of many journeys are told apart and the journeys' biases found."""

    method: str = "joint"
    """`joint`, or `paper2017`: the paper's clusters of the places as they are, once, and the mean biases from them."""
    shift_sigmas_m: Annotated[tuple[Sigma, ...], FILLED] = (0.45, 0.3, 0.2, 0.15)
    """`joint`: how uncertain the journeys' shifts are taken to be, coarse to fine, 1-sigma along each axis [m]."""
    least_sigma_m: tuple[Sigma, Sigma, Sigma] = (0.25, 0.12, 0.06)
    """`joint`: least 1-sigma of a journey's sign along the line of sight, across it and upwards, shifts left out [m].

    The covariance from triangulation knows pixels, not how poses wander while a sign is in view.
    """
    rounds: Rounds = 4
    """`joint`: most alternations of clustering and alignment for each of these."""
    seed_journeys: Count = 60
    """`joint`: most journeys that clusters are first made from in one place; the others' signs are matched to those."""
    seed_cell_m: Spacing = 50.0
    """Size of a place [m]."""
    stands_still: Share = 0.001
    """`joint`: clusters stand still when at most this share of the signs changes."""
    min_journeys: Count = 2
    """`joint`: signs seen by fewer are singles, kept apart as tentative (of a single journey, its signs are the map)."""
    cluster: SignClusterConfig = field(default_factory=SignClusterConfig)
    """Grouping from places alone."""
    match: HeadMatchConfig = field(default_factory=HeadMatchConfig)
    """Each journey's signs against the clusters."""
    merge: SignMergeConfig = field(default_factory=SignMergeConfig)
    """Clusters that are one sign."""
    vote: VoteConfig = field(default_factory=VoteConfig)
    """First biases."""
    align: AlignConfig = field(default_factory=AlignConfig)
    """Biases from clusters."""
    existence: ExistenceConfig = field(default_factory=ExistenceConfig)
    """Confidence in signs."""
    outlier_journeys: OutlierJourneyConfig = field(default_factory=OutlierJourneyConfig)
    """Drives that do not fit the crowd."""
    outages: OutageConfig = field(default_factory=OutageConfig)
    """Stretches of drives that do not fit it."""

    def __post_init__(self) -> None:
        """Refuses an unknown method."""
        super().__post_init__()
        if self.method not in METHODS:
            raise ValueError(f"method: expected one of {METHODS}, found {self.method!r}")


@dataclass(frozen=True)
class CrowdReport:
    """What the joint association and alignment saw."""

    rounds: tuple[CrowdRound, ...]
    spectra: tuple[Spectrum, ...]
    """Eigenvalues and numbers of clusters of the first clustering, of all signs."""
    statistics: JourneyStatistics
    outlier_journeys: tuple[OutlierJourney, ...]
    """Drives that do not fit the crowd."""
    outages: tuple[Outage, ...]
    """Stretches of drives that do not fit it."""
    n_passing: Int[Tensor, " c"]
    """Journeys that passed by each head, and behind the heads by each single."""


@dataclass(frozen=True)
class Crowd:
    """Signs of many journeys told apart, and the biases of the journeys."""

    members: Signs
    """Each journey's signs with its bias taken off."""
    label: Int[Tensor, " n"]
    """Row of `heads` for each of them; -1 for singles."""
    heads: Signs
    """The cluster heads, with the probability that they exist."""
    tentative: Signs
    """Singles, confidence below 0.5: row k is the k-th member labelled -1.

    Their covariance is absolute: triangulation, what is left of the journey's bias and drift, and what all journeys
    share.
    """
    bias: JourneyBias
    positioning: PositioningNoise
    """What positioning gets wrong, with the size of biases and the way on which they wander as these signs tell them."""
    displaced: Bool[Tensor, " n"]
    """Members that are signs of the others, beside their places."""
    journey_weight: Float[Tensor, " j"]
    """1; 0 for bad drives, which had no say in the heads and biases of others."""
    report: CrowdReport

    def moved(self, move: Float[Tensor, "j 3"]) -> Crowd:
        """All that each journey saw moved by its row [m], the same for journeys that signs tie together."""
        used, head = self.label >= 0, self.label.new_zeros(len(self.heads))
        journey = head.scatter(0, self.label[used], self.members.journey[used])
        return replace(
            self,
            members=moved(self.members, move[self.members.journey]),
            heads=moved(self.heads, move[journey]),
            tentative=moved(self.tentative, move[self.tentative.journey]),
            bias=replace(self.bias, translation=self.bias.translation - move),
        )

    def trusted_frames(self, journeys: Sequence[Journey]) -> tuple[Bool[Tensor, " _"], ...]:
        """By journey the frames that have a say: all but those of bad drives, and of outages of positioning."""
        return tuple(
            outside_outages(station(journey.T_world_camera), number, self.report.outages)
            & (weight > 0)
            for number, (journey, weight) in enumerate(
                zip(journeys, self.journey_weight, strict=True)
            )
        )


def register_crowd(
    crowd: CrowdSigns,
    positioning: PositioningNoise,
    config: CrowdConfig,
    *,
    generator: torch.Generator | None = None,
    start: FirstBiases | None = None,
) -> Crowd:
    """The signs of all journeys in clusters, one for each physical sign, and the bias of each journey (V-A.1, V-B).

    `start` are first biases that are better than what signs tell by themselves; `joint` only.
    """
    generator = generator or torch.Generator().manual_seed(0)
    if config.method == "paper2017":
        return _register_paper(crowd, positioning, config, generator)
    return _register_joint(crowd, positioning, config, generator, start)


def unbiased_signs(crowd: CrowdSigns, bias: JourneyBias) -> Signs:
    """Each journey's signs with its bias taken off."""
    signs = crowd.signs
    return moved(signs, -bias_at(bias, signs.journey, crowd.station, signs.center_world))


def _register_paper(
    crowd: CrowdSigns,
    positioning: PositioningNoise,
    config: CrowdConfig,
    generator: torch.Generator,
) -> Crowd:
    signs = crowd.signs
    cluster = replace(config.cluster, method="paper2017")
    align = replace(config.align, method="paper2017")
    found = cluster_signs(signs, cluster, generator=generator)
    label = found.label
    bias = align_journeys(
        signs,
        label,
        crowd.station,
        positioning,
        align,
        start=no_bias(signs, crowd.station, positioning, align, journeys=crowd.journeys),
        bias_sigma=crowd.bias_sigma,
    )
    heads = sign_heads(signs, label, method="paper2017")
    company = has_company(crowd, config.existence)
    unbiased, drift = unbiased_signs(crowd, bias), largest_drift(bias)
    statistics = journey_statistics(
        unbiased, label, heads, company, bias.translation, drift, crowd.leap
    )
    weight = crowd.bias_sigma.new_ones(crowd.journeys)
    rounds = [crowd_round(0.0, torch.full_like(label, -1), label)]
    told = (), weight, rounds, found.spectra, statistics
    made = _finished(crowd, label, heads, bias, *told, positioning, config)
    # Every cluster is in the map: the paper asks nobody who drove by and saw nothing.
    return replace(made, heads=heads)


def _register_joint(
    crowd: CrowdSigns,
    positioning: PositioningNoise,
    config: CrowdConfig,
    generator: torch.Generator,
    start: FirstBiases | None,
) -> Crowd:
    signs, journeys = crowd.signs, crowd.journeys
    told = positioning, config.align, config.vote
    bias, larger = start or first_biases(crowd, *told, generator=generator)
    crowd = replace(crowd, bias_sigma=larger * crowd.bias_sigma)
    east, north, up = (larger * larger.new_tensor(positioning.bias_sigma_m)).tolist()
    positioning = replace(positioning, bias_sigma_m=(east, north, up))
    weight = crowd.bias_sigma.new_ones(journeys)
    label = torch.full_like(signs.journey, -1)
    rounds: list[CrowdRound] = []
    spectra: tuple[Spectrum, ...] = ()
    outliers: tuple[OutlierJourney, ...] = ()
    statistics = None
    company = has_company(crowd, config.existence) & ~crowd.doubtful
    least = signs.size.new_tensor(config.least_sigma_m)
    extra = unexplained_covariance(crowd, least)
    for shift_sigma in config.shift_sigmas_m:
        for _ in range(config.rounds):
            before = label
            label, certainty, spectrum = _regroup(
                with_covariance(unbiased_signs(crowd, bias), extra),
                label,
                crowd.seen_together,
                weight[signs.journey],
                shift_sigma,
                config,
                generator,
            )
            spectra = spectra or spectrum
            rounds.append(crowd_round(shift_sigma, before, label))
            if len(rounds) == 1:
                known = extra, label, positioning, config.align
                positioning = likely_wander(crowd, *known, start=bias)
            bias = align_journeys(
                with_covariance(signs, extra),
                label,
                crowd.station,
                positioning,
                config.align,
                start=bias,
                bias_sigma=crowd.bias_sigma,
                journey_weight=weight,
                certainty=certainty,
            )
            if rounds[-1].changed <= config.stands_still * len(label):
                break
        unbiased = unbiased_signs(crowd, bias)
        heads = rough_heads(with_covariance(unbiased, extra), label, weight=weight[signs.journey])
        sigma = miss_sigma(crowd, unbiased, label, heads)
        extra = unexplained_covariance(crowd, torch.maximum(least, sigma))
        statistics = journey_statistics(
            unbiased, label, heads, company, bias.translation, largest_drift(bias), crowd.leap
        )
        outliers = find_outlier_journeys(statistics, config.outlier_journeys)
        weight = torch.ones_like(weight)
        weight[[s.journey for s in outliers]] = 0
    assert statistics is not None
    unbiased = with_covariance(unbiased_signs(crowd, bias), extra)
    label = _consolidated(crowd, unbiased, label, weight[signs.journey], config)
    label, heads, outages, displaced = _without_outages(
        crowd, unbiased, label, weight[signs.journey], config
    )
    told = outliers, weight, rounds, spectra, statistics
    found = crowd, label, heads, bias, *told, positioning, config
    return _finished(*found, outages=outages, displaced=displaced)


def _regroup(
    signs: Signs,
    label: Int[Tensor, " n"],
    seen_together: Int[Tensor, "p 2"],
    weight: Float[Tensor, " n"],
    shift_sigma: float,
    config: CrowdConfig,
    generator: torch.Generator,
) -> tuple[Int[Tensor, " n"], Float[Tensor, " n"], tuple[Spectrum, ...]]:
    """New labels, how certain each is, and the spectrum of the clustering of what was in no cluster.

    What is left over is clustered, clusters that are one are merged, and each journey is matched with the heads again.
    """
    sigma = signs.size.new_full((3,), shift_sigma)
    rest = torch.nonzero(label < 0)[:, 0]
    few = enough_to_tell(
        signs[rest], most=config.seed_journeys, cell_m=config.seed_cell_m, generator=generator
    )
    rest = rest[few]
    found = cluster_signs(signs[rest], config.cluster, generator=generator, shift_sigma=sigma)
    fresh = torch.full_like(label, -1)
    fresh[rest] = found.label
    fresh = split_by_conflicts(signs.journey, fresh, seen_together)
    used = int(label.max()) + 1 if len(label) else 0
    label = renumber(torch.where(fresh >= 0, fresh + used, label))
    heads = rough_heads(signs, label, weight=weight, shift_sigma=shift_sigma)
    matches = match_heads(signs, heads, seen_together, config.match, shift_sigma=sigma)
    for _ in range(2):
        before = label = renumber(matches.label)
        heads = rough_heads(signs, label, weight=weight, shift_sigma=shift_sigma)
        label = merge_heads(signs, label, heads, seen_together, config.merge, shift_sigma=sigma)
        if not torch.equal(before, label):
            label = renumber(label)
            heads = rough_heads(signs, label, weight=weight, shift_sigma=shift_sigma)
        matches = match_heads(signs, heads, seen_together, config.match, shift_sigma=sigma)
        if torch.equal(matches.label, label):
            break
    label = without_small(signs.journey, matches.label, min_journeys=2)
    return label, matches.certainty, found.spectra


def _consolidated(
    crowd: CrowdSigns,
    unbiased: Signs,
    label: Int[Tensor, " n"],
    weight: Float[Tensor, " n"],
    config: CrowdConfig,
) -> Int[Tensor, " n"]:
    """Labels with small clusters dissolved, duplicate ones joined and signs that were left over brought back."""
    least = min(config.min_journeys, crowd.journeys)
    if least < 2:
        label = singles_behind(label)
    label = without_small(crowd.signs.journey, label, min_journeys=least, counts=weight > 0)
    together = crowd.seen_together
    sigma = weight.new_full((3,), config.shift_sigmas_m[-1])
    heads = rough_heads(unbiased, label, weight=weight)
    label = merge_heads(unbiased, label, heads, together, config.merge, shift_sigma=sigma)
    label = renumber(label)
    heads = rough_heads(unbiased, label, weight=weight)
    label = join_passes(unbiased, label, heads, crowd.station, together, config.merge)
    label = renumber(label)
    heads = rough_heads(unbiased, label, weight=weight)
    label = renumber(dissolve_weak(unbiased, label, heads, together, config.merge))
    heads = rough_heads(unbiased, label, weight=weight)
    return join_leftovers(unbiased, label, heads, together, config.match)


def _without_outages(
    crowd: CrowdSigns,
    unbiased: Signs,
    label: Int[Tensor, " n"],
    weight: Float[Tensor, " n"],
    config: CrowdConfig,
) -> tuple[Int[Tensor, " n"], Signs, tuple[Outage, ...], Bool[Tensor, " n"]]:
    """Labels and heads without signs that outages displaced, the outages, and which signs those are."""
    heads = sign_heads(unbiased, label, weight=weight)
    # Bad drives have no say anywhere.
    say, like = weight > 0, config.match.similarity
    away = displaced_by(unbiased, label, heads, say, like, config.outages)
    outages = find_outages(unbiased, crowd.station, label, heads, away, config.outages)
    if outages:
        least, label = min(config.min_journeys, crowd.journeys), label.masked_fill(away > 0, -1)
        label = without_small(crowd.signs.journey, label, min_journeys=least, counts=say)
        heads = sign_heads(unbiased, label, weight=weight)
    return label, heads, outages, away > 0


def _finished(
    crowd: CrowdSigns,
    label: Int[Tensor, " n"],
    heads: Signs,
    bias: JourneyBias,
    outliers: tuple[OutlierJourney, ...],
    weight: Float[Tensor, " j"],
    rounds: list[CrowdRound],
    spectra: tuple[Spectrum, ...],
    statistics: JourneyStatistics,
    positioning: PositioningNoise,
    config: CrowdConfig,
    *,
    outages: tuple[Outage, ...] = (),
    displaced: Bool[Tensor, " n"] | None = None,
) -> Crowd:
    is_single = label < 0
    count = len(heads) + int(is_single.sum())
    passing = passing_journeys(crowd, singles_behind(label), count, config.existence)
    confidence = existence(heads.n_journeys, passing[: len(heads)], config.existence)
    members = unbiased_signs(crowd, bias)
    tentative = members[is_single]
    drift = positioning.drift_sigma_m**2 * torch.eye(3).to(tentative.covariance)
    of_bias = bias.covariance[tentative.journey] + bias.shared_covariance + drift
    tentative = with_covariance(tentative, of_bias)
    low = torch.full_like(tentative.confidence, config.existence.tentative)
    return Crowd(
        members=members,
        label=label,
        heads=replace(heads, confidence=confidence.to(heads.size)),
        tentative=replace(tentative, confidence=torch.minimum(low, tentative.confidence)),
        bias=bias,
        positioning=positioning,
        displaced=torch.zeros_like(label, dtype=torch.bool) if displaced is None else displaced,
        journey_weight=weight,
        report=CrowdReport(
            rounds=tuple(rounds),
            spectra=spectra,
            statistics=statistics,
            outlier_journeys=outliers,
            outages=outages,
            n_passing=passing,
        ),
    )
