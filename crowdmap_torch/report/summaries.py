"""What a run took, left out and found, stage by stage and journey by journey: for metrics.json and the report."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.io.truth import Truth
from crowdmap_torch.mapper import FirstMap, MapResult
from crowdmap_torch.report.fates import MAPPED, lane_fates, sign_fates
from crowdmap_torch.tables import Dataset, RejectedJourney


@dataclass(frozen=True)
class JourneySummary:
    """What is told of one journey in use."""

    journey_id: str
    frames: int
    detections: int
    """Of signs."""
    used: int
    """Sign detections that are in a landmark of the map."""
    signs: int
    """Signs of its own triangulation."""
    bias: tuple[float, float, float]
    """East, north, up: adjusted minus given position, in the mean along the way [m]; NaN if it had no say."""
    bias_sigma: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    heading_deg: float = math.nan
    """The same of the heading, counted from east to north."""
    heading_sigma_deg: float = math.nan
    true_bias: tuple[float, float, float] | None = None
    """The same against the true poses (simulated data only)."""
    without_it: WithoutIt | None = None
    """None: that is not asked, or it had no say."""


@dataclass(frozen=True)
class WithoutIt:
    """What the map would be without a journey."""

    in_sigmas: float
    """By how many of their standard deviations signs that others saw too would be elsewhere (root mean square)."""
    farthest_m: float
    """By how much the one that would move farthest; NaN: there is none."""
    farthest_sign: str | None
    across_m: float
    """By how much lanes would be further to a side (root mean square)."""
    signs_gone: int
    """Signs that nobody else saw."""


@dataclass(frozen=True)
class Pruned:
    """How many of what were left out where, and why."""

    stage: str
    reason: str
    count: int


def outlier_journeys_of(dataset: Dataset, first: FirstMap) -> tuple[RejectedJourney, ...]:
    """Journeys that do not fit the others, with the reason."""
    return tuple(
        RejectedJourney(dataset.journeys[found.journey].journey_id, found.reason)
        for found in first.crowd.report.outlier_journeys
    )


@dataclass(frozen=True)
class OutageSummary:
    """A stretch of a journey that had no say, as its positions were off there."""

    journey_id: str
    from_m: float
    """Way driven where it begins."""
    to_m: float
    away_m: float
    """How far its signs stand beside those of the others at most."""

    @property
    def reason(self) -> str:
        """What is wrong with it, for people."""
        return f"its positions are off by {self.away_m:.1f} m from {self.from_m:.0f} to {self.to_m:.0f} m of its way"


def outages_of(dataset: Dataset, first: FirstMap) -> tuple[OutageSummary, ...]:
    """Stretches of journeys that do not fit the others."""
    return tuple(
        OutageSummary(dataset.journeys[o.journey].journey_id, o.from_m, o.to_m, o.away_m)
        for o in first.crowd.report.outages
    )


def counts_of(dataset: Dataset, result: MapResult, config: MapperConfig) -> dict[str, int]:
    """What each stage took and left, in the order of the stages."""
    maps, first = result.journey_maps, result.first
    signs = result.hd_map.signs
    return {
        "journeys": len(dataset.journeys),
        "journeys set aside": len(dataset.rejected),
        "frames": sum(j.frame_count for j in dataset.journeys),
        "sign detections": sum(len(j.signs) for j in dataset.journeys),
        "lane detections": sum(len(j.lanes) for j in dataset.journeys),
        "sign tracklets": sum(m.sign_tracklets.count for m in maps),
        "signs of single journeys": sum(len(m.signs) for m in maps),
        "lane pieces of single journeys": sum(len(m.lanes) for m in maps),
        "sign clusters": len(first.signs) + first.joined - first.found_later,
        "single signs": len(first.tentative),
        "sign detections brought back": first.completed.fitting + first.completed.displaced
        if first.completed
        else 0,
        "adjustments begun again": first.anew,
        "signs joined or gone after the adjustment": first.joined
        + len(first.signs)
        - len(result.uncertainty.center),
        "signs found by adjusted poses": first.found_later,
        "sign detections used": sum(int((a.sign >= 0).sum()) for a in result.associations),
        "lane detections used": sum(int((a.lane >= 0).sum()) for a in result.associations),
        "control points": result.control_points,
        "signs of the map": int((signs.confidence >= config.min_confidence).sum()),
        "tentative signs": int((signs.confidence < config.min_confidence).sum()),
        "lanes of the map": len(result.hd_map.lanes),
    }


def counts_line(dataset: Dataset, result: MapResult, config: MapperConfig) -> str:
    """What the map holds and what it was made of, in a line for people."""
    counts = counts_of(dataset, result, config)

    def share(kind: str) -> str:
        used, seen = counts[f"{kind} detections used"], counts[f"{kind} detections"]
        return f"{used:,} of {seen:,} {kind} detections"

    tentative = counts["tentative signs"]
    return (
        f"{counts['signs of the map']:,} signs"
        + (f" (and {tentative:,} tentative)" if tentative else "")
        + f", {counts['lanes of the map']:,} lane pieces from {counts['journeys']:,} journeys: "
        f"{share('sign')}, {share('lane')}"
    )


def pruned_of(dataset: Dataset, result: MapResult, config: MapperConfig) -> tuple[Pruned, ...]:
    """What was left out, by stage and reason; last all detections that are not in the map."""
    totals: Counter[tuple[str, str]] = Counter()
    for journey, made in zip(dataset.journeys, result.journey_maps, strict=True):
        for reason, count in journey.dropped.items():
            totals["detections at the door", reason] += count
        for reason, count in made.sign_report.pruned.items():
            if reason != "kept":
                totals["sign tracklets", reason] += count
        for reason, count in made.lane_report.pruned.items():
            if reason != "kept":
                totals["lane tracklets", reason] += count
    totals["signs of single journeys", "seen by too few journeys"] = len(result.first.tentative)
    for stage, fates in (
        ("sign detections", sign_fates(dataset, result, config)),
        ("lane detections", lane_fates(dataset, result)),
    ):
        totals.update({(stage, why): count for why, count in fates.items() if why != MAPPED})
    return tuple(Pruned(stage, why, count) for (stage, why), count in totals.items() if count)


def journey_summaries(
    dataset: Dataset, result: MapResult, truth: Truth | None = None
) -> tuple[JourneySummary, ...]:
    """One line for each journey in use."""
    summaries = []
    true: Sequence[tuple[float, float, float] | None] = [None] * len(dataset.journeys)
    if truth is not None:
        # A bias is what is to be added to the given positions.
        true = [(-x, -y, -z) for x, y, z in (t.mean_error_m.tolist() for t in truth.journeys)]
    found = result.uncertainty
    sigmas = found.bias_covariance.diagonal(dim1=1, dim2=2).sqrt()
    without = _without_each(result)
    for journey, made, association, bias, sigma, true_bias, without_it in zip(
        dataset.journeys,
        result.journey_maps,
        result.associations,
        found.bias.tolist(),
        sigmas.tolist(),
        true,
        without,
        strict=True,
    ):
        east, north, up, heading = bias
        summaries.append(
            JourneySummary(
                journey_id=journey.journey_id,
                frames=journey.frame_count,
                detections=len(journey.signs),
                used=int((association.sign >= 0).sum()),
                signs=len(made.signs),
                bias=(east, north, up),
                bias_sigma=(sigma[0], sigma[1], sigma[2]),
                heading_deg=math.degrees(heading),
                heading_sigma_deg=math.degrees(sigma[3]),
                true_bias=true_bias,
                without_it=without_it,
            )
        )
    return tuple(summaries)


def _without_each(result: MapResult) -> list[WithoutIt | None]:
    """What the map would be without each of the journeys."""
    found, names = result.uncertainty.influence, result.hd_map.sign_id
    if found is None:
        return [None] * len(result.journey_maps)
    each = (x.tolist() for x in (found.in_sigmas, found.farthest_m, found.farthest_sign))
    lanes, gone = found.across_m.tolist(), found.alone.tolist()
    return [
        None
        if math.isnan(sigmas) and math.isnan(across) and not alone
        else WithoutIt(sigmas, far, names[sign] if sign >= 0 else None, across, alone)
        for sigmas, far, sign, across, alone in zip(*each, lanes, gone, strict=True)
    ]
