"""Rigs on disk: `rig.yaml` and the mount beside it (FORMAT.md)."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.geometry.camera import COEFFICIENT_COUNTS, MODELS, Camera, closing_share
from crowdmap_torch.io.budget import read_bytes
from crowdmap_torch.io.documents import Document, read_yaml
from crowdmap_torch.io.errors import InputError, one_line
from crowdmap_torch.io.faults import attempted
from crowdmap_torch.tables import Rig

MIN_CLOSING_SHARE = 0.9
"""A lens whose undistortion closes on a smaller share of the image is refused."""
MAX_SIDE_PX = 32_768
"""No camera's image is wider or higher; more is a slip of the keyboard."""
MAX_FOCAL_PX = 1e6
"""No camera of a car sees as narrow an angle, and no image's centre is as far off it."""
MAX_COEFFICIENT = 1e6
"""Of distortion: whatever is larger folds the whole image."""
MIN_HEIGHT_M, MAX_HEIGHT_M = 0.01, 1e4
"""Of a camera over its road, units that are mistaken included: those are warned of."""
MAX_MOUNT_M = 100.0
"""No camera sits further from the link whose pose is known."""
UNIT_TOLERANCE = 1e-3
"""How far from 1 the length of a unit vector or quaternion may be."""


def read_rig(folder: Path) -> Rig:
    """The rig of a folder of `rigs/`; InputError for what breaks FORMAT.md."""
    if not folder.is_dir():
        raise missing_rig(folder)
    rig = read_yaml(folder / "rig.yaml")
    rig.allow(("camera", "road"), ("mount",))
    camera = _read_camera(rig.part("camera"))
    normal, height = _read_road(rig.part("road"))
    T_link_camera = torch.eye(4, dtype=torch.float64)
    if "mount" in rig.content:
        T_link_camera = _read_mount(rig.part("mount"), folder)
    return Rig(
        rig_id=folder.name,
        camera=camera,
        T_link_camera=T_link_camera,
        road_normal_camera=normal,
        camera_height=height,
    )


def read_camera(folder: Path) -> Camera:
    """The camera of a rig whose road need not be calibrated yet; InputError for what breaks FORMAT.md."""
    rig = read_yaml(folder / "rig.yaml")
    rig.allow(("camera",), ("road", "mount"))
    return _read_camera(rig.part("camera"))


def missing_rig(folder: Path) -> InputError:
    """What is said of a rig that is not there."""
    rule = f"{folder}: the rig's folder is missing; expected rig.yaml in it"
    return InputError(rule, "missing-file")


def faults_of_rig(folder: Path) -> Camera | None:
    """Gathers the faults of rig.yaml; the camera, if it can be used."""
    path, camera = folder / "rig.yaml", None
    with attempted(path):
        rig = read_yaml(path)
        rig.allow(("camera", "road"), ("mount",))
        with attempted(path):
            camera = _read_camera(rig.part("camera"))
        with attempted(path):
            _read_road(rig.part("road"))
        with attempted(path):
            if "mount" in rig.content:
                _read_mount(rig.part("mount"), folder)
    return camera


def rig_yaml(
    camera: Camera,
    road_normal_camera: Iterable[float],
    camera_height: float,
    mount: tuple[str, str, str] | None = None,
) -> str:
    """The text of rig.yaml; `mount` are its URDF file, the link of the poses and that of the camera."""
    lines = []
    for name, section in _sections(camera, road_normal_camera, camera_height).items():
        lines += [f"{name}:", *(f"  {k}: {v}" for k, v in section.items())]
    if mount is not None:
        names = ("urdf", "pose_link", "camera_link")
        lines += ["mount:", *(f"  {k}: {v}" for k, v in zip(names, mount, strict=True))]
    return "\n".join(lines) + "\n"


def mount_urdf(
    name: str, joints: tuple[tuple[str, str, tuple[float, ...], tuple[float, ...]], ...]
) -> str:
    """The text of a mount's URDF: joints that are fixed, each its parent, child, xyz [m] and rpy [rad]."""
    links = sorted({link for parent, child, _, _ in joints for link in (parent, child)})
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', f'<robot name="{name}">']
    lines += [f'  <link name="{link}"/>' for link in links]
    for parent, child, xyz, rpy in joints:
        lines += [
            f'  <joint name="{child}_joint" type="fixed">',
            f'    <parent link="{parent}"/>',
            f'    <child link="{child}"/>',
            f'    <origin xyz="{_numbers(xyz)}" rpy="{_numbers(rpy)}"/>',
            "  </joint>",
        ]
    return "\n".join([*lines, "</robot>"]) + "\n"


