"""The perception module's lane markers: points along their images, with noise, gaps and faults."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.ranges import (
    CountOrNone,
    CountSpan,
    LengthOrNone,
    PixelsOrNone,
    PixelsSpan,
    Rate,
    SecondsSpan,
    Settings,
    Share,
    Span,
)
from crowdmap_torch.simulate.fleet import NO_ERRORS, VehicleErrors
from crowdmap_torch.simulate.markers import Markers
from crowdmap_torch.simulate.motion import Shutter
from crowdmap_torch.simulate.sight import Sight, sight
from crowdmap_torch.simulate.vehicle import Drive
from crowdmap_torch.simulate.worlds import World

TYPES = ("solid", "dashed", "double", "curb")
_SAMPLES = 24
"""Places along a marker that a detector looks at; gaps, crests and borders take some away."""
_CHUNK_FRAMES = 4000


@dataclass(frozen=True)
class LaneDetectionConfig(Settings):
    """What the lane detector sees and what it gets wrong."""

    lane_near_m: Span = (5.0, 8.0)
    """Least and largest distance ahead of a detection's first point."""
    lane_far_m: Span = (28.0, 45.0)
    """Least and largest distance ahead of its last point."""
    lane_points: CountSpan = (8, 20)
    """Fewest and most points of a marker without gaps."""
    lane_noise_px: PixelsOrNone = 0.7
    """1-sigma of each point in u and in v."""
    lane_common_noise_px: PixelsOrNone = 0.0
    """1-sigma of a sideways shift that all points of a detection share."""
    max_lanes: CountOrNone = 5
    """Most markers of a frame, the nearest ones."""
    lane_side_m: LengthOrNone = 9.0
    """Markers farther to the side are not seen."""
    missed_lanes: Share = 0.08
    lane_occlusions_per_km: Rate = 2.0
    """Bursts in which a vehicle ahead hides the markers of one frame after another."""
    lane_occlusion_s: SecondsSpan = (0.5, 3.0)
    lane_point_outliers: Share = 0.03
    """Share of single points that lie somewhere else."""
    lane_outlier_px: PixelsSpan = (6.0, 50.0)
    wrong_lane_type: Share = 0.04
    null_lane_type: Share = 0.05
    merged_lanes: Share = 0.01
    """Share of detections that begin on one marker and end on another."""
    false_lanes: Share = 0.01
    """Seams and tar lines, as a share of the true detections."""


DAY = LaneDetectionConfig()
NIGHT = replace(
    DAY,
    lane_far_m=(20.0, 32.0),
    lane_noise_px=1.1,
    missed_lanes=0.35,
    lane_point_outliers=0.06,
    wrong_lane_type=0.08,
    merged_lanes=0.02,
    false_lanes=0.02,
)


@dataclass(frozen=True)
class LaneRows:
    """Detections of one journey and their points, those of one row adjacent."""

    frame: Int[np.ndarray, " d"]
    """Index into the drive's frames."""
    count: Int[np.ndarray, " d"]
    """Number of points."""
    px: Float[np.ndarray, "p 2"]
    type: Int[np.ndarray, " d"]
    """Index into `TYPES`; -1 null."""
    score: Float[np.ndarray, " d"]
    marker: Int[np.ndarray, " d"]
    """The marker it shows; -1 for a false detection."""
    is_merged: Bool[np.ndarray, " d"]
    """True if it ends on another marker than it began on."""

    def __len__(self) -> int:
        return len(self.frame)


def detect_lanes(
    world: World,
    drive: Drive,
    camera: Camera,
    config: LaneDetectionConfig,
    rng: np.random.Generator,
    *,
    frame_rate_hz: float,
    errors: VehicleErrors = NO_ERRORS,
) -> LaneRows:
    """All lane detections of a drive, frame after frame; `camera` is the true one."""
    is_hidden = _is_hidden(drive, config, rng, frame_rate_hz)
    if world.streets is not None:
        p, R = drive.p_world_camera, drive.R_world_camera
        drive = replace(drive, passing=sight(world.markers, p, R, far_m=config.lane_far_m[1]))
    shutter = Shutter(drive, camera, errors.read_out_s)
    parts = []
    for first in range(0, len(drive), _CHUNK_FRAMES):
        frames = np.arange(first, min(first + _CHUNK_FRAMES, len(drive)))
        seen = frames[~is_hidden[frames]]
        parts.append(_detect(world, shutter, errors.lane_left_m, config, rng, seen))
    columns = (np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(LaneRows))
    return LaneRows(*columns)


