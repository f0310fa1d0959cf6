"""A look at a whole data set before it is mapped: what looks wrong, one line for each cause."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from crowdmap_torch.fleet.engine import Engine
from crowdmap_torch.fleet.here import InProcess
from crowdmap_torch.io.columns import Sheet
from crowdmap_torch.io.copies import overlaps
from crowdmap_torch.io.stored_drives import StoredDrive
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.plausibility.consistency import (
    ConsistencyLimits,
    DriveRays,
    consistency_findings,
    crawl_findings,
    drive_rays,
)
from crowdmap_torch.plausibility.detections import Outlines, detection_findings
from crowdmap_torch.plausibility.finding import Finding, Repair, gathered
from crowdmap_torch.plausibility.lens import is_bare, lens_findings, own_missing_lens
from crowdmap_torch.plausibility.lever import (
    HIDDEN_LEVER,
    Said,
    hidden_lever,
    lever_findings,
    lever_of,
    said_of_lever,
)
from crowdmap_torch.plausibility.missing_lens import MissingLens
from crowdmap_torch.plausibility.poses import ONE_HEIGHT, axes_alike, in_kilometres, pose_findings
from crowdmap_torch.plausibility.put_right import FRAMES_LEFT_OUT, LEAPS_TAKEN_OUT
from crowdmap_torch.plausibility.rig import rig_findings
from crowdmap_torch.processes.threads import one_core_each
from crowdmap_torch.processes.workers import Call
from crowdmap_torch.tables import Dataset, Journey, Tracklets, to_device
from crowdmap_torch.tracking.sign_features import SignAssociationConfig
from crowdmap_torch.tracking.signs import associate_signs

_MOST_TRIANGULATED = 12
"""Journeys whose signs are triangulated for the look: mistakes are made in all alike."""


@dataclass(frozen=True)
class Look:
    """What a look at a data set found."""

    by_journey: tuple[tuple[str, Finding], ...]
    """What looks wrong, with the journey in which it was seen, and which mistake would not show."""
    tracklets: Mapping[int, Tracklets] = field(default_factory=dict)
    """Of the journeys whose signs were triangulated, by number: those of section IV, on the processor."""

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What looks wrong, each finding once."""
        return gathered([row for row in self.by_journey if row[1].kind != HIDDEN_LEVER])


@torch.no_grad()
def look_over(
    folder: Path,
    dataset: Dataset,
    positioning: PositioningNoise,
    config: SignAssociationConfig,
    *,
    engine: Engine | None = None,
    stored: Sequence[StoredDrive] | None = None,
) -> Look:
    """What looks wrong with the journeys of the data set in `folder`.

    Signs are triangulated only where nothing else is wrong: a mistake that shows by itself spoils them too. Of many sound
    journeys some are triangulated, by the workers of an engine (None: in this process), and what is found is said of all
    of them. Workers read these journeys themselves where they are `stored`. What is looked at is on the processor.
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
    sound = [n for n, j in enumerate(dataset.journeys) if j.journey_id not in spoiled]
    seen = [n for n in sound if len(dataset.journeys[n].signs)]
    some = seen[:: -(-len(seen) // _MOST_TRIANGULATED)] if seen else []
    engine = engine or InProcess()
    how = positioning, config
    calls: list[Call] = [
        (dataset.journeys[n].journey_id, signs_of, (dataset.journeys[n], *how))
        if stored is None or engine.shares_memory
        else (stored[n].journey_id, signs_of_stored, (stored[n], *how))
        for n in some
    ]
    looked = dict(engine.each(calls))
    signs = [looked[place] for place in range(len(some))]
    found += _of_signs(
        [dataset.journeys[n] for n in sound], [dataset.journeys[n] for n in some], signs
    )
    return Look(tuple(found), {n: own.tracklets for n, own in zip(some, signs, strict=True)})


@dataclass(frozen=True)
class DriveSigns:
    """What the signs of one journey say."""

    tracklets: Tracklets
    lever: Said | None
    lens: MissingLens | None
    rays: DriveRays | None


def signs_of_stored(
    drive: StoredDrive, positioning: PositioningNoise, config: SignAssociationConfig
) -> DriveSigns:
    """What the signs of a journey say that is read where the work is done."""
    return signs_of(drive.read(), positioning, config)


@one_core_each()
@torch.no_grad()
def signs_of(
    journey: Journey, positioning: PositioningNoise, config: SignAssociationConfig
) -> DriveSigns:
    """The signs of one journey, told apart and triangulated under all that may be wrong with them."""
    tracks = associate_signs(journey, positioning, config)
    return DriveSigns(
        tracklets=tracks,
        lever=said_of_lever(journey, tracks, positioning),
        lens=own_missing_lens(journey, tracks, positioning),
        rays=drive_rays(journey, tracks),
    )


def _of_signs(
    sound: Sequence[Journey], some: Sequence[Journey], signs: Sequence[DriveSigns]
) -> list[tuple[str, Finding]]:
    """What is wrong with all sound journeys, by the signs of some of them."""
    # What is wrong with the lens keeps rays from meeting, too: as a lever does, and less so than that if it is none.
    lever = lever_of([own.lever for own in signs])
    of_lever = lever_findings(lever)
    rival = lever.significance if lever is not None and of_lever else 0.0
    of_lens = lens_findings(some, [own.lens for own in signs], rival=rival)
    if not of_lens:
        of_rays = consistency_findings([own.rays for own in signs])
        of_rays = of_rays or of_lever or hidden_lever(lever)
        return [(j.journey_id, finding) for finding in of_rays for j in sound]
    named = {name: finding for name, finding in of_lens}
    by_lens = {is_bare(j.rig): named[j.journey_id] for j in some if j.journey_id in named}
    return [(j.journey_id, by_lens[is_bare(j.rig)]) for j in sound if is_bare(j.rig) in by_lens]


_HARMLESS = (
    "sigmas",
    "overlap",
    "road-normal",
    "camera-height",
    "leap",
    ONE_HEIGHT,
    FRAMES_LEFT_OUT,
    LEAPS_TAKEN_OUT,
)
"""Findings that do not keep the rays to a sign from meeting."""


def _findings_of(folder: Path, journey: Journey, dataset: Dataset) -> Iterator[Finding]:
    yield from rig_findings(journey.rig)
    yield from pose_findings(journey, dataset.origin)
    signs, lanes = (_outlines(folder / f"{name}.parquet") for name in ("signs", "lanes"))
    own = journey.lane_points
    if len(own) == len(lanes.px):
        # None was dropped: those of the journey are known without the lens.
        count = torch.bincount(own.detection, minlength=len(journey.lanes))
        lanes = Outlines(own.px.numpy(), count.numpy(), own.ideal)
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
