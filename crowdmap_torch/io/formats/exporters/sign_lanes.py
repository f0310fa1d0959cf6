"""Which lanes a sign is for: those that it faces, beside which it stands."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import KDTree

from crowdmap_torch.io.formats.exporters.carriageways import Carriageways
from crowdmap_torch.tables import Signs

REACH_M = 15.0
"""A sign stands no farther beside its lanes [m]."""
_MIN_FACING = 0.7
"""Cosine between the way that a sign faces and that from which its lane's traffic comes."""


def lanes_of_signs(signs: Signs, ways: Carriageways) -> list[list[int]]:
    """Cells of `ways` that each sign is for, in order; none where it stands by itself or faces nobody."""
    center = signs.center_world.detach().cpu().numpy()
    normal = torch.nn.functional.normalize(signs.normal_world.detach().cpu()[:, :2], dim=-1).numpy()
    if not ways.cells or not len(signs):
        return [[] for _ in range(len(signs))]
    point, direction, of = [], [], []
    for number, cell in enumerate(ways.cells):
        for border, is_reversed in (
            (cell.left, cell.is_left_reversed),
            (cell.right, cell.is_right_reversed),
        ):
            points = ways.points(border, is_reversed)[:, :2]
            step = np.gradient(points, axis=0)
            point.append(points)
            direction.append(step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-12))
            of.append(np.full(len(points), number))
    points, directions, owner = map(np.concatenate, (point, direction, of))
    tree = KDTree(points)
    found = []
    for row, near in enumerate(tree.query_ball_point(center[:, :2], REACH_M)):
        at = np.array(near, dtype=int)
        offset = points[at] - center[row, :2]
        ahead = np.abs(np.sum(offset * directions[at], axis=1))
        facing = directions[at] @ normal[row]
        turned = np.array([ways.cells[c].is_two_way for c in owner[at]], dtype=bool)
        faces = np.where(turned, np.abs(facing), -facing) > _MIN_FACING
        found.append(sorted({*owner[at[faces & (ahead <= 1.0)]].tolist()}))
    return found
