"""Drives that took place: real poses and the real calibration of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.simulate.rigs import SimulatedRig
from crowdmap_torch.tables import Journey

_MIN_FRAMES = 10


@dataclass(frozen=True)
class Recording:
    """The poses of one drive and the camera that it was driven with."""

    journey_id: str
    rig: SimulatedRig
    """Whose poses are the camera's own."""
    t: Float[np.ndarray, " f"]
    """Seconds since the first pose."""
    T_world_camera: Float[np.ndarray, "f 4 4"]

    def way_m(self) -> Float[np.ndarray, "f 3"]:
        """Points of the road below the camera."""
        R, p = self.T_world_camera[:, :3, :3], self.T_world_camera[:, :3, 3]
        return p + self.rig.camera_height * (R @ self.rig.road_normal_camera)


def recordings(journeys: Sequence[Journey]) -> tuple[Recording, ...]:
    """The poses and rigs of journeys, as they are stated; InputError for one that is too short."""
    found = []
    for journey in journeys:
        if journey.frame_count < _MIN_FRAMES:
            raise InputError(
                f"journey {journey.journey_id!r}: {journey.frame_count} poses; expected {_MIN_FRAMES} at least"
            )
        rig = journey.rig
        t_ns = journey.t_ns.cpu().numpy()
        found.append(
            Recording(
                journey_id=journey.journey_id,
                rig=SimulatedRig(
                    rig_id=rig.rig_id,
                    camera=rig.camera,
                    R_body_camera=_body(rig.road_normal_camera.cpu().numpy()),
                    camera_height=float(rig.camera_height),
                    T_link_camera=np.eye(4),
                    urdf=None,
                    pose_link=None,
                ),
                t=(t_ns - t_ns[0]) / 1e9,
                T_world_camera=journey.T_world_camera.cpu().numpy(),
            )
        )
    return tuple(found)


def _body(normal: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Axes of the level vehicle in the camera: forward, left, up, given the normal towards the road."""
    up = -normal / np.linalg.norm(normal)
    forward = np.array([0.0, 0.0, 1.0]) - up[2] * up
    forward = forward / np.linalg.norm(forward)
    return np.stack((forward, np.cross(up, forward), up))
