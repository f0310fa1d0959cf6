"""A winding drive past signs, exact: what is wrong with it was put there."""

from __future__ import annotations

import torch
from torch import Tensor
from worlds.drives import make_journey

from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.geometry.camera import Camera, project, unproject
from crowdmap_torch.tables import Journey, Rig, SignDetections, Tracklets

K = torch.tensor([[800.0, 0, 639.5], [0, 800, 399.5], [0, 0, 1]]).double()
LENS = torch.tensor([-0.3, 0.09, 1e-4, -2e-4]).double()
CAMERA = Camera("brown_conrady", 1280, 800, K, LENS)
RIG = Rig("rig", CAMERA, torch.eye(4).double(), torch.tensor([0.0, 1, 0]).double(), 1.4)


def winding_drive(
    seed: int, *, lever: Tensor | None = None, late: int = 0, bend: float = 0.5
) -> tuple[Journey, Tracklets]:
    """A winding drive past signs, seen without noise; positions `lever` off the camera, frames numbered `late`."""
    generator = torch.Generator().manual_seed(seed)
    t = torch.arange(160).double()
    heading = bend * torch.sin(t / 18 + seed)
    ahead = torch.stack((heading.cos(), heading.sin(), torch.zeros_like(t)), dim=-1)
    down = torch.tensor([0.0, 0.0, -1.0]).double().expand_as(ahead)
    R = torch.stack((torch.linalg.cross(down, ahead), down, ahead), dim=-1)
    T = se3.make(R, (0.8 * ahead).cumsum(0))
    along = torch.randint(30, 150, (12,), generator=generator)
    aside = torch.stack((-ahead[:, 1], ahead[:, 0], torch.zeros_like(t)), dim=-1)[along]
    side = torch.where(torch.rand(12, 1, generator=generator) < 0.5, 4.0, -4.0)
    centre = T[along, :3, 3] + side * aside + torch.tensor([0.0, 0.0, 1.2]).double()
    in_camera = se3.transform(se3.inverse(T)[:, None], centre[None])
    px, visible = project(CAMERA, in_camera)
    visible &= in_camera[..., 2] < 40
    frame, sign = visible.nonzero(as_tuple=True)
    corners = (
        px[frame, sign][:, None] + torch.tensor([[-5.0, -5], [5, -5], [5, 5], [-5, 5]]).double()
    )
    corners = torch.cat((corners, corners[:, -1:].expand(-1, polygon.MAX_CORNERS - 4, 2)), dim=1)
    ideal, _ = unproject(CAMERA, corners)
    row = torch.arange(len(frame))
    seen = SignDetections(
        row, (frame + late).clamp_max(159), torch.full_like(row, 2), corners, ideal,
        torch.full_like(row, -1), torch.ones(len(row)).double(), torch.full_like(row, -1),
    )  # fmt: skip
    if lever is not None:
        T = T @ se3.make(torch.eye(3).double(), lever)
    return make_journey(RIG, T, signs=seen), Tracklets(sign, 12)
