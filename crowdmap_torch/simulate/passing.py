"""Where cars are beside markers that do not follow the stations of one road: those of a map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from crowdmap_torch.simulate.markers import STEP_M, Markers

_MIN_ALONG = 0.7
"""Cosine of the angle between a marker and a car that drives along it."""


@dataclass(frozen=True)
class Passing:
    """For each frame of a drive and each marker of the world, where the one is on the other."""

    foot: Float[np.ndarray, "f m"]
    """Parameter of the marker's point beside the camera, beyond its ends straight on; NaN where it runs across [m]."""
    sense: Float[np.ndarray, "f m"]
    """1 where the car drives as the marker's points run, -1 against them."""
    length: Float[np.ndarray, " m"]
    """Of the markers' parameters [m]."""

    def place(
        self, frame: Int[np.ndarray, "*batch"], marker: Int[np.ndarray, "*batch"]
    ) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
        """Foot and sense."""
        return self.foot[frame, marker], self.sense[frame, marker]

    def window(
        self, frame: Int[np.ndarray, "*batch"], marker: Int[np.ndarray, "*batch"]
    ) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch"]]:
        """First and last parameter of what may be in sight: the whole marker."""
        return np.zeros(marker.shape), self.length[marker]


def passing(
    markers: Markers, p_world: Float[np.ndarray, "f 3"], ahead_world: Float[np.ndarray, "f 3"]
) -> Passing:
    """Of cameras at `p_world` that look `ahead_world`."""
    ahead = ahead_world[:, :2]
    ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
    feet, senses = [], []
    for marker in range(len(markers)):
        point = markers.points_of(marker)[:, :2]
        tangent = np.gradient(point, axis=0)
        tangent = tangent / np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
        near = np.asarray(KDTree(point).query(p_world[:, :2])[1])
        beyond = np.sum((p_world[:, :2] - point[near]) * tangent[near], axis=1)
        along = np.sum(tangent[near] * ahead, axis=1)
        feet.append(np.where(np.abs(along) > _MIN_ALONG, near * STEP_M + beyond, np.nan))
        senses.append(np.sign(along))
    return Passing(np.stack(feet, axis=1), np.stack(senses, axis=1), markers.length())
