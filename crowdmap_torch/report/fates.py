"""Where each detection of a run ended: in the map, or at what it failed; and what to say of a map without rows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from crowdmap_torch.config import MapperConfig
from crowdmap_torch.io.area import OUTSIDE
from crowdmap_torch.io.detections import DROPPED_LANE, DROPPED_SIGN
from crowdmap_torch.lanes import reconstruct
from crowdmap_torch.mapper import MapResult
from crowdmap_torch.plausibility.finding import Finding
from crowdmap_torch.signs import pruning
from crowdmap_torch.tables import Dataset

MAPPED = "in the map"
NO_TRACK = "in no track"
OUTLIER_JOURNEY = "in a journey that does not fit the others"
OUTAGE = "where positions of the journey are off"
TOO_FEW_JOURNEYS = "in a landmark of too few journeys"
IMPROBABLE = "in a sign that too many journeys passed by unseen"
_TRACK = "in a track: "
_DOOR = "dropped at the door: "

_WHY: dict[str, tuple[str, str]] = {
    _DOOR + OUTSIDE: ("drives see next to nothing from inside the area", "name a larger one"),
    NO_TRACK: (
        "what is detected in one frame is not found in the next",
        "check that detections carry the number of the frame that they were made in",
    ),
    _TRACK + "too few frames": (
        "what is detected in one frame is hardly found again in the next",
        "check that detections carry their frames' numbers, or record more frames a second",
    ),
    _TRACK + "too little parallax": (
        "the cars hardly move past what they see",
        "add drives that go by",
    ),
    _TRACK + "too far away": (
        "nothing is seen from near",
        "check the focal length, and that drives go by what they see",
    ),
    _TRACK + "behind the camera": (
        "poses and detections do not belong together",
        "check the axes of poses and mount",
    ),
    _TRACK + "residual too large": (
        "rays to one sign do not meet",
        "check poses, lens, pixels and frame numbers, or say how noisy corners are in "
        "`sign_triangulation: {fit: {pixels: {sigma_px: 2.0}}}` of the configuration",
    ),
    _TRACK + "implausible size": (
        "what is mapped would be far too small or too large",
        "check the focal length and that positions are in metres",
    ),
    _TRACK + "position too uncertain": (
        "few views, or views from afar, place nothing",
        "add drives that go by, or frames",
    ),
    _TRACK + "too short": (
        "lane markers are seen for a few metres only",
        "check that lane points reach far enough ahead",
    ),
    _TRACK + "no points near enough": (
        "lane points do not lie on the road before the car",
        "check the rig's road normal and height",
    ),
    _TRACK + "too few points": (
        "of each lane marker few points are detected over a long way",
        "detect more points of a marker, or markers in more frames",
    ),
    OUTLIER_JOURNEY: ("journeys contradict each other", "see suspect_journeys in metrics.json"),
    OUTAGE: ("positioning failed for stretches of journeys", "see outages in metrics.json"),
    TOO_FEW_JOURNEYS: ("journeys do not see the same things", "add journeys over the same roads"),
    IMPROBABLE: (
        "most journeys that passed saw nothing there",
        "see tentative_signs.parquet, or lower min_confidence",
    ),
}
"""Likely cause and cure, by the fate of most detections."""
_UNKNOWN = ("detections were left out", "see `pruned` in metrics.json")


def reason_of(fate: str) -> tuple[str, str]:
    """Likely cause and cure, where most detections have a fate."""
    return _WHY.get(fate, _UNKNOWN)


def sign_fates(dataset: Dataset, result: MapResult, config: MapperConfig) -> Counter[str]:
    """Where the sign detections of all files ended; the counts add up to their rows."""
    total = _dropped(dataset, DROPPED_SIGN)
    for names, fate in sign_fates_by_row(dataset, result, config):
        total += _counted(names, fate)
    return total


def sign_fates_by_row(
    dataset: Dataset, result: MapResult, config: MapperConfig
) -> Iterator[tuple[tuple[str, ...], Int[Tensor, " d"]]]:
    """For every journey names of fates, and which of them each of its sign detections had."""
    is_certain = result.hd_map.signs.confidence >= config.min_confidence
    outliers = {found.journey for found in result.first.crowd.report.outlier_journeys}
    trusted = result.first.crowd.trusted_frames(dataset.journeys)
    for number, (journey, made, found) in enumerate(
        zip(dataset.journeys, result.journey_maps, result.associations, strict=True)
    ):
        yield _fates(
            *(made.sign_tracklets.label, made.sign_report.reason, pruning.REASONS),
            *(found.sign, is_certain, trusted[number][journey.signs.frame], number in outliers),
        )


def lane_fates(dataset: Dataset, result: MapResult) -> Counter[str]:
    """The same of lane detections."""
    every = torch.ones(len(result.hd_map.lanes), dtype=torch.bool)
    outliers = {found.journey for found in result.first.crowd.report.outlier_journeys}
    total = _dropped(dataset, DROPPED_LANE)
    trusted = result.first.crowd.trusted_frames(dataset.journeys)
    for number, (journey, made, found) in enumerate(
        zip(dataset.journeys, result.journey_maps, result.associations, strict=True)
    ):
        total += _counted(
            *_fates(
                *(made.lane_tracklets.label, made.lane_report.reason, reconstruct.REASONS),
                *(found.lane, every.to(found.lane.device)),
                *(trusted[number][journey.lanes.frame], number in outliers),
            )
        )
    return total


def missing_findings(
    dataset: Dataset, result: MapResult, config: MapperConfig
) -> tuple[Finding, ...]:
    """Why a map has no signs or no lanes although some were detected; and that nothing at all was."""
    fates = {"sign": sign_fates(dataset, result, config), "lane": lane_fates(dataset, result)}
    if not any(sum(count.values()) for count in fates.values()):
        return (
            Finding(
                "no-detections",
                "the map is empty: not one sign or lane marker was detected",
                "signs.parquet and lanes.parquet of all journeys have no rows",
                "check what writes them",
            ),
        )
    return tuple(_missing(fates))


def _missing(fates: Mapping[str, Counter[str]]) -> Iterator[Finding]:
    for kind, count in fates.items():
        total = sum(count.values())
        if not total or count[MAPPED]:
            continue
        ordered = count.most_common()
        told = ", ".join(f"{number:,} {fate}" for fate, number in ordered)
        cause, cure = reason_of(ordered[0][0])
        yield Finding(
            f"no-{kind}s",
            f"the map has no {kind}s, of {total:,} {kind} detections: {told}",
            cause,
            cure,
        )


def _dropped(dataset: Dataset, prefix: str) -> Counter[str]:
    """Rows dropped at the door, by fault."""
    total: Counter[str] = Counter()
    for journey in dataset.journeys:
        for reason, count in journey.dropped.items():
            if reason.startswith(prefix):
                total[_DOOR + reason.removeprefix(prefix)] += count
    return total


def _fates(
    label: Int[Tensor, " d"],
    reason: Int[Tensor, " count"],
    reasons: Sequence[str],
    landmark: Int[Tensor, " d"],
    is_certain: Bool[Tensor, " n"],
    trusted: Bool[Tensor, " d"],
    is_outlier: bool,
) -> tuple[tuple[str, ...], Int[Tensor, " d"]]:
    """Names of fates, and that of each of one journey's detections; of several that apply the last that was reached."""
    kept = OUTLIER_JOURNEY if is_outlier else TOO_FEW_JOURNEYS
    names = (NO_TRACK, kept, *(_TRACK + why for why in reasons[1:]), OUTAGE, IMPROBABLE, MAPPED)
    # Reason 0 is that the tracklet was kept; label -1 reads the last slot.
    of_track = torch.cat((reason + 1, reason.new_zeros(1)))
    of_landmark = torch.cat((is_certain.long() + len(names) - 2, reason.new_zeros(1)))
    of_detection = of_track[label]
    if not is_outlier:
        of_detection = of_detection.masked_fill((of_detection == 1) & ~trusted, names.index(OUTAGE))
    return names, torch.where(landmark >= 0, of_landmark[landmark], of_detection)


def _counted(names: Sequence[str], fate: Int[Tensor, " d"]) -> Counter[str]:
    count = torch.bincount(fate, minlength=len(names)).tolist()
    return Counter({name: number for name, number in zip(names, count, strict=True) if number})