def refuse_unreadable(rig: Rig, path: Path, section: str) -> None:
    """InputError, at a section of a file, unless rig.yaml and rig.urdf of this rig would be read."""
    content = _sections(rig.camera, rig.road_normal_camera.tolist(), rig.camera_height)
    document = Document(path, content, section)
    _read_camera(document.part("camera"))
    _read_road(document.part("road"))
    if rule := _too_far(rig.T_link_camera):
        raise document.fault(rule)


def _sections(
    camera: Camera, road_normal_camera: Iterable[float], camera_height: float
) -> dict[str, dict[str, object]]:
    """What rig.yaml has of a rig beside its mount."""
    K = camera.K.tolist()
    return {
        "camera": {
            "model": camera.model,
            "width": camera.width,
            "height": camera.height,
            "fx": K[0][0],
            "fy": K[1][1],
            "cx": K[0][2],
            "cy": K[1][2],
            "distortion": camera.distortion.tolist(),
        },
        "road": {"normal": [float(x) for x in road_normal_camera], "height_m": camera_height},
    }


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(repr(float(v)) for v in values)


def _read_camera(section: Document) -> Camera:
    section.allow(("model", "width", "height", "fx", "fy", "cx", "cy", "distortion"))
    model = section.text("model")
    if model not in MODELS:
        rule = f"expected one of {', '.join(MODELS)}, found {model!r}"
        section.refuse(rule, "model", "unknown-name")
    distortion = section.numbers("distortion", most=MAX_COEFFICIENT)
    if model in MODELS and len(distortion) not in (counts := COEFFICIENT_COUNTS[model]):
        much = ", ".join(map(str, counts))
        rule = f"expected {much} numbers for {model}, found {len(distortion)}"
        section.refuse(rule, "distortion", "point-count")
    fx, fy = (section.number(key, low=1.0, high=MAX_FOCAL_PX) for key in ("fx", "fy"))
    cx, cy = (section.number(key, low=-MAX_FOCAL_PX, high=MAX_FOCAL_PX) for key in ("cx", "cy"))
    width, height = (section.integer(key, low=2, high=MAX_SIDE_PX) for key in ("width", "height"))
    section.require_sound()
    camera = Camera(
        model=model,
        width=width,
        height=height,
        K=torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64),
        distortion=torch.tensor(distortion, dtype=torch.float64),
    )
    if not (share := closing_share(camera)) >= MIN_CLOSING_SHARE:
        raise section.fault(
            f"undistortion closes on {share:.0%} of the image; "
            f"expected {MIN_CLOSING_SHARE:.0%} or more. "
            "Are the coefficients in OpenCV's order, and fx, fy, cx, cy of this image size?",
            "distortion",
            "lens",
        )
    return camera


def _read_road(section: Document) -> tuple[Float[Tensor, " 3"], float]:
    section.allow(("normal", "height_m"))
    normal = torch.tensor(section.numbers("normal", 3, most=2.0), dtype=torch.float64)
    length = math.hypot(*normal.tolist())
    if abs(length - 1) > UNIT_TOLERANCE:
        section.refuse(f"expected a unit vector, found one of length {length:.6g}", "normal")
    height = section.number("height_m", low=MIN_HEIGHT_M, high=MAX_HEIGHT_M)
    section.require_sound()
    return normal / length, height


def _read_mount(section: Document, folder: Path) -> Float[Tensor, "4 4"]:
    section.allow(("urdf", "pose_link", "camera_link"))
    name, links = section.place("urdf"), [section.text(k) for k in ("pose_link", "camera_link")]
    section.require_sound()
    # It brings matplotlib along, half a second, which workers and rigs without a mount do not need.
    from crowdmap_torch.geometry.rig import camera_in_link

    path = folder / name
    # Resolved, so that neither `..` nor a link leads out of the rig's folder.
    inside = Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))
    if Path(name).is_absolute() or not inside:
        raise section.fault(f"expected a file inside the rig's folder, found {name!r}", "urdf")
    content = read_bytes(path)
    try:
        T = camera_in_link(content, *links)
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: {one_line(error)}") from error
    if rule := _too_far(T):
        raise InputError(f"{path}: {rule}")
    return T


def _too_far(T_link_camera: Float[Tensor, "4 4"]) -> str | None:
    """What is expected of a mount, if the camera is too far from the link."""
    away = float(T_link_camera[:3, 3].norm())
    if away <= MAX_MOUNT_M:
        return None
    return f"the camera is {away:.4g} m from the pose link; expected {MAX_MOUNT_M:g} m at most"
