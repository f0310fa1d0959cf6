"""A camera in a garage: surveyed points on a wall and a floor, and their exact pixels in several pictures."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import torch

from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.camera import project
from crowdmap_torch.io.rigs import read_rig

F64 = torch.float64
RIG = """# our first car
camera:
  model: brown_conrady
  width: 1280
  height: 800
  fx: 1000.0
  fy: 1000.0
  cx: 639.5
  cy: 399.5
  distortion: [-0.12, 0.02, 0.0004, -0.0003]
road:
  normal: [0.0, 1.0, 0.0]   # a guess

  height_m: 1.4
# poses are the camera's own
"""
NORMAL = torch.nn.functional.normalize(torch.tensor([0.01, 1.0, 0.03], dtype=F64), dim=-1)
HEIGHT = 1.47
WALL = [(x, 6.0, z) for x in (-2.5, -1.2, 0.1, 1.3, 2.4) for z in (0.7, 2.1)]
FLOOR = [(-1.6, 4.6, 0.0), (0.2, 4.3, 0.0), (1.7, 4.8, 0.0), (-0.9, 5.3, 0.0), (0.9, 5.5, 0.0)]
PLACES = [(0.0, 0.0, 0.0), (0.3, -0.4, 0.05), (-0.4, 0.3, -0.06), (0.1, 0.5, 0.1)]


def camera_pose(x: float, y: float, yaw: float) -> torch.Tensor:
    """T_room_camera of a car that stands level on the floor, in a room that is not."""
    z = torch.tensor([0.0, 0.0, 1.0], dtype=F64)
    ahead = torch.nn.functional.normalize(z - (z @ NORMAL) * NORMAL, dim=-1)
    R_camera_car = torch.stack((torch.linalg.cross(NORMAL, ahead), NORMAL, ahead), dim=-1)
    c, s = math.cos(yaw), math.sin(yaw)
    R_room_car = torch.tensor([[c, 0, -s], [s, 0, c], [0, -1, 0]], dtype=F64)
    return se3.make(R_room_car @ R_camera_car.T, torch.tensor([x, y, HEIGHT], dtype=F64))


def write_garage(folder: Path) -> Path:
    """A rig, and tables of exact pixels: `rig-a`, `points.csv` and `pixels.csv`; returns `folder`."""
    (folder / "rig-a").mkdir(parents=True)
    (folder / "rig-a" / "rig.yaml").write_text(RIG)
    camera = read_rig(folder / "rig-a").camera
    # The surveyor's frame leans: only points say where the floor is.
    lean = se3.exp(torch.tensor([10.0, -4.0, 2.0, 0.2, -0.1, 0.5], dtype=F64))
    points = [*((f"w{k}", p, "wall") for k, p in enumerate(WALL))]
    points += [(f"f{k}", p, "floor") for k, p in enumerate(FLOOR)]
    with (folder / "points.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("point", "x", "y", "z", "surface"))
        for name, p, surface in points:
            at = se3.transform(lean, torch.tensor(p, dtype=F64)).tolist()
            writer.writerow((name, *map(repr, at), surface))
    with (folder / "pixels.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("picture", "point", "u", "v"))
        for number, place in enumerate(PLACES):
            T_camera_room = se3.inverse(camera_pose(*place))
            for name, p, _ in points:
                in_camera = se3.transform(T_camera_room, torch.tensor(p, dtype=F64))
                px, visible = project(camera, in_camera)
                if bool(visible):
                    writer.writerow((f"img{number}", name, *map(repr, px.tolist())))
    return folder
