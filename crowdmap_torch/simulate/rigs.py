"""Camera rigs: lenses, and where the camera sits on the vehicle; the mount as a URDF."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.io.rigs import mount_urdf
from crowdmap_torch.ranges import Angle, Count, Focal, LengthOrNone, Settings, Side

R_FORWARD_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Axes of a camera that looks straight ahead, in the vehicle's (forward, left, up)."""


@dataclass(frozen=True)
class RigConfig(Settings):
    """The fleet's cameras."""

    rigs: Count = 2
    """Different rigs in the fleet; the first has no mount file, the others have one."""
    camera: str = "brown"
    """`brown`, `pinhole` or `fisheye`."""
    focal_px: Focal = 1000.0
    """Focal length; each rig's differs by up to 3 %. A fisheye's is 0.7 times as long."""
    width: Side = 1280
    height: Side = 800
    camera_height_m: LengthOrNone = 1.45
    camera_pitch_deg: Angle = 1.0
    """How far the camera looks down; each rig's differs by up to half a degree."""


@dataclass(frozen=True)
class SimulatedRig:
    """A rig as it was calibrated; `urdf` is None for poses that are the camera's own."""

    rig_id: str
    camera: Camera
    R_body_camera: Float[np.ndarray, "3 3"]
    """Camera axes in the level vehicle's (forward, left, up)."""
    camera_height: float
    """Of the camera's centre above the road [m]."""
    T_link_camera: Float[np.ndarray, "4 4"]
    urdf: str | None
    pose_link: str | None

    @property
    def road_normal_camera(self) -> Float[np.ndarray, " 3"]:
        """Unit normal from the camera towards the road while the vehicle stands level."""
        return -self.R_body_camera[2]


def build_rig(config: RigConfig, index: int, rng: np.random.Generator) -> SimulatedRig:
    """The `index`-th rig of the fleet."""
    camera = _camera(config, rng)
    pitch, yaw, roll = np.radians(
        [config.camera_pitch_deg + rng.uniform(-0.5, 0.5), *rng.uniform(-0.5, 0.5, 2)]
    )
    height = config.camera_height_m + rng.uniform(-0.05, 0.05)
    rpy = (roll, pitch, yaw)
    R_body_camera = rotation_from_rpy(*rpy) @ R_FORWARD_OPTICAL
    rig_id = f"rig-{letters(index)}"
    if index == 0:
        return SimulatedRig(rig_id, camera, R_body_camera, height, np.eye(4), None, None)
    forward, left = rng.uniform(1.4, 1.9), rng.uniform(-0.1, 0.1)
    joints = (
        ("base_link", "roof_mount", (forward, left, height - 0.1), (0.0, 0.0, 0.0)),
        ("roof_mount", "camera_housing", (0.0, 0.0, 0.1), rpy),
        ("camera_housing", "camera_optical", (0.0, 0.0, 0.0), (-np.pi / 2, 0.0, -np.pi / 2)),
        ("base_link", "imu_link", (0.3, -0.2, 0.5), (0.0, 0.0, np.pi)),
    )
    T_base_camera = np.eye(4)
    for _, _, xyz, angles in joints[:3]:
        T_base_camera = T_base_camera @ _transform(xyz, angles)
    pose_link = "base_link" if index % 2 else "imu_link"
    T_base_link = np.eye(4) if index % 2 else _transform(*joints[3][2:])
    return SimulatedRig(
        rig_id=rig_id,
        camera=camera,
        R_body_camera=R_body_camera,
        camera_height=height,
        T_link_camera=np.linalg.inv(T_base_link) @ T_base_camera,
        urdf=mount_urdf(rig_id, joints),
        pose_link=pose_link,
    )


def _camera(config: RigConfig, rng: np.random.Generator) -> Camera:
    focal = config.focal_px * rng.uniform(0.97, 1.03)
    spread = rng.uniform(0.9, 1.1, 4)
    if config.camera == "fisheye":
        focal *= 0.7
        model, distortion = "kannala_brandt", np.array([-0.02, 0.006, -0.003, 0.0006]) * spread
    elif config.camera == "brown":
        # A mild barrel, monotonic well beyond the image's corners.
        model = "brown_conrady"
        distortion = np.array([-0.12, 0.02, 4e-4, -3e-4]) * spread
    elif config.camera == "pinhole":
        model, distortion = "brown_conrady", np.zeros(0)
    else:
        raise ValueError(f"camera {config.camera!r}: expected one of 'brown', 'pinhole', 'fisheye'")
    cx = (config.width - 1) / 2 + rng.uniform(-8, 8)
    cy = (config.height - 1) / 2 + rng.uniform(-8, 8)
    K = torch.tensor([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return Camera(model, config.width, config.height, K, torch.from_numpy(distortion))


def letters(index: int) -> str:
    """The `index`-th of a, b, ..., z, aa, ab, ...: what rigs and vehicles are named by."""
    name = ""
    while index >= 0:
        name = "abcdefghijklmnopqrstuvwxyz"[index % 26] + name
        index = index // 26 - 1
    return name


def rotation_from_rpy(roll: float, pitch: float, yaw: float) -> Float[np.ndarray, "3 3"]:
    """`Rz(yaw) Ry(pitch) Rx(roll)`, the order of a URDF's `rpy`."""
    cr, sr = np.cos(roll), np.sin(roll)
    cp, sp = np.cos(pitch), np.sin(pitch)
    cy, sy = np.cos(yaw), np.sin(yaw)
    Rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    Ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    Rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return Rz @ Ry @ Rx


def _transform(xyz: tuple[float, ...], rpy: tuple[float, ...]) -> Float[np.ndarray, "4 4"]:
    T = np.eye(4)
    T[:3, :3] = rotation_from_rpy(*rpy)
    T[:3, 3] = xyz
    return T
