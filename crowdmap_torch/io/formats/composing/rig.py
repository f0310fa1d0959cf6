"""The rig of a composed data set: a rig.yaml that is given, or the one that a log describes."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.io.budget import reading
from crowdmap_torch.io.documents import read_yaml
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing import axes
from crowdmap_torch.io.formats.composing.parts import Asked, CarRig, Track
from crowdmap_torch.io.rigs import mount_urdf, read_rig, rig_yaml

_LINK, _CAMERA_LINK = "pose_link", "camera_optical"
_URDF = "rig.urdf"


@dataclass(frozen=True)
class GivenRig:
    """A rig that can be written into a data set."""

    rig_id: str
    camera: Camera
    has_mount: bool
    """Whether the poses are those of the link that the mount names; they are the camera's own if not."""
    folder: Path | None
    """Where its files are; None if they are made from `described`."""
    described: CarRig | None = None

    def write(self, folder: Path) -> None:
        """`rig.yaml`, and `rig.urdf` if there is a mount."""
        folder.mkdir(parents=True)
        if self.folder is not None:
            head = read_yaml(self.folder / "rig.yaml")
            shutil.copyfile(self.folder / "rig.yaml", folder / "rig.yaml")
            if self.has_mount:
                urdf = head.part("mount").place("urdf")
                (folder / urdf).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(self.folder / urdf, folder / urdf)
            return
        assert self.described is not None
        car = self.described
        assert car.road_normal_camera is not None and car.camera_height is not None
        normal = [float(x) for x in car.road_normal_camera]
        mount = None
        if self.has_mount:
            mount = (_URDF, _LINK, _CAMERA_LINK)
            xyz, rpy = tuple(car.T_link_camera[:3, 3].tolist()), _rpy(car.T_link_camera[:3, :3])
            text = mount_urdf(self.rig_id, ((_LINK, _CAMERA_LINK, xyz, rpy),))
            (folder / _URDF).write_text(text, encoding="utf-8")
        text = rig_yaml(car.camera, normal, car.camera_height, mount)
        (folder / "rig.yaml").write_text(text, encoding="utf-8")


def read_given_rig(path: Path) -> GivenRig:
    """The rig of a rig.yaml, or of the folder that it is in; InputError for what breaks FORMAT.md."""
    folder = path if path.is_dir() else path.parent
    if path != folder and path.name != "rig.yaml":
        raise InputError(f"{path}: expected a file rig.yaml, or the folder that it is in")
    with reading(inside=folder):
        rig = read_rig(folder)
        has_mount = "mount" in read_yaml(folder / "rig.yaml").content
    name = folder.resolve().name if path == folder else "rig"
    return GivenRig(name or "rig", rig.camera, has_mount, folder)


def described_rig(car: CarRig, asked: Asked) -> GivenRig:
    """The rig that a log describes, its road under its wheels; InputError if nobody said how high the camera is."""
    height = car.camera_height if asked.camera_height is None else asked.camera_height
    if height is None:
        raise InputError(
            f"rig {car.rig_id!r}: the height of its camera over the road is not in the source; give it "
            "by --camera-height [m]"
        )
    normal = car.road_normal_camera
    if normal is None:
        # The road lies under the link: its normal is the link's z axis, downwards.
        normal = -car.T_link_camera[2, :3]
    has_mount = not np.array_equal(car.T_link_camera, np.eye(4))
    described = replace(car, road_normal_camera=normal, camera_height=height)
    return GivenRig(car.rig_id, car.camera, has_mount, None, described)


def camera_or_link_poses(track: Track, rig: GivenRig, asked: Asked) -> Float[np.ndarray, "n 4 4"]:
    """Poses in East-North-Up, as the rig wants them: of the link that its mount names, or of the camera."""
    world = _chosen(
        "--world", "its world's axes", track, track.world, asked.world, axes.WORLD_TEXTS
    )
    link = _chosen(
        "--axes", "the axes of its poses", track, track.link, asked.link, axes.LINK_TEXTS
    )
    T = axes.turned_world(track.T_world_link, world)
    if rig.has_mount != (link == "mount"):
        if rig.has_mount:
            raise InputError(
                f"rig {rig.rig_id!r} has a mount, so poses are those of its pose_link: expected --axes "
                f"mount, found {link}; or take the mount out of rig.yaml"
            )
        raise InputError(
            f"{track.source}: its poses are of a link, and rig {rig.rig_id!r} has no mount that says "
            "where the camera sits on it; add one to rig.yaml, or say --axes flu or frd and --camera-at"
        )
    if link in ("flu", "frd") and asked.camera_at is None:
        raise InputError(
            f"--axes {link}: where is the camera? Give its place in these axes by --camera-at X Y Z [m] "
            "(0 0 0 if the poses are those of its place)"
        )
    if link == "mount":
        return T
    return T @ axes.link_camera(link, asked.camera_at or (0.0, 0.0, 0.0))


def _chosen(
    option: str,
    what: str,
    track: Track,
    fixed: str | None,
    asked: str | None,
    texts: dict[str, str],
) -> str:
    if fixed is None and asked is None:
        choices = "; ".join(f"{name}: {text}" for name, text in texts.items())
        raise InputError(f"{track.source}: {what} are not in the file; give {option} ({choices})")
    if asked == "mount" and fixed == "flu":
        # Links of a URDF have their axes so.
        return asked
    if fixed is not None and asked not in (None, fixed):
        raise InputError(
            f"{track.source}: {what} are {fixed} ({texts[fixed]}), not {asked}; leave {option} out"
        )
    return fixed or asked or ""


def _rpy(R: Float[np.ndarray, "3 3"]) -> tuple[float, float, float]:
    """Roll, pitch and yaw [rad] about the fixed axes x, y and z, as URDF has them."""
    R = se3.orthonormalise(torch.from_numpy(R)).numpy()
    pitch = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    if np.hypot(R[0, 0], R[1, 0]) < 1e-9:
        # Roll and yaw turn about one axis: all of it counts as yaw.
        return 0.0, float(pitch), float(np.arctan2(-R[0, 1], R[1, 1]))
    roll, yaw = np.arctan2(R[2, 1], R[2, 2]), np.arctan2(R[1, 0], R[0, 0])
    return float(roll), float(pitch), float(yaw)
