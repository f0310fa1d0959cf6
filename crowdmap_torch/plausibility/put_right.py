"""What is told of faults of positions that are put right as a drive is read: leaps, bursts of noise, poses that freeze."""

from __future__ import annotations

from collections.abc import Iterator

from crowdmap_torch.io.detections import FROZEN
from crowdmap_torch.plausibility.finding import Finding
from crowdmap_torch.tables import Journey

FRAMES_LEFT_OUT = "frozen-poses"
"""Kind of the finding that tells of frames whose detections a map does without."""
LEAPS_TAKEN_OUT = "leaps-taken-out"
"""Kind of the finding that tells of leaps that a map does without."""
SMOOTHED = "noise-smoothed"
"""Kind of the finding that tells of bursts of noise that a map does without."""


def put_right_findings(journey: Journey) -> Iterator[Finding]:
    """What was put right in a journey as it was read."""
    yield from _freezes(journey)
    yield from _bursts(journey)
    yield from _leaps(journey)


def _freezes(journey: Journey) -> Iterator[Finding]:
    left = sum(count for reason, count in journey.dropped.items() if reason.endswith(FROZEN))
    if left:
        yield Finding(
            FRAMES_LEFT_OUT,
            f"positions stay where they are while the car drives on, and {left} detections are in such frames",
            "positioning was lost for a moment",
            "nothing: these detections are left out",
        )


def _bursts(journey: Journey) -> Iterator[Finding]:
    if journey.noisy_frames:
        yield Finding(
            SMOOTHED,
            f"positions jump to and fro in {journey.noisy_frames:,} of {journey.frame_count:,} frames, as no car does",
            "satellites were hidden for a while, as between tall buildings",
            "nothing: positions are smoothed there",
        )


def _leaps(journey: Journey) -> Iterator[Finding]:
    if journey.leaps_m:
        times = "once" if len(journey.leaps_m) == 1 else f"{len(journey.leaps_m)} times"
        yield Finding(
            LEAPS_TAKEN_OUT,
            f"positions leap {times} between two frames, by {max(journey.leaps_m):.1f} m at most",
            "positioning changed its mind, by other satellites or behind a bridge",
            "nothing: the drive is put together again where it leaps",
        )
