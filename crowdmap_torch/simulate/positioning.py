"""The positioning module: true poses with a wandering bias, drift, noise and what receivers do; its own sigmas."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float
from scipy.signal import lfilter

from crowdmap_torch.geometry import se3
from crowdmap_torch.ranges import (
    Degrees,
    Factor,
    Length,
    LengthOrNone,
    Offset,
    Range,
    Rate,
    Seconds,
    Settings,
    Share,
    Span,
)

_DRIFT_STEP_M = 0.1
"""Way between the samples of a drift."""
_WANDER_STEP_M = 10.0
"""Way between the samples of a bias that wanders; linear in between."""
_TAIL_STEP_M = 10.0
"""Way over which one draw of a heavy-tailed size holds."""
_LARGEST_OUTAGE = 0.6
"""Most of a drive that an outage takes."""
FreedomOrNormal = Annotated[float, Range(0, 1e9, "degrees of freedom: 0 for a normal distribution")]
Ratio = Annotated[float, Range(1, 1e3, "a factor either way: 1 for none")]


@dataclass(frozen=True)
class PositioningConfig(Settings):
    """Errors of poses; every sigma is per axis and stationary."""

    bias_e_m: LengthOrNone = 0.30
    """1-sigma of a journey's constant bias to the east."""
    bias_n_m: LengthOrNone = 0.30
    bias_u_m: LengthOrNone = 0.42
    bias_wander_m: LengthOrNone = 0.0
    """1-sigma of how far the bias wanders along a drive, east, north and up alike: an Ornstein-Uhlenbeck process beside the
    constant; 0: it does not."""
    bias_wander_length_m: Length = 3000.0
    """Distance travelled over which its correlation falls to 1/e."""
    drift_m: LengthOrNone = 0.25
    """1-sigma of the Ornstein-Uhlenbeck drift of the position, east, north and up alike."""
    drift_length_m: LengthOrNone = 150.0
    """Distance travelled over which its correlation falls to 1/e."""
    drift_rot_deg: Degrees = 0.15
    """1-sigma of the drift of the rotation about each axis of the link."""
    drift_rot_length_m: LengthOrNone = 100.0
    drift_smooth_m: LengthOrNone = 0.0
    """Length over which either drift is smooth (a second-order Gauss-Markov process); 0: rough from frame to frame."""
    drift_freedom: FreedomOrNormal = 0.0
    """Student's degrees of freedom of either drift's steps of 10 m, more than 2; 0: normal steps."""
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
    sigma_spread: Ratio = 1.0
    """Each journey's sigmas are multiplied with a factor of their own, log-uniform from 1 / this to this."""
    outages: Share = 0.0
    """Probability that a drive has an outage: the position wanders off and comes back, and no sigma says so."""
    outage_length_m: Span = (200.0, 400.0)
    """Shortest and longest, at most 0.6 of the drive."""
    outage_m: LengthOrNone = 3.0
    """How far the position wanders off; that of an outage is half as far to half as far again."""
    leaps_per_km: Rate = 0.0
    """How often the position leaps between two frames, and goes on from there; no sigma says so."""
    leap_m: LengthOrNone = 1.5
    """1-sigma of how far, east, north and up alike."""
    freezes_per_km: Rate = 0.0
    """How often a pose stays what it is while the car drives on, and is then right again; no sigma says so."""
    freeze_s: Seconds = 2.0
    """For how long."""
    bursts_per_km: Rate = 0.0
    """How often positions are noisy from frame to frame for a while, as between tall buildings; no sigma says so."""
    burst_m: LengthOrNone = 0.5
    """1-sigma of that noise, east, north and up alike."""
    burst_s: Seconds = 3.0
    """For how long."""
    sigmas: bool = True
    """False: the sigma columns are left out."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 < self.drift_freedom <= 2:
            raise ValueError(
                f"drift_freedom: expected more than 2 (with less there is no sigma) or 0, found {self.drift_freedom:g}"
            )


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


@dataclass(frozen=True)
class Outage:
    """A stretch of a drive over which the position wanders off and comes back."""

    from_m: float
    """Way travelled where it begins."""
    to_m: float
    away_m: tuple[float, float, float]
    """How far off the position is in the middle: east, north, up."""
    sway_m: tuple[float, float, float]
    """How far it sways on the way out, and to the other side on the way back."""

    def shift(self, distance: Float[np.ndarray, " f"]) -> Float[np.ndarray, "f 3"]:
        """Error of the position at the frames [m]: none, and without a kink, at both ends."""
        share = np.clip((distance - self.from_m) / (self.to_m - self.from_m), 0.0, 1.0)
        out = np.sin(np.pi * share)[:, None] ** 2
        return out * (self.away_m + np.sin(2 * np.pi * share)[:, None] * self.sway_m)


@dataclass(frozen=True)
class Wander:
    """How a drive's bias wanders: its error beside the constant one."""

    every_m: float
    """Way travelled from one sample to the next, from the start on."""
    away_m: tuple[tuple[float, float, float], ...]
    """East, north, up at the samples; linear in between."""

    def shift(self, distance: Float[np.ndarray, " f"]) -> Float[np.ndarray, "f 3"]:
        """Error of the position at the frames [m]."""
        away = np.array(self.away_m)
        at = self.every_m * np.arange(len(away))
        return np.stack([np.interp(distance, at, axis) for axis in away.T], axis=-1)


