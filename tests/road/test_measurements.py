from __future__ import annotations

from dataclasses import replace

import torch
from worlds.road_drives import blind_journey, poses_on_plane

from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.road.ego_motion import EgoMotion, motion_of
from crowdmap_torch.road.kalman import CROSS, GROWTH, MISSING, ROLL, SLOPE, STANCE
from crowdmap_torch.road.measurements import (
    MeasurementConfig,
    first_measurement_state,
    lane_rays,
    take_measurements,
    width_moments,
)
from crowdmap_torch.road.vanishing_point import LaneRays, VanishingFit, fit_vanishing

F64 = torch.float64
NOISE, CONFIG = PositioningNoise(), MeasurementConfig()
HEIGHT = 1.5
TILT, VANISHING, CHORD, WIDTH = 0, 2, 3, 4
"""Columns of the measurements; 1 is the roll's tilt."""


def motion_over(frames: int, *, climb: float = 0.0) -> EgoMotion:
    """A straight drive, on a slope where it climbs (the poses' tilt says nothing of it)."""
    poses = poses_on_plane(torch.zeros(frames, dtype=F64), 0.8, pitch=0.02, roll=-0.01)
    poses[:, 2, 3] += climb * poses[:, 0, 3]
    return motion_of(blind_journey(poses))


def unseen(frames: int) -> VanishingFit:
    """No markers in any frame."""
    none, real = torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=F64)
    rays = LaneRays(none, none, frames, real, real)
    return fit_vanishing(rays, torch.zeros(frames, dtype=F64), HEIGHT, 1e-3, CONFIG.vanishing)


def test_every_measurement_of_the_true_state_leaves_no_innovation() -> None:
    """A road that climbs by a constant slope, a car with a constant stance."""
    motion, slope = motion_over(100, climb=0.05), 0.05
    m, _ = take_measurements(
        motion,
        torch.full((100,), 0.066, dtype=F64),
        unseen(100),
        torch.zeros(100, 6, dtype=F64),
        first_measurement_state(motion),
        NOISE,
        CONFIG,
    )
    state = torch.zeros(6, dtype=F64)
    state[SLOPE], state[STANCE] = slope, slope + 0.02
    state[CROSS], state[ROLL] = 0.0, -0.01
    seen = m.variance < MISSING
    predicted = ((m.row + m.known) @ state)[seen]
    torch.testing.assert_close(m.value[seen], predicted, atol=1e-9, rtol=0)
    # A chord of 20 m ends every 25 frames; no markers, no lanes.
    assert seen.sum(0).tolist() == [100, 100, 0, 3, 0]


def test_frames_can_come_in_parts() -> None:
    motion, dt = motion_over(90), torch.full((90,), 0.066, dtype=F64)
    fit, moments = unseen(90), torch.rand(90, 6, dtype=F64)
    config = replace(CONFIG, width_m=30.0)
    whole, last = take_measurements(
        motion, dt, fit, moments, first_measurement_state(motion), NOISE, config
    )
    state, parts = first_measurement_state(motion), []
    for part in (slice(0, 1), slice(1, 40), slice(40, 90)):
        columns = {
            name: getattr(fit, name)[part]
            for name in ("alpha", "variance", "by_curvature", "by_twist", "bend")
        }
        part_of, state = take_measurements(
            motion[part], dt[part], replace(fit, **columns), moments[part], state, NOISE, config
        )
        parts.append(part_of)
    for name in ("row", "known", "value", "variance"):
        together = torch.cat([getattr(p, name) for p in parts])
        # Sums of moments in another order.
        torch.testing.assert_close(together, getattr(whole, name), atol=1e-9, rtol=1e-12)
    torch.testing.assert_close(state.station, last.station)
    torch.testing.assert_close(state.chord_start, last.chord_start)
    torch.testing.assert_close(state.widths, last.widths)


def test_widths_that_grow_to_one_side_show_the_roll() -> None:
    motion, roll, frames = motion_over(150), 0.01, 150
    offset = torch.tensor([-5.1, -1.7, 1.7, 5.1], dtype=F64) / HEIGHT
    seen = (offset + roll * offset.square()).repeat(frames)
    frame = torch.arange(frames).repeat_interleave(4)
    none = torch.zeros(0, dtype=F64)
    rays = LaneRays(torch.zeros(0, dtype=torch.int64), frame, frames, none, none)
    fit = replace(unseen(frames), offset=seen, offset_weight=torch.full_like(seen, 1e6))
    moments = width_moments(fit, rays, HEIGHT, CONFIG)
    dt = torch.full((frames,), 0.066, dtype=F64)
    m, _ = take_measurements(
        motion, dt, fit, moments, first_measurement_state(motion), NOISE, CONFIG
    )
    row = (m.variance[:, WIDTH] < MISSING).nonzero()
    assert len(row) == 1
    # To second order in the roll: offsets of five camera heights, 0.01 rad.
    assert abs(float(m.value[row[0, 0], WIDTH]) - roll) < 1e-4
    # A roll taken off before is put back.
    flat = replace(fit, offset=offset.repeat(frames))
    beta = torch.full((frames,), roll, dtype=F64)
    again = width_moments(flat, rays, HEIGHT, CONFIG, beta)
    # Logarithms of 1 + 0.01 p instead of 0.01 p, p up to 4.5: their halves squared, twice.
    torch.testing.assert_close(again[:, 3], moments[:, 3], atol=2.2e-3, rtol=0)


def test_growth_of_a_chord_is_felt_at_its_middle() -> None:
    motion = motion_over(60)
    m, _ = take_measurements(
        motion,
        torch.full((60,), 0.066, dtype=F64),
        unseen(60),
        torch.zeros(60, 6, dtype=F64),
        first_measurement_state(motion),
        NOISE,
        CONFIG,
    )
    row = m.row[m.variance[:, CHORD] < MISSING, CHORD]
    assert (row[:, SLOPE] == 1).all()
    assert ((row[:, GROWTH] + 10.0).abs() < 0.8).all()


def test_rays_are_those_of_a_turned_camera() -> None:
    turn = torch.tensor([[1.0, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]], dtype=F64)
    ideal = torch.tensor([[0.1, 0.2], [-0.3, 0.4]], dtype=F64)
    rays = lane_rays(ideal, torch.tensor([0, 0]), torch.tensor([3]), 5, turn)
    ray = torch.nn.functional.pad(ideal, (0, 1), value=1.0) @ turn.T
    torch.testing.assert_close(torch.stack((rays.x, rays.y), 1), ray[:, :2] / ray[:, 2:])
    assert rays.frames == 5
