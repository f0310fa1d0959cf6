"""What poses and lane markers say about the road's slopes and the car's stance, frame by frame (IV-C).

Only the past is looked at: frames can come in one at a time or all at once, with the same result.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from crowdmap_torch.noise.positioning import PositioningNoise
from crowdmap_torch.ranges import Duration, Factor, Length, Settings, Sigma, Span
from crowdmap_torch.road.ego_motion import EgoMotion
from crowdmap_torch.road.kalman import (
    CROSS,
    GROWTH,
    MISSING,
    ROLL,
    SLOPE,
    STANCE,
    STATE_SIZE,
    TWIST,
    Measurements,
    RoadState,
)
from crowdmap_torch.road.vanishing_point import LaneRays, VanishingConfig, VanishingFit

_BRAKING_S = 2.0
"""Cars brake and accelerate for about so long [s]."""


@dataclass(frozen=True)
class MeasurementConfig(Settings):
    """How far each kind of measurement can be trusted; pairs are (pitch, roll), angles in radians."""

    shaking: tuple[Sigma, Sigma] = (2.5e-3, 1.3e-3)
    """1-sigma of the springs' pitch and roll; of a drive that shows more, what it shows (method `smoothed`)."""
    softer_from: Factor = 1.5
    """It shows more where that is so many times this."""
    shaking_memory_s: Duration = 0.2
    """Time after which the springs have forgotten it."""
    parallel_sigma: Sigma = 1.5e-3
    """What is wrong with a frame's vanishing point besides the points' noise: markers are not quite
    parallel."""
    chord_m: Length = 20.0
    """Travel after which the slope of the way itself is looked at."""
    chord_sigma: Sigma = 1.1e-2
    """1-sigma of it, from the drift of positions over that way and that of rotations over much
    longer ways."""
    width_m: Length = 100.0
    """Travel after which the widths of neighbouring lanes are compared."""
    width_sigma: Sigma = 0.025
    """1-sigma of a lane's width against its neighbours', as a share of it."""
    width_range_m: Span = (2.4, 4.6)
    """Markers so far apart are taken for the two sides of one lane."""
    vanishing: VanishingConfig = field(default_factory=VanishingConfig)


@dataclass(frozen=True)
class MeasurementState:
    """What later measurements need of earlier frames; its size never grows."""

    station: Float[Tensor, ""]
    """Furthest way ahead since the first frame [m]."""
    chord_start: Float[Tensor, " 4"]
    """Position [m] and station [m] where the last chord ended."""
    widths: Float[Tensor, " 6"]
    """Sums over the pairs of markers since the last comparison; see `width_moments`."""


def first_measurement_state(motion: EgoMotion) -> MeasurementState:
    """Before the first of some frames."""
    start = torch.cat((motion.position[0], motion.position.new_zeros(1)))
    return MeasurementState(start[3], start, start.new_zeros(6))


def take_measurements(
    motion: EgoMotion,
    dt: Float[Tensor, " f"],
    fit: VanishingFit,
    moments: Float[Tensor, "f 6"],
    so_far: MeasurementState,
    positioning: PositioningNoise,
    config: MeasurementConfig,
) -> tuple[Measurements, MeasurementState]:
    """The measurements of frames that follow on `so_far`, and what the frames after them need."""
    walked = so_far.station + motion.station
    station = torch.cummax(torch.cat((so_far.station[None], walked)), 0)[0]
    longer = _correlated(dt, config)
    chord, chord_start = _chords(motion, station, so_far.chord_start, config)
    width, widths = _widths(station, moments, so_far.widths, config)
    columns = (
        _tilt(motion.alpha, SLOPE, STANCE, config.shaking[0] ** 2 * longer),
        _tilt(motion.beta, CROSS, ROLL, config.shaking[1] ** 2 * longer),
        _vanishing(motion, fit, positioning, config),
        chord,
        width,
    )
    row, known, value, variance = (
        torch.stack([getattr(column, name) for column in columns], dim=1)
        for name in ("row", "known", "value", "variance")
    )
    after = MeasurementState(station[-1], chord_start, widths)
    return Measurements(motion.advance, dt, row, known, value, variance), after


