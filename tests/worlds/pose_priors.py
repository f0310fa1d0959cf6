"""Priors of the poses of journeys along one road."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from worlds.small_world import Builder

from crowdmap_torch.noise.drift_nodes import DriftNodes
from crowdmap_torch.noise.pose_prior import PosePrior, PosePriorConfig, pose_prior
from crowdmap_torch.noise.positioning import PositioningNoise

F64 = torch.float64
WAY_M, SPACING_M = 900.0, 3.0
GIVEN = torch.tensor([0.39, 0.39, 0.49], dtype=F64)
"""What each journey's module says of its position [m]: bias and drift together."""


def make_prior(
    journeys: int,
    config: PosePriorConfig | None = None,
    *,
    way_m: float = WAY_M,
    spacing_m: float = SPACING_M,
) -> PosePrior:
    """Journeys along one road, a node every few metres, and a pose as far from it as poses are in the mean."""
    count = int(way_m / spacing_m)
    way = (spacing_m * torch.arange(count)).to(F64).repeat(journeys)
    owner = torch.arange(journeys).repeat_interleave(count)
    every = torch.arange(len(way))
    nodes = DriftNodes(every, every, owner, way, torch.full_like(way, spacing_m / 4))
    drive = Builder().drive("j", frames=3).journey
    drive = replace(
        drive,
        sigma_position=GIVEN.repeat(3, 1),
        sigma_rotation=torch.full((3,), math.radians(0.2), dtype=F64),
    )
    pose = torch.eye(4, dtype=F64).expand(len(way), 4, 4)
    return pose_prior(
        [drive] * journeys, pose, nodes, PositioningNoise(), config or PosePriorConfig()
    )
