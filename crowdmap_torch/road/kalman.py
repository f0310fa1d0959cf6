"""The road's slopes and the car's stance on it: a Kalman filter, and a Rauch-Tung-Striebel smoother behind it (IV-C).

The state is, for the direction ahead and for the one to the right, (slope of the road, its growth
per metre, stance): six numbers. Slopes are as seen through the measured rotations, whose slow drift
they carry. The *stance* is the pitch (roll) of the normal against calibration without the springs'
shaking: load, and what changes slowly. With `tilt` for the normal that poses would give on a level
road, the normal is `tilt + slope`, and on the average it is the stance:

    tilt      = stance - slope + shaking                    every frame
    vanishing = slope + known factors times the growths     where markers are seen
    chord     = slope averaged over the last metres         after every stretch of travel
    width     = roll                                        after every longer stretch with lanes side by side

What measurements need of frames is computed ahead in one batch (`take_measurements`); left to the
loop are products of 6 x 6 matrices.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.ranges import Deviations, Settings, Sigma

SLOPE, GROWTH, STANCE, CROSS, TWIST, ROLL = range(6)
"""Columns of the state."""
STATE_SIZE = 6
MISSING = 1e6
"""Variance of a measurement that is not there."""


@dataclass(frozen=True)
class KalmanConfig(Settings):
    """How roads bend, how cars stand on them, and how far measurements may be off; pairs are (ahead, to the right)."""

    stance_sigma: tuple[Sigma, Sigma] = (0.014, 0.0035)
    """1-sigma of the loaded car's pitch and roll against calibration [rad]."""
    stance_rate: tuple[Sigma, Sigma] = (5e-4, 1e-5)
    """Random walk of the two over one second: braking, passengers [rad]."""
    growth_rate: tuple[Sigma, Sigma] = (1.5e-4, 1.5e-4)
    """Random walk of the growth of the slopes over one metre of travel [1/m]."""
    gate: Deviations = 2.5
    """A measurement further off than this, in standard deviations, counts as one with so much
    larger a sigma (Huber)."""


@dataclass(frozen=True)
class Measurements:
    """What one frame after another says: `value = (row + known) . state + noise`, `s` of them in each frame.

    Of the state's entries in `known` nothing is learned: their part of a measurement is only taken
    off.
    """

    advance: Float[Tensor, " f"]
    """Way ahead since the frame before [m]."""
    dt: Float[Tensor, " f"]
    """Time since the frame before [s]."""
    row: Float[Tensor, "f s 6"]
    known: Float[Tensor, "f s 6"]
    value: Float[Tensor, "f s"]
    variance: Float[Tensor, "f s"]
    """`MISSING` where there is none."""

    def __len__(self) -> int:
        return len(self.advance)


@dataclass(frozen=True)
class RoadState:
    """Mean and covariance of the state."""

    mean: Float[Tensor, "*batch 6"]
    covariance: Float[Tensor, "*batch 6 6"]


def first_state(config: KalmanConfig, like: Tensor) -> RoadState:
    """What is known before the first frame: the calibration, and how far cars stray from it."""
    pitch, roll = config.stance_sigma
    sigma = like.new_tensor([0.2, 2e-3, pitch, 0.2, 2e-3, roll])
    return RoadState(like.new_zeros(STATE_SIZE), torch.diag(sigma.square()))


@dataclass(frozen=True)
class Filtered:
    """The states of frames, and what smoothing needs."""

    state: RoadState
    """After each frame's measurements."""
    predicted: RoadState
    """Before them."""
    transition: Float[Tensor, "f 6 6"]


def filter_forward(
    start: RoadState,
    measurements: Measurements,
    positioning: PositioningNoise,
    config: KalmanConfig,
) -> Filtered:
    """The causal estimates of frames that follow on `start` (Kalman 1960; outliers as in Huber 1964).

    The last one is the `start` of the frames after them.
    """
    F = _transitions(measurements)
    Q = _process_noise(measurements, positioning, config)
    x, P = start.mean, start.covariance
    kept = []
    for k in range(len(measurements)):
        x, P = F[k] @ x, F[k] @ P @ F[k].T + Q[k]
        before = (x, P)
        H = measurements.row[k]
        PH = P @ H.T
        innovation = measurements.value[k] - (H + measurements.known[k]) @ x
        S = H @ PH
        R = measurements.variance[k]
        excess = innovation.abs() / (config.gate * (S.diagonal() + R).sqrt())
        S = S + torch.diag(R * excess.clamp_min(1).square())
        gain = torch.linalg.solve_ex(S, PH.T)[0].T
        x, P = x + gain @ innovation, P - gain @ PH.T
        P = 0.5 * (P + P.T)
        kept.append((x, P, *before))
    if not kept:
        empty = RoadState(x.new_zeros(0, STATE_SIZE), x.new_zeros(0, STATE_SIZE, STATE_SIZE))
        return Filtered(empty, empty, F)
    x, P, x_before, P_before = (torch.stack(column) for column in zip(*kept, strict=True))
    return Filtered(RoadState(x, P), RoadState(x_before, P_before), F)


def smooth_backward(filtered: Filtered) -> RoadState:
    """The estimates of the same frames from all of them (Rauch, Tung and Striebel 1965)."""
    x, P = filtered.state.mean, filtered.state.covariance
    if len(x) < 2:
        return filtered.state
    P_next, x_next = filtered.predicted.covariance[1:], filtered.predicted.mean[1:]
    FP = filtered.transition[1:] @ P[:-1]
    # Columns differ by many orders of magnitude: scaled to a unit diagonal first.
    scale = P_next.diagonal(dim1=-2, dim2=-1).rsqrt()
    scaled = scale[:, :, None] * P_next * scale[:, None, :]
    G = (scale[:, :, None] * torch.linalg.solve(scaled, scale[:, :, None] * FP)).mT
    mean, covariance = [x[-1]], [P[-1]]
    for k in range(len(G) - 1, -1, -1):
        mean.append(x[k] + G[k] @ (mean[-1] - x_next[k]))
        covariance.append(P[k] + G[k] @ (covariance[-1] - P_next[k]) @ G[k].T)
    return RoadState(torch.stack(mean[::-1]), torch.stack(covariance[::-1]))


def _transitions(m: Measurements) -> Float[Tensor, "f 6 6"]:
    eye = torch.eye(STATE_SIZE, dtype=m.advance.dtype, device=m.advance.device)
    step = torch.zeros_like(eye)
    step[SLOPE, GROWTH] = step[CROSS, TWIST] = 1
    # Slopes do not turn with the car: a road leans with its bends, unlike a tilted plane.
    return eye + m.advance[:, None, None] * step


def _process_noise(
    m: Measurements, positioning: PositioningNoise, config: KalmanConfig
) -> Float[Tensor, "f 6 6"]:
    d = m.advance.abs()
    Q = d.new_zeros(len(d), STATE_SIZE, STATE_SIZE)
    for slope, rate, stance, walk in (
        (SLOPE, config.growth_rate[0], STANCE, config.stance_rate[0]),
        (CROSS, config.growth_rate[1], ROLL, config.stance_rate[1]),
    ):
        growth = slope + 1
        Q[:, slope, slope] = rate**2 * d**3 / 3 + positioning.walk_rad**2 * d + 1e-14
        Q[:, slope, growth] = Q[:, growth, slope] = rate**2 * d * d * m.advance.sign() / 2
        Q[:, growth, growth] = rate**2 * d + 1e-16
        Q[:, stance, stance] = walk**2 * m.dt + 1e-16
    return Q
