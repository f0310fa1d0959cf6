"""What a car is known to have wrong, put right: its rig, its poses and what its detector shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.geometry import camera, polygon, se3
from crowdmap_torch.geometry.trajectory import motion
from crowdmap_torch.tables import Journey, Rig

KnownCalibration = Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]]
"""Of one car: estimates and sigmas of the numbers of every parameter of calibration.json (FORMAT.md), in its units."""


def corrected_rig(rig: Rig, known: KnownCalibration) -> Rig:
    """The rig with what is known put right: focal length, principal point, mount and height above the road."""
    K, like = rig.camera.K.clone(), rig.T_link_camera
    K[[0, 1], [0, 1]] *= 1 + _found(known, "focal", like)
    K[:2, 2] += _found(known, "principal_px", like, 2)
    T = _turn_and_place(known, like)
    return replace(
        rig,
        camera=replace(rig.camera, K=K),
        T_link_camera=rig.T_link_camera @ T,
        road_normal_camera=T[:3, :3].mT @ rig.road_normal_camera,
        camera_height=rig.camera_height + float(_found(known, "height_m", like)),
    )


def corrected_journey(
    journey: Journey,
    known: KnownCalibration,
    moving: tuple[Float[Tensor, "f 3"], Float[Tensor, "f 3"]] | None = None,
) -> Journey:
    """The journey as it would be with what is known put right; `moving` is its frames' `motion`, None: by its own poses.

    Poses are those of the true camera when its pictures were taken, outlines of signs as large as they are, rays those of
    the true camera. Left as they are: rows that were read out early or late, for which the distance of what they show would
    have to be known, and lane points beside their marker.
    """
    like, signs, points = journey.T_world_camera, journey.signs, journey.lane_points
    rig = corrected_rig(journey.rig, known)
    velocity, turning = moving or motion(journey.T_world_camera, journey.t_ns)
    moved = torch.cat((velocity, turning), dim=-1) * _found(known, "clock_s", like)
    mask = polygon.corner_mask(signs.shape)[..., None].to(like)
    mean = (signs.corners_px * mask).sum(1, keepdim=True) / mask.sum(1, keepdim=True)
    shifted = signs.corners_px - mean
    corners = mean + shifted / (1 + _found(known, "box", like))
    corners = corners - _found(known, "corner_px", like, 2)
    return replace(
        journey,
        rig=rig,
        T_world_camera=se3.retract(journey.T_world_camera, moved) @ _turn_and_place(known, like),
        signs=replace(
            signs, corners_px=corners, corners_ideal=camera.unproject(rig.camera, corners)[0]
        ),
        lane_points=replace(points, ideal=camera.unproject(rig.camera, points.px)[0]),
    )


def _found(
    known: KnownCalibration, name: str, like: Tensor, count: int = 1
) -> Float[Tensor, " count"]:
    return like.new_tensor(known[name][0] if name in known else (0.0,) * count)


def _turn_and_place(known: KnownCalibration, like: Tensor) -> Float[Tensor, "4 4"]:
    """The true camera in the stated one's frame."""
    turn = torch.deg2rad(_found(known, "mount_deg", like, 3))
    return se3.make(se3.so3_exp(turn), _found(known, "mount_m", like, 3))