@dataclass(frozen=True)
class _Column:
    """One measurement of every frame, as in `Measurements`."""

    row: Float[Tensor, "f 6"]
    known: Float[Tensor, "f 6"]
    value: Float[Tensor, " f"]
    variance: Float[Tensor, " f"]


def _nothing(like: Float[Tensor, " f"]) -> _Column:
    """A measurement that is there in no frame, to be filled."""
    row = like.new_zeros(len(like), STATE_SIZE)
    return _Column(
        row, torch.zeros_like(row), torch.zeros_like(like), torch.full_like(like, MISSING)
    )


def _tilt(
    seen: Float[Tensor, " f"], slope: int, stance: int, variance: Float[Tensor, " f"]
) -> _Column:
    """The tilt against gravity: stance less slope."""
    column = _nothing(seen)
    column.row[:, slope], column.row[:, stance] = -1, 1
    return replace(column, value=seen, variance=variance)


def _vanishing(
    motion: EgoMotion, fit: VanishingFit, positioning: PositioningNoise, config: MeasurementConfig
) -> _Column:
    """The slope that the vanishing point of the markers shows."""
    column = _nothing(motion.alpha)
    column.row[:, SLOPE], column.row[:, GROWTH] = 1, fit.by_curvature
    # A road that bends and leans falls behind its tangent plane.
    column.known[:, CROSS] = -fit.by_curvature * fit.bend
    column.known[:, TWIST] = fit.by_twist
    noise = fit.variance + config.parallel_sigma**2 + positioning.white_sigma_rad**2
    variance = torch.where(fit.variance < 0.05**2, noise, MISSING)
    return replace(column, value=fit.alpha - motion.alpha, variance=variance)


def _chords(
    motion: EgoMotion,
    station: Float[Tensor, " stations"],
    start: Float[Tensor, " 4"],
    config: MeasurementConfig,
) -> tuple[_Column, Float[Tensor, " 4"]]:
    """The slope of each chord of the way in the frame in which it ends, and the end of the last one."""
    rows = _passes(station, config.chord_m).nonzero()[:, 0]
    here = torch.cat((motion.position[rows], station[1:][rows, None]), dim=-1)
    before = torch.cat((start[None], here))
    way = here - before[:-1]
    flat = way[:, :2].norm(dim=-1)
    length = way[:, 3].clamp_min(1e-3)
    is_straight = flat > 0.5 * length
    column = _nothing(motion.alpha)
    column.row[rows, SLOPE], column.row[rows, GROWTH] = 1, -length / 2
    column.value[rows] = way[:, 2] / flat.clamp_min(1e-3)
    # Noise of positions: with the square root of the way, and so does its share in the slope.
    variance = config.chord_sigma**2 * config.chord_m / length
    column.variance[rows] = torch.where(is_straight, variance, MISSING)
    return column, before[-1]


def _widths(
    station: Float[Tensor, " stations"],
    moments: Float[Tensor, "f 6"],
    so_far: Float[Tensor, " 6"],
    config: MeasurementConfig,
) -> tuple[_Column, Float[Tensor, " 6"]]:
    """The roll that widths show at the end of each stretch, and the sums over what lies behind the last one."""
    ends = _passes(station, config.width_m)
    stretch = ends.long().cumsum(0) - ends.long()
    count = int(ends.sum())
    total = moments.new_zeros(count + 1, 6).index_add(0, stretch, moments)
    total[0] += so_far
    rows = ends.nonzero()[:, 0]
    column = _nothing(moments[:, 0])
    column.row[rows, ROLL] = 1
    column.value[rows], column.variance[rows] = _roll_of_widths(total[:count], config)
    return column, total[count]


def _passes(station: Float[Tensor, " stations"], every: float) -> Bool[Tensor, " f"]:
    """True for frames in which the way passes a multiple of a length."""
    index = (station / every).floor()
    return index[1:] > index[:-1]


