"""The perception module's sign detections: exact corners, then noise and every kind of fault."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from crowdmap_torch.geometry import polygon
from crowdmap_torch.geometry.camera import MAX_OFF_AXIS, Camera, unproject
from crowdmap_torch.simulate.fleet import NO_ERRORS, VehicleErrors
from crowdmap_torch.simulate.motion import Shutter
from crowdmap_torch.simulate.sign_detections import (
    SignDetectionConfig,
    SignRows,
    all_codes,
    concatenate_rows,
    corner_sigma,
)
from crowdmap_torch.simulate.sign_faults import ghosts, with_outliers, with_wrong_shapes
from crowdmap_torch.simulate.signposts import WorldSigns
from crowdmap_torch.simulate.street_grid import StreetGrid
from crowdmap_torch.simulate.vehicle import Drive

_CORNERS = polygon.CORNER_COUNT.numpy()
_CHUNK_FRAMES = 1000
"""Frames looked at in one go; bounds the memory of endless drives."""


def detect_signs(
    signs: WorldSigns,
    drive: Drive,
    camera: Camera,
    config: SignDetectionConfig,
    rng: np.random.Generator,
    *,
    frame_rate_hz: float,
    errors: VehicleErrors = NO_ERRORS,
    streets: StreetGrid | None = None,
) -> SignRows:
    """All sign detections of a drive, frame after frame, in random order within a frame; `camera` is the true one.

    In a city houses hide what does not stand along the street.
    """
    # Jitter has a stream of its own: without it everything else is drawn as with it.
    (jitter_rng,) = rng.spawn(1)
    frame, sign, corners = _visible(
        signs, Shutter(drive, camera, errors.read_out_s), config, streets
    )
    kept = rng.random(len(frame)) >= config.missed
    kept &= ~_is_hidden(frame, sign, len(signs), config, rng, frame_rate_hz)
    frame, sign, corners = frame[kept], sign[kept], corners[kept]
    corners = _with_habits(
        corners, signs.shape[sign], drive.t[frame], sign, errors, config, jitter_rng
    )
    twice = rng.random(len(frame)) < config.duplicates
    track = _tracks(frame, sign, config, rng)
    frame = np.concatenate((frame, frame[twice]))
    sign = np.concatenate((sign, sign[twice]))
    corners = np.concatenate((corners, corners[twice]))
    track = np.concatenate((track, np.full(int(twice.sum()), -1)))
    is_second = np.arange(len(frame)) >= len(twice)

    shape = signs.shape[sign]
    box = _boxes(corners)
    sigma = corner_sigma(box.max(-1), config) * np.where(is_second, 2.5, 1.0)
    noise = sigma[:, None, None] * rng.normal(size=corners.shape)
    common = config.common_noise_px * rng.normal(size=(len(frame), 1, 2))
    corners = corners + noise + common
    is_wrong = rng.random(len(frame)) < config.wrong_shape
    shape, corners = with_wrong_shapes(shape, corners, is_wrong, rng)
    is_far_off = rng.random(len(frame)) < config.outliers
    corners = with_outliers(corners, shape, is_far_off, config, rng)
    score = rng.normal(0.92 - 1.5 / box.max(-1), 0.05)

    true_rows = SignRows(
        frame=frame,
        shape=shape,
        corners_px=corners,
        code=_codes(signs, sign, config, rng),
        score=np.clip(score, 0.05, 1.0),
        track=track,
        sign=sign,
        is_outlier=is_wrong | is_far_off,
    )
    rows = concatenate_rows(
        (true_rows, ghosts(len(drive), camera, config, rng, int(track.max(initial=0))))
    )
    rows = rows[_inside(rows, camera)]
    rows = rows[np.lexsort((rng.random(len(rows)), rows.frame))]
    return _with_random_start(rows, rng)


def _visible(
    signs: WorldSigns, shutter: Shutter, config: SignDetectionConfig, streets: StreetGrid | None
) -> tuple[Int[np.ndarray, " d"], Int[np.ndarray, " d"], Float[np.ndarray, "d 8 2"]]:
    """Frame, sign and exact corners [px] of all that a perfect detector would see."""
    corners_world, drive = signs.corners(), shutter.drive
    found = []
    for first in range(0, len(drive), _CHUNK_FRAMES):
        rows = slice(first, first + _CHUNK_FRAMES)
        p, R = drive.p_world_camera[rows], drive.R_world_camera[rows]
        near = _near(signs, p, shutter.camera, config)
        ray = signs.center[None, near] - p[:, None]
        distance = np.linalg.norm(ray, axis=-1)
        depth = np.einsum("fsk,fk->fs", ray, R[:, :, 2])
        facing = -np.einsum("fsk,sk->fs", ray, signs.normal[near]) / np.maximum(distance, 1e-9)
        seen = (depth > config.range_m[0]) & (depth < config.range_m[1])
        frame, sign = np.nonzero(seen & (facing > np.cos(np.radians(config.view_angle_deg))))
        if streets is not None:
            is_open = streets.sees(p[frame, :2], signs.center[near[sign], :2])
            frame, sign = frame[is_open], sign[is_open]
        frame, sign = frame + first, near[sign]
        _, px, visible = shutter.see(corners_world[sign], frame)
        whole = visible.all(-1) & (_boxes(px).max(-1) >= config.min_box_px)
        found.append((frame[whole], sign[whole], px[whole]))
    frame, sign, corners = (np.concatenate(column) for column in zip(*found, strict=True))
    return frame, sign, corners


def _near(
    signs: WorldSigns,
    p_world: Float[np.ndarray, "f 3"],
    camera: Camera,
    config: SignDetectionConfig,
) -> Int[np.ndarray, " n"]:
    """Signs that some of the cameras may see: none is farther off than a corner of the picture at the range's end."""
    if not len(p_world):
        return np.arange(len(signs))
    size = torch.tensor([camera.width, camera.height], dtype=camera.K.dtype)
    corner = torch.tensor([[0, 0], [0, 1], [1, 0], [1, 1]], dtype=camera.K.dtype) * (size - 1)
    ray, closes = unproject(camera, corner)
    off_axis = float(ray.norm(dim=-1).max()) if closes.all() else np.tan(MAX_OFF_AXIS)
    reach = 1.2 * config.range_m[1] * np.hypot(1.0, off_axis) + 10.0
    low, high = p_world.min(0) - reach, p_world.max(0) + reach
    return np.flatnonzero(((signs.center > low) & (signs.center < high)).all(-1))


