"""Faults of sign detections: wrong shapes, gross outliers, and signs that are not there."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from crowdmap_torch.geometry import polygon
from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.simulate.sign_detections import SignDetectionConfig, SignRows

_CORNERS = polygon.CORNER_COUNT.numpy()


def with_wrong_shapes(
    shape: Int[np.ndarray, " d"],
    corners: Float[np.ndarray, "d 8 2"],
    is_wrong: Bool[np.ndarray, " d"],
    rng: np.random.Generator,
) -> tuple[Int[np.ndarray, " d"], Float[np.ndarray, "d 8 2"]]:
    """Some detections taken for another shape: its outline in the same box."""
    other = (shape + rng.integers(1, len(polygon.SHAPES), len(shape))) % len(polygon.SHAPES)
    shape = np.where(is_wrong, other, shape)
    low, high = corners[is_wrong].min(1), corners[is_wrong].max(1)
    corners = corners.copy()
    corners[is_wrong] = _outline(shape[is_wrong], (low + high) / 2, high - low)
    return shape, corners


def with_outliers(
    corners: Float[np.ndarray, "d 8 2"],
    shape: Int[np.ndarray, " d"],
    is_far_off: Bool[np.ndarray, " d"],
    config: SignDetectionConfig,
    rng: np.random.Generator,
) -> Float[np.ndarray, "d 8 2"]:
    """Gross outliers: one corner, or the whole outline, somewhere else."""
    count = int(is_far_off.sum())
    way = rng.uniform(*config.outlier_px, count)
    angle = rng.uniform(0, 2 * np.pi, count)
    push = way[:, None] * np.stack((np.cos(angle), np.sin(angle)), axis=-1)
    one = (rng.random(count) * _CORNERS[shape[is_far_off]]).astype(np.int64)
    is_one = (rng.random(count) < 0.5)[:, None]
    moved = ~is_one | (np.arange(8)[None] == one[:, None])
    corners = corners.copy()
    corners[is_far_off] += moved[:, :, None] * push[:, None]
    return corners


def ghosts(
    frames: int,
    camera: Camera,
    config: SignDetectionConfig,
    rng: np.random.Generator,
    last_track: int,
) -> SignRows:
    """False detections: single frames, short runs, and signs on vehicles ahead."""
    single = rng.poisson(config.ghosts_per_frame * frames)
    runs = rng.poisson(config.ghost_runs_per_frame * frames)
    carried = rng.poisson(config.vehicle_signs_per_frame * frames)
    count = single + runs + carried
    kind = np.repeat([0, 1, 2], [single, runs, carried])
    lasts = np.choose(
        kind, (np.ones(count, np.int64), rng.integers(3, 9, count), rng.integers(15, 61, count))
    )
    begins = rng.integers(0, max(frames, 1), count)
    shape = rng.integers(0, len(polygon.SHAPES), count)
    size = np.exp(rng.normal(np.log(28.0), 0.4, count))[:, None] * rng.uniform(0.8, 1.2, (count, 2))
    middle = rng.uniform(0.08, 0.92, (count, 2)) * (camera.width, 0.7 * camera.height)
    outward = (middle - (camera.width / 2, camera.height / 2)) * rng.uniform(0.01, 0.03, (count, 1))
    outward = np.where((kind == 1)[:, None], outward, 0.0)
    grows = np.where(kind == 1, 1.03, 1.0)

    ghost = np.repeat(np.arange(count), lasts)
    age = np.arange(len(ghost)) - np.repeat(np.cumsum(lasts) - lasts, lasts)
    centre = middle[ghost] + outward[ghost] * age[:, None]
    corners = _outline(
        shape[ghost], centre, size[ghost] * (grows[ghost] ** age)[:, None]
    ) + config.pixel_noise_px * rng.normal(size=(len(ghost), 8, 2))
    frame = begins[ghost] + age
    kept = frame < frames
    rows = SignRows(
        frame=frame,
        shape=shape[ghost],
        corners_px=corners,
        code=np.full(len(ghost), -1),
        score=np.clip(rng.normal(0.6, 0.15, len(ghost)), 0.05, 1.0),
        track=np.where(kind[ghost] > 0, last_track + 1 + ghost, -1),
        sign=np.full(len(ghost), -1),
        is_outlier=np.ones(len(ghost), dtype=bool),
    )
    return rows[kept]


def _outline(
    shape: Int[np.ndarray, " d"], middle: Float[np.ndarray, "d 2"], size: Float[np.ndarray, "d 2"]
) -> Float[np.ndarray, "d 8 2"]:
    """The outline of a shape in an upright box of the image."""
    corners = polygon.corners(torch.from_numpy(shape), torch.from_numpy(size))[..., :2].numpy()
    corners = corners * (1.0, -1.0)
    box_middle = (corners.min(1) + corners.max(1)) / 2
    return corners - box_middle[:, None] + middle[:, None]
