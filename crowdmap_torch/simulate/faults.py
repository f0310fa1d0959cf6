"""Bad drives: faults of a whole journey that a mapper should recognise and name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.simulate.rigs import rotation_from_rpy
from crowdmap_torch.simulate.signposts import WorldSigns
from crowdmap_torch.simulate.vehicle import Drive

POSE_FAULTS = ("frozen-gps", "wrong-heading", "jump", "late-poses", "far-off")
"""Faults of what the positioning module says."""
SENSOR_FAULTS = ("wrong-calibration", "wrong-focal")
"""Faults of the camera that rig.yaml describes."""
UPLOAD_FAULTS = ("moved-signs",)
"""Faults of somebody who wants the map to be wrong."""
KINDS = (*POSE_FAULTS, *SENSOR_FAULTS, *UPLOAD_FAULTS)


def spread_faults(
    kinds: tuple[str, ...], journeys: int, rng: np.random.Generator
) -> tuple[str | None, ...]:
    """Which fault each journey has: one journey for each kind, at random; None for the others."""
    unknown = [kind for kind in kinds if kind not in KINDS]
    if unknown:
        raise ValueError(f"bad drive {unknown[0]!r}: expected one of {', '.join(KINDS)}")
    if len(kinds) > journeys:
        raise ValueError(f"{len(kinds)} bad drives but only {journeys} journeys; ask for fewer")
    fault: list[str | None] = [None] * journeys
    for journey, kind in zip(rng.permutation(journeys), kinds, strict=False):
        fault[journey] = kind
    return tuple(fault)


def with_pose_fault(
    T_world_link: Float[np.ndarray, "f 4 4"],
    drive: Drive,
    fault: str | None,
    rng: np.random.Generator,
) -> Float[np.ndarray, "f 4 4"]:
    """Reported poses of a journey, spoilt by one of `POSE_FAULTS`; unchanged otherwise."""
    T = T_world_link.copy()
    share = drive.distance / max(drive.distance[-1], 1e-9)
    if fault == "frozen-gps":
        # The position stands while the car drives on: for a third of the journey, then it is back.
        first = int(np.searchsorted(share, rng.uniform(0.25, 0.4)))
        last = int(np.searchsorted(share, share[first] + 0.33))
        T[first:last, :3, 3] = T[first, :3, 3]
    elif fault == "wrong-heading":
        yaw = rng.uniform(3.0, 6.0) * rng.choice([-1, 1])
        T[:, :3, :3] = rotation_from_rpy(0.0, 0.0, np.radians(yaw)) @ T[:, :3, :3]
    elif fault == "jump":
        angle = rng.uniform(0, 2 * np.pi)
        step = rng.uniform(8.0, 12.0) * np.array([np.cos(angle), np.sin(angle), 0.0])
        T[share > rng.uniform(0.35, 0.65), :3, 3] += step
    elif fault == "late-poses":
        late = np.clip(drive.t - rng.uniform(0.3, 0.6), drive.t[0], None)
        T = T[np.clip(np.searchsorted(drive.t, late), 0, len(T) - 1)]
    elif fault == "far-off":
        angle = rng.uniform(0, 2 * np.pi)
        T[:, :2, 3] += rng.uniform(8.0, 20.0) * np.array([np.cos(angle), np.sin(angle)])
    return T


def with_sensor_fault(
    drive: Drive, camera: Camera, fault: str | None, rng: np.random.Generator
) -> tuple[Drive, Camera]:
    """How a camera that is not as calibrated truly looks at the world; unchanged otherwise."""
    if fault == "wrong-calibration":
        turn = np.radians(rng.uniform(2.0, 4.0, 3) * rng.choice([-1, 1], 3))
        R = drive.R_world_camera @ se3.so3_exp(torch.from_numpy(turn)).numpy()
        return replace(drive, R_world_camera=R), camera
    if fault == "wrong-focal":
        K = camera.K.clone()
        K[0, 0] *= 1.08
        K[1, 1] *= 1.08
        return drive, replace(camera, K=K)
    return drive, camera


def with_upload_fault(signs: WorldSigns, fault: str | None, rng: np.random.Generator) -> WorldSigns:
    """The signs that a poisoned upload claims to have seen, metres away; unchanged otherwise."""
    if fault != "moved-signs":
        return signs
    angle = rng.uniform(0, 2 * np.pi, len(signs))
    way = rng.uniform(3.0, 6.0, len(signs))
    push = np.stack((way * np.cos(angle), way * np.sin(angle), np.zeros_like(way)), axis=-1)
    return replace(signs, center=signs.center + push)
