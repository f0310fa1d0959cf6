"""A short drive as other people's files, small enough to know every number."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

RIG = """
camera: {model: brown_conrady, width: 640, height: 480, fx: 500, fy: 500, cx: 319.5, cy: 239.5, distortion: []}
road: {normal: [0, 1, 0], height_m: 1.5}
"""
URDF = """<robot name="car"><link name="base"/><link name="eye"/><joint name="j" type="fixed">
<parent link="base"/><child link="eye"/>
<origin xyz="1 0 0.5" rpy="-1.5707963267948966 0 -1.5707963267948966"/></joint></robot>
"""
FRAMES = 6
IMAGES = tuple(f"front/{k:03d}.jpg" for k in range(FRAMES))
HALF = 0.5**0.5


def north(k: int) -> tuple[float, float, float]:
    """Where the camera is in frame k: it looks north, level, and drives a metre a frame."""
    return (10.0, 20.0 + k, 1.5)


def write_rig(folder: Path, *, mount: bool = False) -> Path:
    """A rig of a level camera; with a mount it is a metre ahead of the base link and half a metre above it."""
    folder.mkdir(parents=True, exist_ok=True)
    text = RIG + ("mount: {urdf: car.urdf, pose_link: base, camera_link: eye}\n" if mount else "")
    (folder / "rig.yaml").write_text(text)
    if mount:
        (folder / "car.urdf").write_text(URDF)
    return folder


def write_tum(path: Path, *, start_s: float = 100.0, every_s: float = 0.1) -> Path:
    """The camera's own poses in East-North-Up."""
    lines = [
        f"{start_s + every_s * k:.3f} " + " ".join(map(str, (*north(k), -HALF, 0, 0, HALF)))
        for k in range(FRAMES)
    ]
    path.write_text("# t x y z qx qy qz qw\n" + "\n".join(lines) + "\n")
    return path


def coco(**changes: Any) -> dict[str, Any]:
    """A stop sign as a box in the third image, and a yield sign by its corners in the fourth."""
    content = {
        "images": [
            {"id": 10 + k, "file_name": name, "width": 640, "height": 480}
            for k, name in enumerate(IMAGES)
        ],
        "categories": [
            {"id": 1, "name": "regulatory--stop--g1"},
            {"id": 2, "name": "regulatory--yield--g1"},
        ],
        "annotations": [
            {
                "id": 1,
                "image_id": 12,
                "category_id": 1,
                "bbox": [100.5, 200.5, 30, 40],
                "score": 0.5,
            },
            {
                "id": 2,
                "image_id": 13,
                "category_id": 2,
                "bbox": [300, 100, 20, 20],
                # Anticlockwise in the image.
                "keypoints": [300, 100, 2, 310, 120, 2, 320, 100, 2],
                "track_id": 7,
            },
        ],
    }
    return content | changes


def write_json(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def write_tusimple(path: Path) -> Path:
    """Two markers in the first image, one of them with a single point; none in the others."""
    rows = [400, 420, 440]
    lanes = [[-2, 300, 290.5], [-2, -2, 400]]
    content = [
        {"raw_file": name, "lanes": lanes if k == 0 else [], "h_samples": rows}
        for k, name in enumerate(IMAGES)
    ]
    path.write_text("".join(f"{json.dumps(one)}\n" for one in content))
    return path


def camera_poses() -> np.ndarray:
    """What the poses of `write_tum` are as matrices T_world_camera."""
    T = np.tile(np.eye(4), (FRAMES, 1, 1))
    T[:, :3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    T[:, :3, 3] = [north(k) for k in range(FRAMES)]
    return T
