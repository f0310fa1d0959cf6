"""V-A.1, unlike the paper: when a detection that clustering set aside shows a sign of the map."""

from __future__ import annotations

from dataclasses import dataclass

from crowdmap_torch.ranges import (
    Count,
    Factor,
    Length,
    LengthOrNone,
    Pixels,
    Rounds,
    Seconds,
    Settings,
    Share,
)
from crowdmap_torch.tables import Association, Signs


@dataclass(frozen=True)
class CompleteTracksConfig(Settings):
    """When a detection without a landmark shows a sign of the map."""

    reach_m: LengthOrNone = 120.0
    """Signs further from the camera are not looked for [m]."""
    candidates: Count = 48
    """Signs that a detection is compared with, the nearest to its camera."""
    error_window_s: Seconds = 1.0
    """For so long before and after, a detection of a sign tells how its projection errs [s]."""
    known_px: Pixels = 3.0
    """Where that is known, most corners are within so many pixels, or within twice what is usual of the drive, ..."""
    known_share: Share = 0.1
    """... and this share of the outline's larger side of the projection."""
    vote_share: Share = 0.35
    """Where it is not, most corners are within this share, ..."""
    vote_clear: Factor = 2.0
    """... other signs so many times as far, ..."""
    vote_majority: Share = 0.6
    """... and so is this share of the detections of the tracklet, ..."""
    vote_detections: Count = 1
    """... which has at least so many."""
    displaced_px: Pixels = 45.0
    """An outline this far off may be the only one missing in its frame of a sign that is seen before and after, ..."""
    displaced_size: Share = 0.2
    """... if its sides differ by no more than this share."""
    duplicate_m: Length = 1.5
    """A sign this close to one that more journeys saw is a duplicate, if `vote_majority` of its detections lie on the
    other's projection, as near as images of the drive are noisy, and nothing else in their frames shows the other [m]."""
    passes: Rounds = 2
    """What was found tells how the projections of other detections err."""
    evidence: Count = 3
    """Journeys with so many detections of a sign have seen it."""


@dataclass(frozen=True)
class CompletedTracks:
    """The associations with what was brought back, and how much that is."""

    associations: tuple[Association, ...]
    fitting: int
    """Detections that lie on the projection of their sign."""
    displaced: int
    """Detections of the right size and shape beside it, while nothing else shows it."""


@dataclass(frozen=True)
class AssociatedSigns:
    """The signs of the first map, and which of them each detection shows."""

    heads: Signs
    tentative: Signs
    """Signs that too few journeys saw."""
    associations: tuple[Association, ...]
    completed: CompletedTracks | None
    """What clustering had set aside and was given back; None with `paper2017`, which does not."""
