"""Journeys whose rotations the images contradict, as the adjustment found."""

from __future__ import annotations

from crowdmap_torch.mapper import MapResult
from crowdmap_torch.noise.pose_evidence import white_scales_of_kinds
from crowdmap_torch.plausibility.finding import Finding
from crowdmap_torch.tables import Dataset

_ROTATION = 2
"""Column of `prior_scale` that is of rotations."""
_CONTRADICTED = 3.0
"""Rotations further off, in their own sigmas, are not what the camera did; those that are come to 1.5 at most."""


def rotation_findings(dataset: Dataset, result: MapResult) -> tuple[Finding, ...]:
    """One finding for all journeys whose cameras turned otherwise than their rotations say; none where they fit."""
    drift = result.prior_scale[:, _ROTATION]
    noise = white_scales_of_kinds(result.white_scale)[:, 1]
    contradicted = ((drift > _CONTRADICTED) | (noise > _CONTRADICTED)).tolist()
    names = [j.journey_id for j, so in zip(dataset.journeys, contradicted, strict=True) if so]
    if not names:
        return ()
    most = float(drift.max()), float(noise.max())
    return (
        Finding(
            "rotations-contradicted",
            f"images contradict rotations: slow errors are up to {most[0]:.1f} times, those from frame to frame up to "
            f"{most[1]:.1f} times as large as their sigmas say",
            "rotations were not measured, such as a course over ground, or their sigma_rot is too small",
            "give rotations of an inertial sensor or of visual odometry, or say in sigma_rot how sure they are",
            tuple(names),
        ),
    )
