from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.road.kalman import (
    MISSING,
    STATE_SIZE,
    KalmanConfig,
    Measurements,
    _process_noise,
    _transitions,
    filter_forward,
    first_state,
    smooth_backward,
)

F64 = torch.float64
NOISE, PLAIN = PositioningNoise(), KalmanConfig(gate=1e9)
"""No outliers: the filter is linear, and least squares over all frames at once must agree."""


def random_measurements(frames: int, generator: torch.Generator) -> Measurements:
    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, dtype=F64, generator=generator)

    row = torch.zeros(frames, 3, STATE_SIZE, dtype=F64)
    row[:, 0, 0], row[:, 0, 2] = -1, 1
    row[:, 1, 3], row[:, 1, 5] = -1, 1
    row[:, 2, 0], row[:, 2, 1] = 1, 10
    variance = torch.full((frames, 3), 1e-5, dtype=F64)
    variance[::3, 2] = MISSING
    return Measurements(
        advance=0.5 + 0.1 * draw(frames),
        dt=torch.full((frames,), 0.066, dtype=F64),
        row=row,
        known=torch.zeros_like(row),
        value=0.01 * draw(frames, 3),
        variance=variance,
    )


def least_squares(m: Measurements) -> torch.Tensor:
    """All states at once, from the normal equations."""
    start = first_state(PLAIN, m.value)
    F, Q = _transitions(m), _process_noise(m, NOISE, PLAIN)
    frames, k = len(m), STATE_SIZE
    A = torch.zeros(frames * k, frames * k, dtype=F64)
    b = torch.zeros(frames * k, dtype=F64)
    first = F[0] @ start.covariance @ F[0].T + Q[0]
    A[:k, :k] += torch.linalg.inv(first)
    for f in range(frames):
        at = slice(f * k, f * k + k)
        H, W = m.row[f], torch.diag(1 / m.variance[f])
        A[at, at] += H.T @ W @ H
        b[at] += H.T @ W @ m.value[f]
        if f:
            both = torch.cat((-F[f], torch.eye(k, dtype=F64)), dim=-1)
            block = slice(f * k - k, f * k + k)
            A[block, block] += both.T @ torch.linalg.inv(Q[f]) @ both
    return torch.linalg.solve(A, b).reshape(frames, k)


def test_smoothed_states_are_the_least_squares_solution(generator: torch.Generator) -> None:
    m = random_measurements(12, generator)
    filtered = filter_forward(first_state(PLAIN, m.value), m, NOISE, PLAIN)
    smoothed = smooth_backward(filtered)
    expected = least_squares(m)
    # The equations span fourteen orders of magnitude; slopes of 1e-2 are right to 1e-6.
    torch.testing.assert_close(
        smoothed.mean[:, [0, 2, 3, 5]], expected[:, [0, 2, 3, 5]], atol=1e-6, rtol=1e-4
    )
    torch.testing.assert_close(smoothed.mean[-1], filtered.state.mean[-1])


def test_smoothing_never_makes_a_state_less_sure(generator: torch.Generator) -> None:
    m = random_measurements(60, generator)
    filtered = filter_forward(first_state(PLAIN, m.value), m, NOISE, PLAIN)
    after = smooth_backward(filtered).covariance.diagonal(dim1=-2, dim2=-1)
    before = filtered.state.covariance.diagonal(dim1=-2, dim2=-1)
    assert bool((after <= before * (1 + 1e-6)).all() and (after > 0).all())


def test_frames_can_come_one_at_a_time(generator: torch.Generator) -> None:
    config = KalmanConfig()
    m = random_measurements(20, generator)
    state = first_state(config, m.value)
    whole = filter_forward(state, m, NOISE, config).state.mean
    for k in range(len(m)):
        columns = (m.advance, m.dt, m.row, m.known, m.value, m.variance)
        part = Measurements(*(column[k : k + 1] for column in columns))
        result = filter_forward(state, part, NOISE, config).state
        torch.testing.assert_close(result.mean[0], whole[k])
        state = type(state)(result.mean[0], result.covariance[0])


def in_a_loop(m: Measurements, config: KalmanConfig) -> tuple[torch.Tensor, torch.Tensor]:
    """Means and covariances of all frames, one after another as in the textbook."""
    start = first_state(config, m.value)
    F, Q = _transitions(m), _process_noise(m, NOISE, config)
    x, P = start.mean, start.covariance
    means, covariances = [], []
    for k in range(len(m)):
        x, P = F[k] @ x, F[k] @ P @ F[k].T + Q[k]
        H = m.row[k]
        innovation = m.value[k] - (H + m.known[k]) @ x
        S = H @ P @ H.T
        R = m.variance[k]
        excess = innovation.abs() / (config.gate * (S.diagonal() + R).sqrt())
        S = S + torch.diag(R * excess.clamp_min(1).square())
        gain = torch.linalg.solve(S, H @ P).T
        x, P = x + gain @ innovation, P - gain @ H @ P
        means.append(x)
        covariances.append(P)
    return torch.stack(means), torch.stack(covariances)


@pytest.mark.parametrize("frames", [1, 2, 7, 300])
def test_states_are_those_of_a_loop_over_frames(frames: int, generator: torch.Generator) -> None:
    config = KalmanConfig()
    m = random_measurements(frames, generator)
    # A tenth are far off, some of them in one frame after another, and some of the state is only known.
    off = torch.rand(frames, 3, dtype=F64, generator=generator) < 0.1
    off[frames // 2 : frames // 2 + 20] = True
    known = torch.zeros_like(m.known)
    known[:, 2, 5] = 3
    m = replace(m, value=torch.where(off, 20 * m.value, m.value), known=known)
    state = filter_forward(first_state(config, m.value), m, NOISE, config).state
    mean, covariance = in_a_loop(m, config)
    # Of each state in units of its own sigma; the products of 300 frames lose some digits.
    sigma = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    torch.testing.assert_close(state.mean / sigma, mean / sigma, rtol=1e-8, atol=1e-8)
    scale = sigma[:, :, None] * sigma[:, None, :]
    torch.testing.assert_close(state.covariance / scale, covariance / scale, rtol=1e-8, atol=1e-8)


def test_an_outlier_moves_the_state_no_further_than_the_gate(generator: torch.Generator) -> None:
    m = random_measurements(30, generator)
    config = KalmanConfig()
    start = first_state(config, m.value)
    plain = filter_forward(start, m, NOISE, config).state.mean[-1]
    value = m.value.clone()
    value[-1, 2] += 0.5
    spoilt = Measurements(m.advance, m.dt, m.row, m.known, value, m.variance)
    moved = filter_forward(start, spoilt, NOISE, config).state.mean[-1]
    naive = filter_forward(start, spoilt, NOISE, PLAIN).state.mean[-1]
    assert (moved[0] - plain[0]).abs() < 0.1 * (naive[0] - plain[0]).abs()


def test_what_is_only_known_is_not_learned() -> None:
    config = KalmanConfig()
    zero = torch.zeros(1, 1, dtype=F64)
    row = torch.zeros(1, 1, STATE_SIZE, dtype=F64)
    row[..., 0] = 1
    known = torch.zeros_like(row)
    known[..., 5] = 100
    m = Measurements(zero[0] + 1, zero[0] + 0.1, row, known, zero + 0.01, zero + 1e-8)
    state = filter_forward(first_state(config, zero), m, NOISE, config).state
    assert state.mean[0, 5] == 0 and abs(state.mean[0, 0] - 0.01) < 1e-4
