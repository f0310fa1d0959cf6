"""A look at a whole data set before it is mapped: what looks wrong, one line for each cause."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from crowdmap_torch.io.columns import Sheet
from crowdmap_torch.io.copies import overlaps
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.plausibility.consistency import (
    ConsistencyLimits,
    consistency_findings,
    crawl_findings,
)
from crowdmap_torch.plausibility.detections import Outlines, detection_findings
from crowdmap_torch.plausibility.finding import Finding, Repair, gathered
from crowdmap_torch.plausibility.lens import is_bare, lens_findings
from crowdmap_torch.plausibility.lever import HIDDEN_LEVER, hidden_lever, lever_findings, lever_of
from crowdmap_torch.plausibility.poses import axes_alike, in_kilometres, pose_findings
from crowdmap_torch.plausibility.rig import rig_findings
from crowdmap_torch.tables import Dataset, Journey, to_device
from crowdmap_torch.tracking.sign_features import SignAssociationConfig
from crowdmap_torch.tracking.signs import associate_signs

_MOST_TRIANGULATED = 12
"""Journeys whose signs are triangulated for the look: mistakes are made in all alike."""


def look_over(
    folder: Path, dataset: Dataset, positioning: PositioningNoise, config: SignAssociationConfig
) -> tuple[Finding, ...]:
    """What looks wrong with the journeys of the data set in `folder`, each finding once."""
    found = findings_by_journey(folder, dataset, positioning, config)
    return gathered([row for row in found if row[1].kind != HIDDEN_LEVER])


@torch.no_grad()
def findings_by_journey(
    folder: Path, dataset: Dataset, positioning: PositioningNoise, config: SignAssociationConfig
) -> list[tuple[str, Finding]]:
    """What looks wrong, with the journey in which it was seen, and which mistake would not show.

    Signs are triangulated only where nothing else is wrong: a mistake that shows by itself spoils them too. Of many sound
    journeys some are triangulated, and what is found is said of all of them. What is looked at is on the processor.
    """
    dataset = to_device(dataset, "cpu")
    found = [
        (journey.journey_id, finding)
        for journey in dataset.journeys
        for finding in _findings_of(folder / "journeys" / journey.journey_id, journey, dataset)
    ]
    found += list(_alike(found, dataset.journeys))
    found += list(_overlaps(dataset.journeys))
    found += [
        (journey.journey_id, finding)
        for journey in dataset.journeys
        for finding in _crawling(journey, positioning, config)
    ]
    spoiled = {journey for journey, finding in found if finding.kind not in _HARMLESS}
    sound = [j for j in dataset.journeys if j.journey_id not in spoiled]
    seen = [j for j in sound if len(j.signs)]
    some = seen[:: -(-len(seen) // _MOST_TRIANGULATED)] if seen else []
    tracklets = [associate_signs(journey, positioning, config) for journey in some]
    # What is wrong with the lens keeps rays from meeting, too: as a lever does, and less so than that if it is none.
    lever = lever_of(some, tracklets, positioning)
    of_lever = lever_findings(lever)
    rival = lever.significance if lever is not None and of_lever else 0.0
    of_lens = lens_findings(some, tracklets, positioning, rival=rival)
    if not of_lens:
        of_rays = consistency_findings(some, tracklets)
        of_rays = of_rays or of_lever or hidden_lever(lever)
        return found + [(j.journey_id, finding) for finding in of_rays for j in sound]
    named = {name: finding for name, finding in of_lens}
    by_lens = {is_bare(j.rig): named[j.journey_id] for j in some if j.journey_id in named}
    return found + [
        (j.journey_id, by_lens[is_bare(j.rig)]) for j in sound if is_bare(j.rig) in by_lens
    ]


_HARMLESS = ("sigmas", "overlap", "road-normal", "camera-height", "leap")
"""Findings that do not keep the rays to a sign from meeting."""


def _findings_of(folder: Path, journey: Journey, dataset: Dataset) -> Iterator[Finding]:
    yield from rig_findings(journey.rig)
    yield from pose_findings(journey, dataset.origin)
    signs, lanes = (_outlines(folder / f"{name}.parquet") for name in ("signs", "lanes"))
    yield from detection_findings(signs, lanes, journey.rig)


_OF_AXES = ("quaternion-order", "camera-from-world", "north-east-down", "body-frame", "camera-axes")


def _alike(
    found: Sequence[tuple[str, Finding]], journeys: Sequence[Journey]
) -> Iterator[tuple[str, Finding]]:
    """Mistakes of axes in journeys that show them too little to be named by themselves."""
    named = {(f.kind, f.cause): f for _, f in found if f.kind in _OF_AXES}
    known = {journey for journey, finding in found if finding.kind not in _HARMLESS}
    for journey in journeys:
        if journey.journey_id in known:
            continue
        for finding in named.values():
            if (own := axes_alike(journey, finding)) is not None:
                yield journey.journey_id, own


def _crawling(
    journey: Journey, positioning: PositioningNoise, config: SignAssociationConfig
) -> list[Finding]:
    """Whether a journey that hardly moves is one in kilometres."""
    larger = in_kilometres(journey)
    if larger is None or not len(journey.signs):
        return []
    tracks = associate_signs(larger, positioning, config)
    return crawl_findings(larger, tracks, ConsistencyLimits())


def _outlines(path: Path) -> Outlines:
    """The rows of a file that the data set's reader has accepted, with those that it dropped."""
    sheet = Sheet(path, ("u", "v"))
    u, v = sheet.number_lists("u"), sheet.number_lists("v")
    return Outlines(np.stack((u.values, v.values), axis=-1), u.count)


def _overlaps(journeys: Sequence[Journey]) -> Iterator[tuple[str, Finding]]:
    """Journeys that repeat a part of another one; those that repeat most of it were set aside at the door."""
    for overlap in overlaps(journeys):
        other = journeys[overlap.other].journey_id
        yield (
            journeys[overlap.journey].journey_id,
            Finding(
                "overlap",
                f"{overlap.share:.0%} of the detections are those of {other!r}",
                "one drive was cut into journeys that overlap",
                "cut it anew: the map takes what is in two journeys for two drives",
                repair=Repair("cut-overlap", of=other),
            ),
        )
