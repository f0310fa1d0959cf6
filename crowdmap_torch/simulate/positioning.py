"""The positioning module: true poses with a bias, a slow drift and white noise; its own sigmas."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.signal import lfilter

from crowdmap_torch.geometry import se3
from crowdmap_torch.ranges import Degrees, Factor, LengthOrNone, Offset, Settings

_DRIFT_STEP_M = 0.1
"""Way between the samples of a drift."""


@dataclass(frozen=True)
class PositioningConfig(Settings):
    """Errors of poses; every sigma is per axis and stationary."""

    bias_e_m: LengthOrNone = 0.30
    """1-sigma of a journey's constant bias to the east."""
    bias_n_m: LengthOrNone = 0.30
    bias_u_m: LengthOrNone = 0.42
    drift_m: LengthOrNone = 0.25
    """1-sigma of the Ornstein-Uhlenbeck drift of the position, east, north and up alike."""
    drift_length_m: LengthOrNone = 150.0
    """Distance travelled over which its correlation falls to 1/e."""
    drift_rot_deg: Degrees = 0.15
    """1-sigma of the drift of the rotation about each axis of the link."""
    drift_rot_length_m: LengthOrNone = 100.0
    white_e_m: LengthOrNone = 0.015
    """1-sigma of the noise from frame to frame, which goes on at a standstill."""
    white_n_m: LengthOrNone = 0.015
    white_u_m: LengthOrNone = 0.02
    white_rot_deg: Degrees = 0.02
    shared_bias_e_m: Offset = 0.0
    """A bias that all journeys share; nobody can average it away."""
    shared_bias_n_m: Offset = 0.0
    shared_bias_u_m: Offset = 0.0
    sigma_scale: Factor = 1.0
    """What the module's own sigmas are multiplied with; other than 1 they are wrong."""
    sigmas: bool = True
    """False: the sigma columns are left out."""


POSITIONING_PRESETS: dict[str, PositioningConfig] = {
    "paper": PositioningConfig(),
    "consumer": replace(PositioningConfig(), bias_e_m=0.85, bias_n_m=0.85, bias_u_m=1.2),
}


@dataclass(frozen=True)
class PoseError:
    """The error of each frame: `measured = retract(true, error)`."""

    translation: Float[np.ndarray, "f 3"]
    """East, north, up [m]."""
    rotation: Float[np.ndarray, "f 3"]
    """About the axes of the link [rad]."""


def pose_errors(
    distance: Float[np.ndarray, " f"], config: PositioningConfig, rng: np.random.Generator
) -> PoseError:
    """A draw of one journey's errors.

    `distance` is the way travelled up to each frame: a drift stands still with the car.
    """
    frames = len(distance)
    bias_sigma = (config.bias_e_m, config.bias_n_m, config.bias_u_m)
    shared = (config.shared_bias_e_m, config.shared_bias_n_m, config.shared_bias_u_m)
    white_sigma = (config.white_e_m, config.white_n_m, config.white_u_m)
    bias = np.array(shared) + rng.normal(size=3) * bias_sigma
    drift = config.drift_m * _drift(distance, config.drift_length_m, rng)
    turn = np.radians(config.drift_rot_deg) * _drift(distance, config.drift_rot_length_m, rng)
    return PoseError(
        translation=bias + drift + rng.normal(size=(frames, 3)) * white_sigma,
        rotation=turn + np.radians(config.white_rot_deg) * rng.normal(size=(frames, 3)),
    )


def measured_poses(
    T_world_link: Float[np.ndarray, "f 4 4"], error: PoseError
) -> Float[np.ndarray, "f 4 4"]:
    """What the module reports for true poses."""
    xi = torch.from_numpy(np.concatenate((error.translation, error.rotation), axis=-1))
    return se3.retract(torch.from_numpy(T_world_link), xi).numpy()


def reported_sigmas(config: PositioningConfig) -> tuple[Float[np.ndarray, " 3"], float] | None:
    """The module's own 1-sigma of position (e, n, u) and rotation [rad]; None if it is silent."""
    if not config.sigmas:
        return None
    bias = np.array([config.bias_e_m, config.bias_n_m, config.bias_u_m])
    white = np.array([config.white_e_m, config.white_n_m, config.white_u_m])
    position = np.sqrt(bias**2 + config.drift_m**2 + white**2)
    rotation = np.radians(np.hypot(config.drift_rot_deg, config.white_rot_deg))
    return config.sigma_scale * position, float(config.sigma_scale * rotation)


def _drift(
    distance: Float[np.ndarray, " f"], length: float, rng: np.random.Generator
) -> Float[np.ndarray, "f 3"]:
    """A stationary Ornstein-Uhlenbeck process of unit variance along the way, in three axes."""
    samples = int(distance[-1] / _DRIFT_STEP_M) + 2
    keep = np.exp(-_DRIFT_STEP_M / length)
    push = rng.normal(size=(samples, 3)) * np.sqrt(1 - keep**2)
    push[0] /= np.sqrt(
        1 - keep**2
    )  # the first sample has the full variance: stationary from the start
    process = lfilter([1.0], [1.0, -keep], push, axis=0)
    return np.asarray(process)[np.rint(distance / _DRIFT_STEP_M).astype(np.int64)]
