"""Whether detections are in raw pixels of the rig's lens or in undistorted ones: a likelihood ratio over all drives."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

from scipy.special import chdtri

from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.plausibility.finding import Finding, Repair
from crowdmap_torch.plausibility.missing_lens import LensLimits, MissingLens, missing_lens
from crowdmap_torch.tables import Journey, Rig, Tracklets

_UNIT_K1 = -0.1
"""The lens of which pixels of rigs without one may have a share."""


def own_missing_lens(
    journey: Journey,
    tracks: Tracklets,
    positioning: PositioningNoise,
    limits: LensLimits | None = None,
) -> MissingLens | None:
    """The share of its rig's lens that a journey's pixels are without; of a usual one where the rig has none."""
    camera = journey.rig.camera
    bare = is_bare(journey.rig)
    distortion = camera.K.new_tensor([_UNIT_K1, 0, 0, 0] if bare else [])
    other = replace(camera, model="brown_conrady", distortion=distortion)
    return missing_lens(journey, tracks, other, positioning, limits or LensLimits(), again=bare)


def lens_findings(
    journeys: Sequence[Journey],
    missing: Sequence[MissingLens | None],
    limits: LensLimits | None = None,
    *,
    rival: float = 0.0,
) -> list[tuple[str, Finding]]:
    """Lenses of rigs that the pixels do not have, and lenses of pixels that the rigs do not have, with the journeys.

    What is `missing` is that of each journey's `own_missing_lens`. What explains the same misfit by so many standard
    deviations is a `rival`: a lens is named by more of them alone.
    """
    limits = limits or LensLimits()
    bent: dict[str, MissingLens] = {}
    bare: dict[str, MissingLens] = {}
    for journey, found in zip(journeys, missing, strict=True):
        if found is not None:
            (bare if is_bare(journey.rig) else bent)[journey.journey_id] = found
    named = (
        _undistorted(bent.values(), limits, rival),
        _without_lens(bare.values(), limits, rival),
    )
    return [
        (journey, finding)
        for finding, own in zip(named, (bent, bare), strict=True)
        if finding is not None
        for journey in own
    ]


def is_bare(rig: Rig) -> bool:
    """Whether a rig's lens has no distortion."""
    return rig.camera.model == "brown_conrady" and not bool((rig.camera.distortion != 0).any())


def _undistorted(
    found: Collection[MissingLens], limits: LensLimits, rival: float
) -> Finding | None:
    if not found:
        return None
    all_of_it = _together(found, limits)
    share, sigma = all_of_it.share, all_of_it.sigma
    if all_of_it.log_ratio < limits.log_ratio or share > limits.most + 2 * sigma:
        return None
    if share < rival * sigma:
        return None
    return Finding(
        "undistorted",
        f"signs move through the image as if {share:.0%} of the lens's distortion were missing "
        f"(sigma {sigma:.0%})",
        "detections are in undistorted pixels",
        "write raw pixels, or a rig without distortion",
        repair=Repair("distort") if abs(share - 1) < max(limits.all_of_it, 3 * sigma) else None,
    )


def _without_lens(
    found: Collection[MissingLens], limits: LensLimits, rival: float
) -> Finding | None:
    if not found:
        return None
    all_of_it = _together(found, limits)
    k1, sigma = _UNIT_K1 * all_of_it.share, abs(_UNIT_K1) * all_of_it.sigma
    if abs(k1) < max(limits.least_k1, max(limits.sure, rival) * sigma):
        return None
    other = _together([one.as_detected or one for one in found], limits)
    if other.share * math.copysign(1.0, all_of_it.share) < limits.looked_again * other.sigma:
        return None  # Noise of poses.
    return Finding(
        "no-lens",
        f"signs move through the image as seen by a lens with k1 = {k1:.2f} (sigma {sigma:.2f})",
        "detections are in raw pixels, but the rig has no distortion",
        "write the lens's distortion into rig.yaml, or undistorted pixels",
    )


def _together(found: Collection[MissingLens], limits: LensLimits) -> MissingLens:
    """The weighted mean; where drives contradict each other its sigma is by their spread alone."""
    weight = [one.sigma**-2 for one in found]
    total = sum(weight)
    share = sum(one.share * w for one, w in zip(found, weight, strict=True)) / total
    misfit = sum((one.share - share) ** 2 * w for one, w in zip(found, weight, strict=True))
    (usual, known), own = limits.scatter, len(found) - 1
    if misfit > usual * float(chdtri(own, 1 - limits.contradicting)):
        scatter = misfit / own
    else:
        scatter = (usual * known + misfit) / (known + own)
    return MissingLens(share, math.sqrt(scatter / total))
