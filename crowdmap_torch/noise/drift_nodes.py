"""Stretches of road over which what positioning gets wrong is taken to stand still: the nodes of the poses' drift."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.processes.sums import add_at


@dataclass(frozen=True)
class DriftNodes:
    """Stretches of road with one drift each: the blocks that form a journey's chain."""

    of_frame: Int[Tensor, " p"]
    """Node of each pose of the bundle."""
    first: Int[Tensor, " n"]
    """First pose of each node."""
    journey: Int[Tensor, " n"]
    way: Float[Tensor, " n"]
    """Distance travelled at the node [m]."""
    apart: Float[Tensor, " p"]
    """How far each pose of the bundle is from its node along the way [m]."""

    @property
    def journey_of_pose(self) -> Int[Tensor, " p"]:
        """Journey of each pose of the bundle."""
        return self.journey[self.of_frame]

    def mean(self, at_nodes: Float[Tensor, "n k"], journeys: int) -> Float[Tensor, "j k"]:
        """The mean over each journey's nodes; zero where it has none."""
        count = torch.bincount(self.journey, minlength=journeys).clamp_min(1)
        total = at_nodes.new_zeros(journeys, at_nodes.shape[1])
        return add_at(total, 0, self.journey, at_nodes) / count[:, None]


def drift_nodes(journey: Int[Tensor, " n"], way: Float[Tensor, " n"], spacing: float) -> DriftNodes:
    """Stretches of at most `spacing` metres in which the drift is taken to stand still."""
    cell = (way / spacing).floor()
    begins = begins_of(journey)
    begins[1:] |= cell[1:] != cell[:-1]
    of_frame = begins.cumsum(0) - 1
    first = torch.nonzero(begins)[:, 0]
    count = torch.bincount(of_frame, minlength=len(first))
    centre = add_at(way.new_zeros(len(first)), 0, of_frame, way) / count
    return DriftNodes(of_frame, first, journey[first], centre, (way - centre[of_frame]).abs())


def begins_of(journey: Int[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """True for the first row of each journey."""
    begins = torch.ones_like(journey, dtype=torch.bool)
    begins[1:] = journey[1:] != journey[:-1]
    return begins