def _detect(
    world: World,
    shutter: Shutter,
    left_m: float,
    config: LaneDetectionConfig,
    rng: np.random.Generator,
    frames: Int[np.ndarray, " f"],
) -> LaneRows:
    """The detections in some of the frames, their points `left_m` to the left of the markers."""
    drive = shutter.drive
    frame, marker = _nearest_markers(world, drive, config, frames)
    kept = rng.random(len(frame)) >= config.missed_lanes
    frame, marker = frame[kept], marker[kept]
    # A false detection is a line beside a marker, on the road's surface but painted nowhere.
    is_copy = rng.random(len(frame)) < config.false_lanes
    is_false = np.concatenate(
        (np.zeros(len(frame), dtype=bool), np.ones(is_copy.sum(), dtype=bool))
    )
    frame = np.concatenate((frame, frame[is_copy]))
    marker = np.concatenate((marker, marker[is_copy]))
    order = np.lexsort((rng.random(len(frame)), frame))
    frame, marker, is_false = frame[order], marker[order], is_false[order]

    ahead = _places_ahead(len(frame), config, rng)
    marker_at, is_merged = _merged(frame, marker, ahead, is_false, config, rng)
    point, is_there = _points(world, drive, frame, marker_at, ahead, left_m, rng)
    aside = np.where(
        is_false, rng.uniform(1.2, 1.9, len(frame)) * rng.choice([-1, 1], len(frame)), 0
    )
    point = point - (aside[:, None] * drive.R_world_camera[frame, :, 0])[:, None]
    px, is_visible = _seen(point, shutter, frame)
    is_there &= is_visible
    is_there &= _is_sampled(world.markers, marker, config, rng)
    px, is_there = _with_noise(px, is_there, shutter.camera, config, rng)

    enough = is_there.sum(-1) >= 3
    frame, marker, is_false, is_merged = (
        frame[enough], marker[enough], is_false[enough], is_merged[enough],
    )  # fmt: skip
    px, is_there = px[enough], is_there[enough]
    # Points may come in any order: some detectors list them from far to near.
    backwards = rng.random(len(frame)) < 0.5
    px = np.where(backwards[:, None, None], px[:, ::-1], px)
    is_there = np.where(backwards[:, None], is_there[:, ::-1], is_there)
    return LaneRows(
        frame=frame,
        count=is_there.sum(-1),
        px=px[is_there],
        type=_types(world.markers, marker, is_false, config, rng),
        score=np.clip(rng.normal(np.where(is_false, 0.6, 0.9), 0.07), 0.05, 1.0),
        marker=np.where(is_false, -1, marker),
        is_merged=is_merged,
    )


def _nearest_markers(
    world: World, drive: Drive, config: LaneDetectionConfig, frames: Int[np.ndarray, " f"]
) -> tuple[Int[np.ndarray, " d"], Int[np.ndarray, " d"]]:
    """The markers that each frame sees: those that pass nearest beside the camera."""
    if isinstance(drive.passing, Sight):
        return drive.passing.nearest(frames, config.max_lanes, config.lane_side_m)
    markers = world.markers
    frame = np.repeat(frames, len(markers))
    marker = np.tile(np.arange(len(markers)), len(frames))
    ahead = np.broadcast_to(np.array([6.0, 12.0, 20.0, 30.0]), (len(frame), 4))
    share = np.broadcast_to(np.array([0.0, 0.35, 0.7, 1.0]), ahead.shape)
    marker_at = np.broadcast_to(marker[:, None], ahead.shape)
    parameter = _parameters(world, drive, frame, marker_at, ahead, share)
    length = markers.length()[marker_at]
    inside = (parameter >= 0) & (parameter <= length)
    p_camera = _in_camera(markers.at(marker_at, np.clip(parameter, 0, length)), drive, frame)
    inside &= (p_camera[..., 2] > 4.0) & (p_camera[..., 2] < config.lane_far_m[1])
    # Lines that cross the road run out of the picture: what counts is their nearest part.
    side = np.where(inside, np.abs(p_camera[..., 0]), np.inf).min(-1)
    side = side.reshape(len(frames), len(markers))
    order = np.argsort(side, axis=-1, kind="stable")[:, : config.max_lanes]
    is_near = np.take_along_axis(side, order, axis=-1) < config.lane_side_m
    return np.broadcast_to(frames[:, None], order.shape)[is_near], order[is_near]


