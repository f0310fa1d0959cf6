"""Journeys' mean errors as sums over the drift of their poses, whose covariance an adjustment is asked for."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from crowdmap_torch.adjustment.bundle import Bundle


def sums_of_bias(bundle: Bundle) -> tuple[Float[Tensor, "n k 4"], Int[Tensor, " chains"], int]:
    """By node of the drift its weight in its journey's mean error; the journey of each chain; and how many there are."""
    nodes, journeys = bundle.prior.nodes, len(bundle.prior_scale)
    to_bias = bias_of_poses(bundle.values()["pose"][nodes.first])
    count = torch.bincount(nodes.journey, minlength=journeys).to(to_bias)
    of_mean = to_bias.new_zeros(len(to_bias), bundle.prior.numbers, 4)
    of_mean[:, :6] = to_bias.mT / count[nodes.journey, None, None]
    return of_mean, bundle.prior.journey_of_chain, journeys


def bias_of_poses(T_world_camera: Float[Tensor, "n 4 4"]) -> Float[Tensor, "n 4 6"]:
    """What takes the error of a pose to that of its position and of its heading."""
    matrix = T_world_camera.new_zeros(len(T_world_camera), 4, 6)
    matrix[:, :3, :3] = torch.eye(3).to(matrix)
    # The rotation is about the camera's axes; its part about world up is the heading.
    matrix[:, 3, 3:] = T_world_camera[:, 2, :3]
    return matrix
