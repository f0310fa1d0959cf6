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

What measurements need of frames is computed ahead in one batch (`take_measurements`). What frame after frame does to a
state is put together by an associative scan (Sarkka and Garcia-Fernandez 2021), so that no loop walks over frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.geometry.associative_scan import Elements, associative_scan
from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.ranges import Deviations, Settings, Sigma

SLOPE, GROWTH, STANCE, CROSS, TWIST, ROLL = range(6)
"""Columns of the state."""
STATE_SIZE = 6
MISSING = 1e6
"""Variance of a measurement that is not there."""
_SETTLED = 1e-12
"""What measurements are trusted may still move by this share of it in the last round of a filter."""


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

    The last one is the `start` of the frames after them. How far a measurement is trusted depends on what the frames
    before it predict: those of a round are judged by the predictions of the round before, until nothing moves any more.
    After k rounds the first k frames are right whatever comes; two or three rounds do for a drive.
    """
    m, F = measurements, _transitions(measurements)
    Q = _process_noise(m, positioning, config)
    first = RoadState(F[:1] @ start.mean, F[:1] @ start.covariance @ F[:1].mT + Q[:1])
    expected = first.mean.expand(len(m), -1)
    inflation = torch.ones_like(m.variance)
    state = predicted = first
    for _ in range(len(m) + 1 if len(m) else 0):
        value = m.value - (m.known @ expected[..., None])[..., 0]
        steps = _filter_steps(F, Q, m.row, value, m.variance * inflation, first)
        state = RoadState(*associative_scan(_one_after_another, steps, onto=_after_beginning)[:2])
        x, P = state.mean[:-1, :, None], state.covariance[:-1]
        predicted = RoadState(
            torch.cat((first.mean, (F[1:] @ x)[..., 0])),
            torch.cat((first.covariance, F[1:] @ P @ F[1:].mT + Q[1:])),
        )
        before, inflation = inflation, _inflation(m, predicted, config)
        moved = (m.known @ (predicted.mean - expected)[..., None])[..., 0]
        expected = predicted.mean
        tolerance = _SETTLED * (1 + m.value.abs())
        if bool(((inflation - before).abs() <= _SETTLED * before).all()) and bool(
            (moved.abs() <= tolerance).all()
        ):
            break
    return Filtered(state, predicted, F)


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
    G = torch.cat((G, torch.zeros_like(P[-1:])))
    shift = torch.cat((x[:-1] - (G[:-1] @ x_next[..., None])[..., 0], x[-1:]))
    spread = torch.cat((P[:-1] - G[:-1] @ P_next @ G[:-1].mT, P[-1:]))
    backwards = tuple(t.flip(0) for t in (G, shift, spread))
    _, mean, covariance = associative_scan(_one_before_another, backwards)
    return RoadState(mean.flip(0), covariance.flip(0))


def _filter_steps(
    F: Float[Tensor, "f 6 6"],
    Q: Float[Tensor, "f 6 6"],
    H: Float[Tensor, "f s 6"],
    value: Float[Tensor, "f s"],
    variance: Float[Tensor, "f s"],
    first: RoadState,
) -> Elements:
    """What each frame makes of the state x before it, one row a frame.

    (b, C, A): its posterior is `A x + b` with covariance C; (eta, J): what it says of x, in information form. The first
    frame's is the posterior itself, from what was predicted for it: A is zero, and of any beginning b and C are all.
    """
    P = torch.cat((first.covariance, Q[1:]))
    HP = H @ P
    SH = torch.linalg.solve(HP @ H.mT + torch.diag_embed(variance), torch.cat((HP, H), dim=-1))
    K, SH = SH[..., :STATE_SIZE].mT, SH[..., STATE_SIZE:]
    F = torch.cat((torch.zeros_like(F[:1]), F[1:]))
    before = torch.cat((first.mean, torch.zeros_like(first.mean).expand(len(F) - 1, -1)))
    innovation = value[..., None] - H @ before[..., None]
    left = torch.eye(STATE_SIZE, dtype=F.dtype, device=F.device) - K @ H
    return (
        before + (K @ innovation)[..., 0],
        _symmetric(left @ P),
        left @ F,
        (F.mT @ SH.mT @ value[..., None])[..., 0],
        _symmetric(F.mT @ H.mT @ SH @ F),
    )


def _one_after_another(earlier: Elements, later: Elements) -> Elements:
    """Two stretches of frames as one (Sarkka and Garcia-Fernandez 2021, Lemma 8)."""
    b, C, A, eta, J = earlier
    b_on, C_on, A_on, eta_on, J_on = later
    eye = torch.eye(STATE_SIZE, dtype=A.dtype, device=A.device)
    shifted = b + (C @ eta_on[..., None])[..., 0]
    # I + J C of the way back is the transpose of I + C J.
    found = torch.linalg.inv(eye + C @ J_on) @ torch.cat((A, shifted[..., None], C), -1)
    forward = A_on @ found
    left = eta_on - (J_on @ b[..., None])[..., 0]
    back = found[..., :STATE_SIZE].mT @ torch.cat((left[..., None], J_on @ A), -1)
    return (
        forward[..., STATE_SIZE] + b_on,
        _symmetric(forward[..., STATE_SIZE + 1 :] @ A_on.mT) + C_on,
        forward[..., :STATE_SIZE],
        back[..., 0] + eta,
        _symmetric(back[..., 1:]) + J,
    )


def _after_beginning(beginning: Elements, later: Elements) -> Elements:
    """The state (b, C) after a stretch that follows on a beginning."""
    b, C = beginning[:2]
    b_on, C_on, A_on, eta_on, J_on = later
    eye = torch.eye(STATE_SIZE, dtype=C.dtype, device=C.device)
    shifted = b[..., None] + C @ eta_on[..., None]
    forward = A_on @ torch.linalg.solve(eye + C @ J_on, torch.cat((shifted, C), -1))
    return forward[..., 0] + b_on, _symmetric(forward[..., 1:] @ A_on.mT) + C_on


def _one_before_another(later: Elements, earlier: Elements) -> Elements:
    """Two stretches of a smoother's maps `x = G x_next + shift`, with what they leave unsure, as one."""
    G, shift, spread = earlier
    G_on, shift_on, spread_on = later
    return G @ G_on, (G @ shift_on[..., None])[..., 0] + shift, G @ spread_on @ G.mT + spread


def _inflation(m: Measurements, predicted: RoadState, config: KalmanConfig) -> Float[Tensor, "f s"]:
    """By how much the variance of each measurement counts for more, as it is further off than the gate."""
    innovation = m.value - ((m.row + m.known) @ predicted.mean[..., None])[..., 0]
    S = ((m.row @ predicted.covariance) * m.row).sum(-1) + m.variance
    return (innovation.abs() / (config.gate * S.sqrt())).clamp_min(1).square()


def _symmetric(matrix: Float[Tensor, "*batch n n"]) -> Float[Tensor, "*batch n n"]:
    return 0.5 * (matrix + matrix.mT)


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