def _parameters(
    world: World,
    drive: Drive,
    frame: Int[np.ndarray, " d"],
    marker: Int[np.ndarray, "d k"],
    ahead: Float[np.ndarray, "d k"],
    share: Float[np.ndarray, "d k"],
) -> Float[np.ndarray, "d k"]:
    """Parameters on markers: `ahead` of the vehicle, or `share` of those across the road."""
    markers = world.markers
    if drive.passing is not None:
        frames = np.broadcast_to(frame[:, None], marker.shape)
        foot, sense = drive.passing.place(frames, marker)
        low, high = drive.passing.window(frames, marker)
        along = foot + sense * ahead
        return np.where(np.isnan(along), low + share * (high - low), along)
    station = drive.station[frame, None] + drive.direction * ahead
    if world.road.closed:
        station = world.road.wrap(station)
    along = station - markers.station[marker]
    return np.where(np.isnan(along), share * markers.length()[marker], along)


def _places_ahead(
    count: int, config: LaneDetectionConfig, rng: np.random.Generator
) -> Float[np.ndarray, "d k"]:
    """Distances ahead, from near to far, about equally spaced in their logarithm."""
    near = np.log(rng.uniform(*config.lane_near_m, (count, 1)))
    far = np.log(rng.uniform(*config.lane_far_m, (count, 1)))
    share = (np.arange(_SAMPLES) + rng.uniform(0, 1, (count, _SAMPLES))) / _SAMPLES
    return np.exp(near + (far - near) * share)


def _merged(
    frame: Int[np.ndarray, " d"],
    marker: Int[np.ndarray, " d"],
    ahead: Float[np.ndarray, "d k"],
    is_false: Bool[np.ndarray, " d"],
    config: LaneDetectionConfig,
    rng: np.random.Generator,
) -> tuple[Int[np.ndarray, "d k"], Bool[np.ndarray, " d"]]:
    """The marker of each point: some detections go over to another marker of their frame."""
    other = np.roll(marker, 1)
    possible = (np.roll(frame, 1) == frame) & (other != marker) & ~is_false
    is_merged = possible & (rng.random(len(frame)) < config.merged_lanes)
    goes_over = rng.uniform(10.0, 25.0, (len(frame), 1))
    over = is_merged[:, None] & (ahead > goes_over)
    return np.where(over, other[:, None], marker[:, None]), is_merged


def _points(
    world: World,
    drive: Drive,
    frame: Int[np.ndarray, " d"],
    marker: Int[np.ndarray, "d k"],
    ahead: Float[np.ndarray, "d k"],
    left_m: float,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "d k 3"], Bool[np.ndarray, "d k"]]:
    """World points of the markers, and which of them are painted there.

    Points are `left_m` to the left of the middle, as the driver sees it; those of markers across the road are not.
    """
    share = (np.arange(_SAMPLES) + rng.uniform(0, 1, ahead.shape)) / _SAMPLES
    parameter = _parameters(world, drive, frame, marker, ahead, share)
    is_painted = world.markers.is_painted(marker, parameter)
    inside = np.clip(parameter, 0, world.markers.length()[marker])
    point = world.markers.at(marker, inside)
    if left_m:
        point = point + left_m * _leftwards(world, drive, frame, marker, inside)
    return point, is_painted


def _leftwards(
    world: World,
    drive: Drive,
    frame: Int[np.ndarray, " d"],
    marker: Int[np.ndarray, "d k"],
    parameter: Float[np.ndarray, "d k"],
) -> Float[np.ndarray, "d k 3"]:
    """Unit vectors to the left of markers, as the driver sees them; zero for those that run across the road."""
    markers = world.markers
    if drive.passing is None:
        station = markers.station[marker] + parameter
        runs_across = np.isnan(station)
        left = world.road.leftwards(np.where(runs_across, 0.0, station)) * drive.direction
    else:
        foot, sense = drive.passing.place(np.broadcast_to(frame[:, None], marker.shape), marker)
        runs_across = np.isnan(foot)
        before, after = (
            np.maximum(parameter - 0.5, 0),
            np.minimum(parameter + 0.5, markers.length()[marker]),
        )
        onward = markers.at(marker, after) - markers.at(marker, before)
        onward = onward * sense[..., None]
        left = np.stack((-onward[..., 1], onward[..., 0], np.zeros(marker.shape)), axis=-1)
        left = left / np.maximum(np.linalg.norm(left, axis=-1, keepdims=True), 1e-12)
    return np.where(runs_across[..., None], 0.0, left)