@dataclass(frozen=True)
class Leaps:
    """Where a drive's position leaps between two frames, and goes on from there."""

    at_m: tuple[float, ...]
    """Way travelled."""
    by_m: tuple[tuple[float, float, float], ...]
    """How far: east, north, up."""

    def shift(self, distance: Float[np.ndarray, " f"]) -> Float[np.ndarray, "f 3"]:
        """Error of the position at the frames [m]: all leaps so far."""
        behind = distance[:, None] > np.array(self.at_m)
        return behind.astype(np.float64) @ np.array(self.by_m).reshape(-1, 3)


@dataclass(frozen=True)
class Freezes:
    """Where a drive's pose stays what it is while the car drives on."""

    at_m: tuple[float, ...]
    """Way travelled."""
    lasts_s: float

    def held(
        self,
        T: Float[np.ndarray, "f 4 4"],
        distance: Float[np.ndarray, " f"],
        t: Float[np.ndarray, " f"],
    ) -> Float[np.ndarray, "f 4 4"]:
        """The poses with those meanwhile as the one before."""
        T = T.copy()
        for first in np.searchsorted(distance, self.at_m).clip(0, len(t) - 1):
            meanwhile = (t > t[first]) & (t <= t[first] + self.lasts_s)
            T[meanwhile] = T[first]
        return T


@dataclass(frozen=True)
class Bursts:
    """Where a drive's positions are noisy for a while."""

    at_m: tuple[float, ...]
    """Way travelled."""
    lasts_s: float
    sigma_m: float

    def noise(
        self,
        distance: Float[np.ndarray, " f"],
        t: Float[np.ndarray, " f"],
        rng: np.random.Generator,
    ) -> Float[np.ndarray, "f 3"]:
        """Error of the position at the frames [m]."""
        is_noisy = np.zeros(len(t), dtype=bool)
        for first in np.searchsorted(distance, self.at_m).clip(0, len(t) - 1):
            is_noisy |= (t >= t[first]) & (t < t[first] + self.lasts_s)
        return self.sigma_m * is_noisy[:, None] * rng.normal(size=(len(t), 3))


@dataclass(frozen=True)
class DriveErrors:
    """What is wrong with the positioning of one drive, and is not said."""

    sigma_factor: float
    """Stated sigmas are the true ones times this, and times `sigma_scale`."""
    outage: Outage | None
    wander: Wander | None = None
    leaps: Leaps | None = None
    freezes: Freezes | None = None
    bursts: Bursts | None = None

    def shift(self, distance: Float[np.ndarray, " f"]) -> Float[np.ndarray, "f 3"]:
        """Error of the position at the frames [m], by way travelled."""
        parts = (self.outage, self.wander, self.leaps)
        shifts = [part.shift(distance) for part in parts if part is not None]
        return np.sum(shifts, axis=0) if shifts else np.zeros((len(distance), 3))


def drive_errors(
    distance: Float[np.ndarray, " f"], config: PositioningConfig, rng: np.random.Generator
) -> DriveErrors:
    """A draw of one journey's; `distance` is the way travelled up to each frame."""
    log_factor = np.log(config.sigma_spread) * rng.uniform(-1, 1)
    has_outage = rng.random() < config.outages
    length = min(rng.uniform(*config.outage_length_m), _LARGEST_OUTAGE * distance[-1])
    begin = rng.uniform(0, distance[-1] - length)
    size = config.outage_m * rng.uniform(0.5, 1.5)
    angles = rng.uniform(0, 2 * np.pi, 2)
    east, north = np.cos(angles), np.sin(angles)
    up = 0.5 * rng.uniform(-1, 1, 2)
    away, sway = (
        (float(size * part * e), float(size * part * n), float(size * part * u))
        for part, e, n, u in zip((1.0, 0.5), east, north, up, strict=True)
    )
    outage = Outage(float(begin), float(begin + length), away, sway)
    # Drawn last: the rest of a drive is the same with and without it.
    wander = _wander(distance, config, rng) if config.bias_wander_m else None
    leaps = _leaps(distance, config, rng) if config.leaps_per_km and config.leap_m else None
    freezes = _freezes(distance, config, rng) if config.freezes_per_km else None
    bursts = None
    if config.bursts_per_km and config.burst_m:
        at = _now_and_then(distance, config.bursts_per_km, rng)
        bursts = Bursts(at, config.burst_s, config.burst_m)
    outage = outage if has_outage and size > 0 else None
    return DriveErrors(float(np.exp(log_factor)), outage, wander, leaps, freezes, bursts)


