"""Dead reckoning for a few metres: where the camera went by its heading and the way it made alone."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.optim.robust import Tukey
from crowdmap_torch.processes.sums import running_sum
from crowdmap_torch.road.ego_motion import EgoMotion

_CHORD_M = 20.0
"""Ways over which positions and headings are compared."""
_CHORD_SIGMA_M = 0.15
"""How far positions drift over one of them."""
_SLIP_SIGMA = 0.03
"""1-sigma of the camera's yaw against the direction of travel [rad]."""
_LEVER_SIGMA_M = 2.0


@dataclass(frozen=True)
class Slip:
    """How the camera moves when the car heads somewhere."""

    angle: Float[Tensor, ""]
    """From the road frame's axis ahead to the direction of travel on a straight road, positive to
    the left [rad]."""
    lever: Float[Tensor, ""]
    """How far ahead of the axle that does not steer the camera is: in a bend it swings outward
    [m]."""


def headings(motion: EgoMotion) -> Float[Tensor, " f"]:
    """Direction of the road frame's axis ahead, from east to north, without jumps [rad]."""
    ahead = motion.R_world_road[:, :2, 2]
    angle = torch.atan2(ahead[:, 1], ahead[:, 0])
    return torch.cat((angle[:1], angle[:1] - running_sum(motion.turn[1:])))


def direction(heading: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 2"]:
    """East and north of unit vectors."""
    return torch.stack((heading.cos(), heading.sin()), dim=-1)


def dead_reckon(
    motion: EgoMotion, slope: Float[Tensor, " f"], slip: Slip
) -> tuple[Float[Tensor, "f 2"], Float[Tensor, " f"]]:
    """East and north of the camera, and height of the road under it, from the first frame on."""
    heading = headings(motion)
    flat = _flat(motion, slope)
    moved = running_sum(flat[:, None] * direction(_middle(heading) + slip.angle))
    swing = slip.lever * direction(heading + slip.angle)
    return moved + swing, running_sum(flat * _middle(slope))


def fit_slip(motion: EgoMotion, slope: Float[Tensor, " f"]) -> Slip:
    """The slip for which reckoning agrees best with the measured positions, robustly over many short ways."""
    heading = headings(motion)
    flat = _flat(motion, slope)
    station = motion.station.cummax(0)[0]
    index = (station / _CHORD_M).floor()
    starts = torch.ones_like(index[:1], dtype=torch.bool)
    rows = torch.cat((starts, index[1:] > index[:-1])).nonzero()[:, 0]
    first, last = rows[:-1], rows[1:]
    reckoned = running_sum(flat[:, None] * direction(_middle(heading)))
    ahead = direction(heading)
    way = (motion.position[last] - motion.position[first])[:, :2]
    miss = way - (reckoned[last] - reckoned[first])
    middle = direction(0.5 * (heading[first] + heading[last]))
    left = torch.stack((-middle[:, 1], middle[:, 0]), dim=-1)
    length = (station[last] - station[first]).clamp_min(1e-3)
    J = torch.stack((length, ((ahead[last] - ahead[first]) * left).sum(-1)), dim=-1)
    target = (miss * left).sum(-1)
    sigma = _CHORD_SIGMA_M * (length / _CHORD_M).sqrt()
    prior = J.new_tensor([_SLIP_SIGMA, _LEVER_SIGMA_M]).square().reciprocal()
    fitted = J.new_zeros(2)
    for scale in (16.0, 4.0, 1.0, 1.0):
        residual = (target - J @ fitted) / sigma
        weight = Tukey().weight((residual / scale).square()) / sigma.square()
        A = (J * weight[:, None]).T @ J + torch.diag(prior)
        fitted = torch.linalg.solve(A, (J * weight[:, None]).T @ target)
    return Slip(fitted[0], fitted[1])


def _flat(motion: EgoMotion, slope: Float[Tensor, " f"]) -> Float[Tensor, " f"]:
    """Way ahead in the top view since the frame before."""
    return motion.advance / (1 + slope.square()).sqrt()


def _middle(value: Float[Tensor, " f"]) -> Float[Tensor, " f"]:
    return torch.cat((value[:1], 0.5 * (value[1:] + value[:-1])))