def _with_habits(
    corners: Float[np.ndarray, "d 8 2"],
    shape: Int[np.ndarray, " d"],
    t: Float[np.ndarray, " d"],
    sign: Int[np.ndarray, " d"],
    errors: VehicleErrors,
    config: SignDetectionConfig,
    rng: np.random.Generator,
) -> Float[np.ndarray, "d 8 2"]:
    """Corners as this detector draws them: boxes too large, off to a side, and jittering; no noise of single corners."""
    jitter = jitters(t, sign, config.jitter_s, rng)
    count = _CORNERS[shape]
    is_corner = np.arange(8)[None] < count[:, None]
    middle = (corners * is_corner[..., None]).sum(1, keepdims=True) / count[:, None, None]
    share = errors.box_share + config.jitter_scale * jitter[:, 2]
    shift = np.array(errors.corner_px) + config.jitter_px * jitter[:, :2]
    return corners + share[:, None, None] * (corners - middle) + shift[:, None]


def jitters(
    t: Float[np.ndarray, " d"],
    sign: Int[np.ndarray, " d"],
    memory_s: float,
    rng: np.random.Generator,
) -> Float[np.ndarray, "d 3"]:
    """Three numbers for each detection, of unit variance, correlated by `exp(-dt / memory_s)` with those of its sign."""
    push = rng.normal(size=(len(t), 3))
    order = np.lexsort((t, sign))
    t, sign = t[order], sign[order]
    begins = np.ones(len(t), dtype=bool)
    begins[1:] = sign[1:] != sign[:-1]
    keep = np.where(begins, 0.0, np.exp(-np.diff(t, prepend=0.0).clip(0.0) / memory_s))
    first = np.flatnonzero(begins)
    place = np.arange(len(t)) - np.repeat(first, np.diff(np.append(first, len(t))))
    jitter = push * np.sqrt(1 - keep**2)[:, None]
    # All signs go on by one detection at a time.
    by_place = np.argsort(place, kind="stable")
    for row in np.split(by_place, np.cumsum(np.bincount(place)))[1:-1]:
        jitter[row] += keep[row, None] * jitter[row - 1]
    back = np.empty_like(jitter)
    back[order] = jitter
    return back