def _seen(
    point: Float[np.ndarray, "d k 3"], shutter: Shutter, frame: Int[np.ndarray, " d"]
) -> tuple[Float[np.ndarray, "d k 2"], Bool[np.ndarray, "d k"]]:
    """Pixels of the points; not visible are those outside the image and those behind a crest."""
    p_camera, px, visible = shutter.see(point, frame)
    row = np.where(visible, px[..., 1], np.inf)
    depth = p_camera[..., 2]
    order = np.argsort(depth, axis=-1, kind="stable")
    lowest = np.minimum.accumulate(np.take_along_axis(row, order, axis=-1), axis=-1)
    horizon = np.empty_like(row)
    np.put_along_axis(horizon, order, lowest, axis=-1)
    is_across = np.ptp(depth, axis=-1, keepdims=True) < 12.0
    return px, visible & ((row <= horizon + 0.5) | is_across)


def _is_sampled(
    markers: Markers,
    marker: Int[np.ndarray, " d"],
    config: LaneDetectionConfig,
    rng: np.random.Generator,
) -> Bool[np.ndarray, "d k"]:
    """A random choice of as many points as are given; of dashed markers all that gaps leave."""
    count = rng.integers(config.lane_points[0], config.lane_points[1] + 1, (len(marker), 1))
    count = np.where(markers.dash_m[marker, None] > 0, _SAMPLES, count)
    rank = np.argsort(np.argsort(rng.random((len(marker), _SAMPLES)), axis=-1), axis=-1)
    return rank < count


def _with_noise(
    px: Float[np.ndarray, "d k 2"],
    is_there: Bool[np.ndarray, "d k"],
    camera: Camera,
    config: LaneDetectionConfig,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "d k 2"], Bool[np.ndarray, "d k"]]:
    """Points with noise and outliers; those that leave the image are not reported."""
    px = px + config.lane_noise_px * rng.normal(size=px.shape)
    px[..., 0] += config.lane_common_noise_px * rng.normal(size=(len(px), 1))
    way = rng.uniform(*config.lane_outlier_px, is_there.shape) * rng.choice([-1, 1], is_there.shape)
    px[..., 0] += np.where(rng.random(is_there.shape) < config.lane_point_outliers, way, 0.0)
    high = np.array([camera.width, camera.height]) - 0.5
    return px, is_there & ((px > -0.5) & (px < high)).all(-1)


def _is_hidden(
    drive: Drive, config: LaneDetectionConfig, rng: np.random.Generator, frame_rate_hz: float
) -> Bool[np.ndarray, " f"]:
    """True for frames whose markers a vehicle ahead hides."""
    bursts = rng.poisson(config.lane_occlusions_per_km * drive.distance[-1] / 1000)
    begins = np.sort(rng.random(bursts)) * len(drive)
    ends = begins + rng.uniform(*config.lane_occlusion_s, bursts) * frame_rate_hz
    index = np.arange(len(drive))
    begun = np.searchsorted(begins, index, side="right")
    ended = np.searchsorted(np.sort(ends), index, side="right")
    return begun > ended


def _types(
    markers: Markers,
    marker: Int[np.ndarray, " d"],
    is_false: Bool[np.ndarray, " d"],
    config: LaneDetectionConfig,
    rng: np.random.Generator,
) -> Int[np.ndarray, " d"]:
    true_type = np.array([TYPES.index(kind) for kind in markers.type], dtype=np.int64)[marker]
    other = rng.integers(0, len(TYPES), len(marker))
    is_wrong = is_false | (rng.random(len(marker)) < config.wrong_lane_type)
    shown = np.where(is_wrong, other, true_type)
    return np.where(rng.random(len(marker)) < config.null_lane_type, -1, shown)


def _in_camera(
    point: Float[np.ndarray, "d k 3"], drive: Drive, frame: Int[np.ndarray, " d"]
) -> Float[np.ndarray, "d k 3"]:
    return (point - drive.p_world_camera[frame, None]) @ drive.R_world_camera[frame]
