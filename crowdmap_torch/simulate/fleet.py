"""Vehicles that come back: each has a rig as it is stated, and what is truly different about it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float

from crowdmap_torch.geometry import se3
from crowdmap_torch.ranges import (
    CountOrNone,
    Degrees,
    LengthOrNone,
    PixelsOrNone,
    Range,
    Settings,
    Share,
)
from crowdmap_torch.simulate.rigs import SimulatedRig, letters

Delay = Annotated[float, Range(0, 1, "seconds between clocks or rows of a picture: one at most")]
SignedShare = Annotated[float, Range(-0.5, 0.5, "a share too large or too small: half at most")]


@dataclass(frozen=True)
class FleetConfig(Settings):
    """The vehicles, and how far each is from its rig.yaml; drawn once for a vehicle, the same in all its drives.

    Errors are 1-sigma of a normal draw, 0 none, unless their text says otherwise.
    """

    vehicles: CountOrNone = 0
    """Vehicles that drive in turn, each with the rig whose turn it is; 0: one for each rig."""
    mount_error_deg: Degrees = 0.0
    """Turn of the camera about each of its axes, against the stated mount."""
    mount_error_m: LengthOrNone = 0.0
    """Shift of the camera along each of its axes, against the stated mount."""
    focal_error: Share = 0.0
    """Of the focal length, as a share of it."""
    principal_error_px: PixelsOrNone = 0.0
    """Of the principal point in u and in v."""
    height_error_m: LengthOrNone = 0.0
    """Of the camera's height above the road; its place on the vehicle is as stated."""
    clock_error_s: Delay = 0.0
    """Pictures are taken this much after the time that they and their poses are stamped with."""
    read_out_s: Delay = 0.0
    """Rolling shutter: time from the first row to the last one; that of a vehicle differs by up to a fifth."""
    box_error: Share = 0.0
    """The corners of a detected sign are too far from their mean by this share."""
    box_error_mean: SignedShare = 0.0
    """Mean of that, common to all vehicles."""
    corner_error_px: PixelsOrNone = 0.0
    """A shift of all detected corners in u and in v."""
    lane_error_m: LengthOrNone = 0.0
    """Detected lane points lie this far to the left of the marker's middle, as the driver sees it."""
    one_detector: bool = False
    """True: vehicles of one rig have the same detector, with the same errors of boxes, corners and lane points."""


@dataclass(frozen=True)
class VehicleErrors:
    """Truth minus what rig.yaml says, and the habits of the detector."""

    mount_rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation vector of the true camera about the axes of the stated one."""
    mount_place_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Place of the true camera in the frame of the stated one: `T_link_true = T_link_stated [Exp(rotation), place]`."""
    focal_share: float = 0.0
    """True fx and fy are the stated ones times 1 + this."""
    principal_point_px: tuple[float, float] = (0.0, 0.0)
    """True minus stated."""
    camera_height_m: float = 0.0
    """True minus stated height above the road."""
    clock_s: float = 0.0
    """A picture is taken at its stamp plus this; its pose is that at the stamp."""
    read_out_s: float = 0.0
    """Row v is exposed this times (v / height - 1/2) after the picture's time."""
    box_share: float = 0.0
    """Detected corners are their mean plus 1 + this times what they are away from it."""
    corner_px: tuple[float, float] = (0.0, 0.0)
    """Detected minus true corners."""
    lane_left_m: float = 0.0
    """Detected points of markers along the road lie to the left by this, as the driver sees it."""


NO_ERRORS = VehicleErrors()


@dataclass(frozen=True)
class Vehicle:
    """A vehicle that drives several journeys."""

    vehicle_id: str
    rig: SimulatedRig
    """As rig.yaml states it."""
    errors: VehicleErrors

    @property
    def true_rig(self) -> SimulatedRig:
        """The rig as it really is."""
        errors, rig = self.errors, self.rig
        turn = np.radians(errors.mount_rotation_deg)
        R = se3.so3_exp(torch.from_numpy(turn)).numpy()
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, errors.mount_place_m
        K = rig.camera.K.clone()
        K[0, 0] *= 1 + errors.focal_share
        K[1, 1] *= 1 + errors.focal_share
        K[:2, 2] += torch.tensor(errors.principal_point_px, dtype=K.dtype)
        return replace(
            rig,
            camera=replace(rig.camera, K=K),
            R_body_camera=rig.R_body_camera @ R,
            camera_height=rig.camera_height + errors.camera_height_m,
            T_link_camera=rig.T_link_camera @ T,
        )


def build_vehicle(
    config: FleetConfig,
    index: int,
    rig: SimulatedRig,
    rng: np.random.Generator,
    detector_rng: np.random.Generator,
) -> Vehicle:
    """The `index`-th vehicle of the fleet; what is drawn of one error does not depend on the sizes of the others."""
    mount, place = rng.normal(size=3), rng.normal(size=3)
    focal, principal, height, clock = rng.normal(), rng.normal(size=2), rng.normal(), rng.normal()
    read_out = config.read_out_s * rng.uniform(0.8, 1.2)
    box, corner, lane = detector_rng.normal(), detector_rng.normal(size=2), detector_rng.normal()
    errors = VehicleErrors(
        mount_rotation_deg=_three(config.mount_error_deg * mount),
        mount_place_m=_three(config.mount_error_m * place),
        focal_share=_drawn(config.focal_error * focal),
        principal_point_px=_two(config.principal_error_px * principal),
        camera_height_m=_drawn(config.height_error_m * height),
        clock_s=_drawn(config.clock_error_s * clock),
        read_out_s=read_out,
        box_share=config.box_error_mean + config.box_error * box,
        corner_px=_two(config.corner_error_px * corner),
        lane_left_m=_drawn(config.lane_error_m * lane),
    )
    return Vehicle(f"vehicle-{letters(index)}", rig, errors)


def _drawn(value: float) -> float:
    """A number as it is written down: zero has no sign."""
    return float(value) + 0.0


def _two(values: Float[np.ndarray, " 2"]) -> tuple[float, float]:
    u, v = values.tolist()
    return _drawn(u), _drawn(v)


def _three(values: Float[np.ndarray, " 3"]) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return _drawn(x), _drawn(y), _drawn(z)
