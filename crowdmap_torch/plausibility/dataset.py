"""A look at a whole data set before it is mapped: what looks wrong, one line for each cause."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from crowdmap_torch.io.columns import Sheet
from crowdmap_torch.io.copies import overlaps
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.plausibility.consistency import consistency_findings
from crowdmap_torch.plausibility.detections import Outlines, detection_findings
from crowdmap_torch.plausibility.finding import Finding, gathered
from crowdmap_torch.plausibility.lens import lens_findings
from crowdmap_torch.plausibility.poses import pose_findings
from crowdmap_torch.plausibility.rig import rig_findings
from crowdmap_torch.tables import Dataset, Journey
from crowdmap_torch.tracking.sign_features import SignAssociationConfig
from crowdmap_torch.tracking.signs import associate_signs

_MOST_TRIANGULATED = 12
"""Journeys whose signs are triangulated for the look: mistakes are made in all alike."""


@torch.no_grad()
def look_over(
    folder: Path, dataset: Dataset, positioning: PositioningNoise, config: SignAssociationConfig
) -> tuple[Finding, ...]:
    """What looks wrong with the journeys of the data set in `folder`, each finding once.

    Signs are triangulated only where nothing else is wrong: a mistake that shows by itself spoils them too.
    """
    found = [
        (journey.journey_id, finding)
        for journey in dataset.journeys
        for finding in _findings_of(folder / "journeys" / journey.journey_id, journey, dataset)
    ]
    found += list(_overlaps(dataset.journeys))
    spoiled = {journey for journey, finding in found if finding.kind not in _HARMLESS}
    sound = [j for j in dataset.journeys if j.journey_id not in spoiled and len(j.signs)]
    some = sound[:: -(-len(sound) // _MOST_TRIANGULATED)] if sound else []
    tracklets = [associate_signs(journey, positioning, config) for journey in some]
    # What is wrong with the lens keeps rays from meeting, too.
    found += lens_findings(some, tracklets, positioning) or [
        (journey.journey_id, finding)
        for finding in consistency_findings(some, tracklets)
        for journey in some
    ]
    return gathered(found)


_HARMLESS = ("sigmas", "overlap", "road-normal", "camera-height", "leap")
"""Findings that do not keep the rays to a sign from meeting."""


def _findings_of(folder: Path, journey: Journey, dataset: Dataset) -> Iterator[Finding]:
    yield from rig_findings(journey.rig)
    yield from pose_findings(journey, dataset.origin)
    signs, lanes = (_outlines(folder / f"{name}.parquet") for name in ("signs", "lanes"))
    yield from detection_findings(signs, lanes, journey.rig)


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
            ),
        )