def softer_springs(
    motion: EgoMotion, dt: Float[Tensor, " f"], state: RoadState, config: MeasurementConfig
) -> tuple[float, float]:
    """1-sigma of the springs' pitch and roll that a drive shows beside the `state` that was found with those of `config`.

    Those of `config`, where it shows hardly more. Means over some seconds tell: who brakes is nose-down for longer
    than the springs shake, and what lasts is taken for a slope of the road if it is trusted like what does not.
    """
    longer = _correlated(dt, config).mean()
    stretch = (motion.t_s / _BRAKING_S).floor()
    _, block, count = torch.unique(stretch, return_inverse=True, return_counts=True)
    number = count.to(motion.t_s)

    def shown(seen: Float[Tensor, " f"], slope: int, stance: int) -> Tensor:
        left = seen - (state.mean[:, stance] - state.mean[:, slope])
        total = torch.zeros_like(number).index_add(0, block, left)
        enough = number >= 2
        mean_sq = (total.square() / number * enough).sum() / enough.sum().clamp_min(1)
        return (mean_sq / longer).sqrt()

    found = torch.stack((shown(motion.alpha, SLOPE, STANCE), shown(motion.beta, CROSS, ROLL)))
    pitch, roll = (
        new if new > config.softer_from * old else old
        for new, old in zip(found.tolist(), config.shaking, strict=True)
    )
    return pitch, roll


def _correlated(dt: Float[Tensor, " f"], config: MeasurementConfig) -> Float[Tensor, " f"]:
    """So many times the variance: the springs shake with a memory, which averages out more slowly than white noise."""
    return (2 * config.shaking_memory_s / dt.clamp_min(1e-3)).clamp_min(1)


def width_moments(
    fit: VanishingFit,
    rays: LaneRays,
    height: float,
    config: MeasurementConfig,
    beta: Float[Tensor, " f"] | None = None,
) -> Float[Tensor, "f 6"]:
    """Sums over neighbouring pairs of markers of 1, p, p^2, l, p l, and 1 for a frame that has any.

    l is the logarithm of the pair's width and p the sum of its two offsets [camera heights]. A
    camera that rolls by beta against its calibration sees `m + beta m^2` for an offset m, and so
    widths that grow by beta p from one side to the other. Where a roll `beta` has been taken off
    already it is put back.
    """
    frames = rays.frames
    # By frame, and from left to right within it.
    order = fit.offset.argsort()
    order = order[rays.frame[order].argsort(stable=True)]
    m, frame, sure = fit.offset[order], rays.frame[order], fit.offset_weight[order] > 1e3
    width = m[1:] - m[:-1]
    low, high = (w / height for w in config.width_range_m)
    is_pair = (frame[1:] == frame[:-1]) & sure[1:] & sure[:-1] & (width > low) & (width < high)
    place, frame = (m[1:] + m[:-1])[is_pair], frame[1:][is_pair]
    log_width = width[is_pair].log()
    if beta is not None:
        log_width = log_width + beta[frame] * place
    terms = (torch.ones_like(place), place, place**2, log_width, place * log_width)
    sums = m.new_zeros(frames, 5).index_add(0, frame, torch.stack(terms, dim=-1))
    return torch.cat((sums, (sums[:, :1] > 0).to(sums)), dim=-1)


def _roll_of_widths(
    moments: Float[Tensor, "n 6"], config: MeasurementConfig
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Slope of the regression of widths on places, and its variance.

    Every lane is off by its own share, the same in all frames: only lanes count, not frames.
    """
    number, p, pp, width, pw, frames = moments.unbind(-1)
    n = number.clamp_min(1)
    spread = pp / n - (p / n) ** 2
    enough = (spread > 0.5) & (number > 20)
    roll = (pw / n - p / n * width / n) / torch.where(enough, spread, 1.0)
    lanes = number / frames.clamp_min(1)
    variance = config.width_sigma**2 / (lanes * spread).clamp_min(1e-9)
    return roll, torch.where(enough, variance, MISSING)


def lane_rays(
    ideal: Float[Tensor, "p 2"],
    detection: Int[Tensor, " p"],
    frame: Int[Tensor, " d"],
    frames: int,
    R_road_camera: Float[Tensor, "3 3"],
) -> LaneRays:
    """Lane points in the road frame."""
    ray = torch.nn.functional.pad(ideal, (0, 1), value=1.0) @ R_road_camera.T
    return LaneRays(detection, frame, frames, ray[:, 0] / ray[:, 2], ray[:, 1] / ray[:, 2])
