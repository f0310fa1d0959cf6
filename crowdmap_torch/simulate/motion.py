"""The camera between its frames, and what a picture shows whose rows are not exposed at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.interpolate import CubicSpline

from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.camera import Camera, project
from crowdmap_torch.simulate.vehicle import Drive

_ROUNDS = 8
"""Rounds until a point's row and the moment of its exposure agree: each is off by a few hundredths of the one before."""


@dataclass(frozen=True)
class Motion:
    """The way of a drive's camera through the poses of its frames.

    Positions follow a cubic spline over time, rotations turn evenly from frame to frame. Before the first frame and
    after the last one the camera goes straight on and does not turn.
    """

    drive: Drive

    def poses(self, t: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 4 4"]:
        """`T_world_camera` at moments [s since the journey began]."""
        T = np.zeros((len(t), 4, 4))
        k, turn = self._turns(t)
        T[:, :3, :3] = self.drive.R_world_camera[k] @ se3.so3_exp(torch.from_numpy(turn)).numpy()
        T[:, :3, 3] = self._positions(t)
        T[:, 3, 3] = 1.0
        return T

    def in_camera(
        self, point_world: Float[np.ndarray, "*batch 3"], t: Float[np.ndarray, "*batch"]
    ) -> Float[np.ndarray, "*batch 3"]:
        """Points in the camera's frame, each at a moment of its own."""
        k, turn = self._turns(t)
        away = point_world - self._positions(t)
        p = np.einsum("...ji,...j->...i", self.drive.R_world_camera[k], away)
        R_back = se3.so3_exp(torch.from_numpy(-turn)).numpy()
        return np.einsum("...ij,...j->...i", R_back, p)

    def _positions(self, t: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch 3"]:
        within = np.clip(t, self.drive.t[0], self.drive.t[-1])
        spline = self._spline
        return spline(within) + (t - within)[..., None] * spline(within, 1)

    def _turns(
        self, t: Float[np.ndarray, "*batch"]
    ) -> tuple[Int[np.ndarray, "*batch"], Float[np.ndarray, "*batch 3"]]:
        """The frame before each moment, and the rotation vector since [rad]."""
        times = self.drive.t
        k = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
        since = np.clip(t, times[0], times[-1]) - times[k]
        return k, since[..., None] * self._rates[k]

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.drive.t, self.drive.p_world_camera)

    @cached_property
    def _rates(self) -> Float[np.ndarray, "s 3"]:
        """Turn from each frame to the next, about the camera's axes [rad/s]."""
        R = torch.from_numpy(self.drive.R_world_camera)
        turn = se3.so3_log(R[:-1].mT @ R[1:]).numpy()
        return turn / np.diff(self.drive.t)[:, None]


@dataclass(frozen=True)
class Shutter:
    """A camera on its drive: row v of a frame's picture is exposed at `t + read_out_s * (v / height - 1/2)`."""

    drive: Drive
    camera: Camera
    read_out_s: float = 0.0
    """From the first row to the last one; 0: all at once."""

    def see(
        self, point_world: Float[np.ndarray, "d k 3"], frame: Int[np.ndarray, " d"]
    ) -> tuple[Float[np.ndarray, "d k 3"], Float[np.ndarray, "d k 2"], Bool[np.ndarray, "d k"]]:
        """Points in the camera's frame as their row is exposed, their exact pixels, and which of them it sees."""
        p = point_world - self.drive.p_world_camera[frame, None]
        p_camera = p @ self.drive.R_world_camera[frame]
        px, visible = project(self.camera, torch.from_numpy(p_camera))
        if self.read_out_s == 0.0 or not len(frame):
            return p_camera, px.numpy(), visible.numpy()
        low, high = -0.5, self.camera.height - 0.5
        t = self.drive.t[frame, None]
        for _ in range(_ROUNDS):
            # What a lens makes of a point far outside its image says nothing of the moment.
            row = np.clip(np.nan_to_num(px.numpy()[..., 1]), low, high)
            late = self.read_out_s * (row / self.camera.height - 0.5)
            p_camera = self._motion.in_camera(point_world, t + late)
            px, visible = project(self.camera, torch.from_numpy(p_camera))
        return p_camera, px.numpy(), visible.numpy()

    @cached_property
    def _motion(self) -> Motion:
        return Motion(self.drive)
