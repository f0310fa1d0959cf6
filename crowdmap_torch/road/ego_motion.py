"""The motion of the calibrated camera as poses alone tell it, and its tilt against gravity (IV-C).

The *road frame* is the camera turned so that its y axis is the calibrated road normal: x right, y
down, z ahead. A normal close to y is `(beta, 1, alpha)`: alpha is the pitch (positive: the nose is
down), beta the roll against calibration. Were the road level, poses would give both; what is
missing is the road's own slope ahead and to the right. Slopes, not angles: tangents.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.processes.sums import running_sum
from crowdmap_torch.tables import Journey, Rig


@dataclass(frozen=True)
class EgoMotion:
    """What poses alone say of each frame of a journey; all of it known when the frame comes in."""

    R_road_camera: Float[Tensor, "3 3"]
    """From the camera to the road frame, the same in every frame."""
    R_world_road: Float[Tensor, "f 3 3"]
    position: Float[Tensor, "f 3"]
    """Of the camera's centre [m]."""
    t_s: Float[Tensor, " f"]
    """Seconds since the first frame."""
    alpha: Float[Tensor, " f"]
    """Pitch of the normal if the road were level."""
    beta: Float[Tensor, " f"]
    """Roll likewise."""
    advance: Float[Tensor, " f"]
    """Way ahead since the frame before [m]; negative backwards, 0 in the first frame. Sums up to no
    more than noise at a stand."""
    turn: Float[Tensor, " f"]
    """Change of heading since the frame before, positive to the right [rad]."""

    def __len__(self) -> int:
        return len(self.alpha)

    def __getitem__(self, index: slice) -> EgoMotion:
        """The frames at `index`."""
        columns = {
            f.name: getattr(self, f.name)[index] for f in fields(self) if f.name != "R_road_camera"
        }
        return replace(self, **columns)

    @property
    def station(self) -> Float[Tensor, " f"]:
        """Way ahead since the first frame [m]."""
        return running_sum(self.advance)


def motion_of(journey: Journey) -> EgoMotion:
    """The motion of a journey's camera."""
    return motion_of_poses(journey.T_world_camera, journey.t_ns, road_frame(journey.rig))


def motion_of_poses(
    T_world_camera: Float[Tensor, "f 4 4"], t_ns: Tensor, R_road_camera: Float[Tensor, "3 3"]
) -> EgoMotion:
    """The motion of a camera with given poses."""
    R = T_world_camera[:, :3, :3] @ R_road_camera.T
    position = T_world_camera[:, :3, 3]
    # Row 2: the world's up axis in the road frame; its y is about -1.
    up = R[:, 2]
    ahead = R[:, :, 2]
    heading = torch.atan2(ahead[:, 1], ahead[:, 0])
    # The middle of both frames' directions: a chord of the curve between them.
    chord = torch.nn.functional.normalize(ahead[1:] + ahead[:-1], dim=-1)
    zero = heading[:1] * 0
    turn = torch.remainder(heading[:-1] - heading[1:] + torch.pi, 2 * torch.pi) - torch.pi
    return EgoMotion(
        R_road_camera=R_road_camera,
        R_world_road=R,
        position=position,
        t_s=(t_ns - t_ns[:1]).to(position) * 1e-9,
        alpha=up[:, 2] / up[:, 1],
        beta=up[:, 0] / up[:, 1],
        advance=torch.cat((zero, (chord * (position[1:] - position[:-1])).sum(-1))),
        turn=torch.cat((zero, turn)),
    )


def road_frame(rig: Rig) -> Float[Tensor, "3 3"]:
    """R_road_camera of a rig: y along the calibrated normal, z ahead in the calibrated plane."""
    y = torch.nn.functional.normalize(rig.road_normal_camera, dim=-1)
    axis = torch.zeros_like(y)
    axis[2] = 1
    z = torch.nn.functional.normalize(axis - (axis * y).sum() * y, dim=-1)
    return torch.stack((torch.linalg.cross(y, z), y, z))


def normal_camera(
    alpha: Float[Tensor, " f"], beta: Float[Tensor, " f"], R_road_camera: Float[Tensor, "3 3"]
) -> Float[Tensor, "f 3"]:
    """Unit normals in the camera frame of a pitch and a roll."""
    n = torch.stack((beta, torch.ones_like(alpha), alpha), dim=-1)
    return torch.nn.functional.normalize(n, dim=-1) @ R_road_camera


def slopes_of_normal(
    normal_camera: Float[Tensor, "f 3"], R_road_camera: Float[Tensor, "3 3"]
) -> tuple[Float[Tensor, " f"], Float[Tensor, " f"]]:
    """Pitch and roll of normals, the inverse of `normal_camera`."""
    n = normal_camera @ R_road_camera.T
    return n[:, 2] / n[:, 1], n[:, 0] / n[:, 1]