def _is_hidden(
    frame: Int[np.ndarray, " d"],
    sign: Int[np.ndarray, " d"],
    count: int,
    config: SignDetectionConfig,
    rng: np.random.Generator,
    frame_rate_hz: float,
) -> Bool[np.ndarray, " d"]:
    """True while something stands before the sign: one burst for some of the signs."""
    first = np.full(count, np.iinfo(np.int64).max)
    last = np.zeros(count, dtype=np.int64)
    np.minimum.at(first, sign, frame)
    np.maximum.at(last, sign, frame)
    begins = first + rng.random(count) * np.maximum(last - first, 0)
    lasts = rng.uniform(*config.occlusion_s, count) * frame_rate_hz
    lasts = np.where(rng.random(count) < config.occlusions, lasts, 0.0)
    return (frame >= begins[sign]) & (frame < begins[sign] + lasts[sign])


def _tracks(
    frame: Int[np.ndarray, " d"],
    sign: Int[np.ndarray, " d"],
    config: SignDetectionConfig,
    rng: np.random.Generator,
) -> Int[np.ndarray, " d"]:
    """Track numbers: one for each sign until it is out of sight; some are wrong or missing."""
    order = np.lexsort((frame, sign))
    f, s = frame[order], sign[order]
    begins = np.ones(len(f), dtype=bool)
    begins[1:] = (s[1:] != s[:-1]) | (f[1:] - f[:-1] > 5)
    begins |= rng.random(len(f)) < config.track_switches
    number = np.cumsum(begins) - 1
    # Numbers are given in the order of appearance.
    rank = np.argsort(np.argsort(f[begins], kind="stable"), kind="stable")
    track = np.empty(len(f), dtype=np.int64)
    track[order] = rank[number]
    by_frame = np.argsort(frame, kind="stable")
    wrong = by_frame[1:][rng.random(max(len(f) - 1, 0)) < config.track_errors]
    previous = np.empty(len(f), dtype=np.int64)
    previous[by_frame[1:]] = track[by_frame[:-1]]
    track[wrong] = previous[wrong]
    return np.where(rng.random(len(f)) < config.null_track, -1, track)


def _codes(
    signs: WorldSigns,
    sign: Int[np.ndarray, " d"],
    config: SignDetectionConfig,
    rng: np.random.Generator,
) -> Int[np.ndarray, " d"]:
    known = all_codes(signs.code)
    index = {code: k for k, code in enumerate(known)}
    true_code = np.array([-1 if c is None else index[c] for c in signs.code], dtype=np.int64)
    code = true_code[sign]
    wrong = (code >= 0) & (rng.random(len(sign)) < config.wrong_code)
    code = np.where(wrong, rng.integers(0, len(known), len(sign)), code)
    return np.where(rng.random(len(sign)) < config.null_code, -1, code)


def _boxes(corners: Float[np.ndarray, "d 8 2"]) -> Float[np.ndarray, "d 2"]:
    return corners.max(1) - corners.min(1) if len(corners) else np.zeros((0, 2))


def _inside(rows: SignRows, camera: Camera) -> Bool[np.ndarray, " d"]:
    """True where all corners lie in the image: a detector reports nothing beyond it."""
    low, high = -0.5, np.array([camera.width, camera.height]) - 0.5
    is_inside = ((rows.corners_px > low) & (rows.corners_px < high)).all(-1)
    padding = np.arange(8)[None] >= _CORNERS[rows.shape][:, None]
    return np.all(is_inside | padding, axis=-1)


def _with_random_start(rows: SignRows, rng: np.random.Generator) -> SignRows:
    """The same outlines, each beginning at any of its corners."""
    count = _CORNERS[rows.shape][:, None]
    shift = (rng.random((len(rows), 1)) * count).astype(np.int64)
    slot = (np.minimum(np.arange(8)[None], count - 1) + shift) % count
    corners = np.take_along_axis(rows.corners_px, slot[:, :, None], axis=1)
    return replace(rows, corners_px=corners)