def _now_and_then(
    distance: Float[np.ndarray, " f"], per_km: float, rng: np.random.Generator
) -> tuple[float, ...]:
    """Ways travelled at which something happens that happens so often."""
    count = rng.poisson(per_km * distance[-1] / 1000)
    return tuple(np.sort(rng.uniform(0, distance[-1], count)).tolist())


def _freezes(
    distance: Float[np.ndarray, " f"], config: PositioningConfig, rng: np.random.Generator
) -> Freezes:
    return Freezes(_now_and_then(distance, config.freezes_per_km, rng), config.freeze_s)


def _leaps(
    distance: Float[np.ndarray, " f"], config: PositioningConfig, rng: np.random.Generator
) -> Leaps:
    at = _now_and_then(distance, config.leaps_per_km, rng)
    by = config.leap_m * rng.normal(size=(len(at), 3))
    return Leaps(at, tuple((float(e), float(n), float(u)) for e, n, u in by))


def _wander(
    distance: Float[np.ndarray, " f"], config: PositioningConfig, rng: np.random.Generator
) -> Wander:
    count = int(distance[-1] / _WANDER_STEP_M) + 2
    away = config.bias_wander_m * _unit_process(
        count, _WANDER_STEP_M / config.bias_wander_length_m, rng
    )
    return Wander(_WANDER_STEP_M, tuple((float(e), float(n), float(u)) for e, n, u in away))


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
    drift = config.drift_m * _drift(distance, config.drift_length_m, config, rng)
    turn = np.radians(config.drift_rot_deg) * _drift(
        distance, config.drift_rot_length_m, config, rng
    )
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


def reported_sigmas(
    config: PositioningConfig, errors: DriveErrors | None = None
) -> tuple[Float[np.ndarray, " 3"], float] | None:
    """The module's own 1-sigma of position (e, n, u) and rotation [rad] in a drive; None if it is silent."""
    if not config.sigmas:
        return None
    bias = np.array([config.bias_e_m, config.bias_n_m, config.bias_u_m])
    white = np.array([config.white_e_m, config.white_n_m, config.white_u_m])
    position = np.sqrt(bias**2 + config.bias_wander_m**2 + config.drift_m**2 + white**2)
    rotation = np.radians(np.hypot(config.drift_rot_deg, config.white_rot_deg))
    factor = config.sigma_scale * (1.0 if errors is None else errors.sigma_factor)
    return factor * position, float(factor * rotation)


def _drift(
    distance: Float[np.ndarray, " f"],
    length: float,
    config: PositioningConfig,
    rng: np.random.Generator,
) -> Float[np.ndarray, "f 3"]:
    """A stationary Ornstein-Uhlenbeck process of unit variance along the way, in three axes."""
    if config.drift_smooth_m or config.drift_freedom:
        return _smooth_drift(distance, length, config, rng)
    samples = int(distance[-1] / _DRIFT_STEP_M) + 2
    process = _unit_process(samples, _DRIFT_STEP_M / length, rng)
    return process[np.rint(distance / _DRIFT_STEP_M).astype(np.int64)]


def _unit_process(
    samples: int, step: float, rng: np.random.Generator
) -> Float[np.ndarray, "samples 3"]:
    """Its samples, `step` correlation lengths apart."""
    keep = np.exp(-step)
    push = rng.normal(size=(samples, 3)) * np.sqrt(1 - keep**2)
    push[0] /= np.sqrt(
        1 - keep**2
    )  # the first sample has the full variance: stationary from the start
    return np.asarray(lfilter([1.0], [1.0, -keep], push, axis=0))


def _smooth_drift(
    distance: Float[np.ndarray, " f"],
    length: float,
    config: PositioningConfig,
    rng: np.random.Generator,
) -> Float[np.ndarray, "f 3"]:
    """The same with pushes whose size is heavy-tailed from step to step, smoothed once more: of second order."""
    keep = np.exp(-_DRIFT_STEP_M / length) if length else 0.0
    smooth = np.exp(-_DRIFT_STEP_M / config.drift_smooth_m) if config.drift_smooth_m else 0.0
    run_in = int(8 * (length + config.drift_smooth_m) / _DRIFT_STEP_M)
    samples = run_in + int(distance[-1] / _DRIFT_STEP_M) + 2
    push = rng.normal(size=(samples, 3))
    if nu := config.drift_freedom:
        # Student's t is a normal variable whose variance was drawn; with this scale it has unit variance.
        step = np.arange(samples) // round(_TAIL_STEP_M / _DRIFT_STEP_M)
        push *= np.sqrt((nu - 2) / rng.chisquare(nu, step[-1] + 1))[step, None]
    variance = (1 + keep * smooth) / (
        (1 - keep * smooth) * ((1 + keep * smooth) ** 2 - (keep + smooth) ** 2)
    )
    process = lfilter([1.0], [1.0, -(keep + smooth), keep * smooth], push, axis=0)
    process = np.asarray(process)[run_in:] / np.sqrt(variance)
    return process[np.rint(distance / _DRIFT_STEP_M).astype(np.int64)]
