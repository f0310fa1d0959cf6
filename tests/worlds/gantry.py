"""A straight road with signs that are alike over its lanes, and who triangulated which of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from worlds import lane_world
from worlds.small_world import Builder

from crowdmap_torch.crowd_signs.gather import CrowdSigns
from crowdmap_torch.tables import Journey, Lanes

BESIDE_M = 2.0
"""The signs are so far beside each other."""
MARKERS = (-5.4, -1.8, 1.8, 5.4)
"""Where the markers are, to the left of the road's middle [m]."""
_LENGTH, _AT = 401, 250.0


def gantry(
    build: Builder, seen: Sequence[Sequence[int]], bias: Tensor, *, extra: Sequence[int] = ()
) -> tuple[list[Journey], CrowdSigns, list[Lanes]]:
    """Drives with their poses' `bias`, what signs of the gantry they triangulated, and the road's markers in pieces.

    Signs are numbered from the right; the drives `extra` have one more sign 100 m before the gantry.
    """
    rows = [(d, 0.0, BESIDE_M * (k - 1), 6.0) for d, row in enumerate(seen) for k in row]
    rows += [(d, -100.0, -9.0, 2.5) for d in extra]
    table = torch.tensor(rows, dtype=torch.float64)
    journey, count = table[:, 0].long(), len(seen)
    center = table[:, 1:] + torch.tensor([_AT, 0.0, 0.0]) + bias[journey]
    number = torch.arange(len(rows))
    signs = build.signs(center, size=(1.0, 1.0), sigma=0.1)
    signs = replace(signs, journey=journey, tracklet=number, n_journeys=0 * number + 1)
    station = _AT + table[:, 1] - 10
    view = torch.stack((station, 0 * station, 0 * station + 1.5), dim=1) + bias[journey]
    east = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    pairs = torch.combinations(number)
    together = (journey[pairs[:, 0]] == journey[pairs[:, 1]]) & (
        table[pairs[:, 0], 1] == table[pairs[:, 1], 1]
    )
    drives = [
        build.drive(f"drive-{d}", frames=_LENGTH, bias=tuple(of.tolist())).journey
        for d, of in enumerate(bias)
    ]
    path = torch.cat([drive.T_world_camera[::4, :3, 3] for drive in drives])
    crowd = CrowdSigns(
        signs=signs,
        station=station,
        view_position=view,
        view_direction=east.expand(len(rows), 3),
        seen_together=pairs[together],
        leap=torch.zeros(count, dtype=torch.float64),
        bias_sigma=torch.tensor([1.0, 1.0, 1.0], dtype=torch.float64).expand(count, 3),
        path_journey=torch.repeat_interleave(torch.arange(count), len(path) // count),
        path_position=path,
        path_direction=east.expand(len(path), 3),
    )
    return drives, crowd, [_pieces(d, of) for d, of in enumerate(bias)]


def _pieces(drive: int, bias: Tensor) -> Lanes:
    s, rng = np.arange(0.0, _LENGTH, 10.0), np.random.default_rng(drive)
    lines = [np.stack((s, 0 * s + y, 0 * s), axis=1) + bias.numpy() for y in MARKERS]
    lines = [line + 0.03 * rng.normal(size=line.shape) for line in lines]
    each = len(lines)
    return lane_world.pieces(
        lines, type=[0] * each, journey=[drive] * each, tracklet=[*range(each)], frame=[50] * each
    )
