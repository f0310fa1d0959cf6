"""What a sign detector sees and gets wrong, and the table of what it reports."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from crowdmap_torch.ranges import (
    Degrees,
    Duration,
    PixelsOrNone,
    PixelsSpan,
    Rate,
    SecondsSpan,
    Settings,
    Share,
    Span,
)
from crowdmap_torch.simulate.signposts import CODES, PANEL_CODES


@dataclass(frozen=True)
class SignDetectionConfig(Settings):
    """What the sign detector sees and what it gets wrong."""

    range_m: Span = (12.0, 80.0)
    """Nearest and farthest depth of a sign that is detected; with the `paper` positioning and a
    nearest depth of 12 m a plain average of 25 journeys has the paper's errors (8 m: a fifth less)."""
    min_box_px: PixelsOrNone = 12.0
    """Smallest larger side of a sign's box."""
    view_angle_deg: Degrees = 75.0
    """Largest angle between a sign's normal and the ray to it."""
    pixel_noise_px: PixelsOrNone = 0.55
    """1-sigma of each corner in u and in v, for a large box."""
    small_box_px: PixelsOrNone = 12.0
    """Box at which the noise is 1.41 times as large: `noise * sqrt(1 + (small_box / box)^2)`."""
    common_noise_px: PixelsOrNone = 0.0
    """1-sigma of a shift that all corners of a detection share."""
    jitter_px: PixelsOrNone = 0.0
    """1-sigma in u and in v of a shift of all corners of a sign's detection that lasts for a while."""
    jitter_scale: Share = 0.0
    """1-sigma of a share by which a detection is too large or too small for a while."""
    jitter_s: Duration = 0.3
    """Time after which the correlation of both has fallen to 1/e."""
    missed: Share = 0.06
    """Share of single detections that are missing."""
    occlusions: Share = 0.15
    """Probability that a sign is hidden for a while in a journey."""
    occlusion_s: SecondsSpan = (0.3, 1.5)
    outliers: Share = 0.01
    """Share of detections with one or all corners far off."""
    outlier_px: PixelsSpan = (5.0, 40.0)
    wrong_shape: Share = 0.01
    duplicates: Share = 0.005
    """Share of detections that come twice in their frame."""
    ghosts_per_frame: Rate = 0.02
    """False detections of a single frame."""
    ghost_runs_per_frame: Rate = 0.002
    """False detections that last 3 to 8 frames and move through the image."""
    vehicle_signs_per_frame: Rate = 0.0002
    """Signs on the back of vehicles ahead: they stand still in the image for seconds."""
    wrong_code: Share = 0.02
    null_code: Share = 0.1
    """Share of the detections whose code was not read."""
    track_switches: Share = 0.005
    """Probability per detection that a track number changes without need."""
    track_errors: Share = 0.01
    """Share of the detections that carry another sign's track number."""
    null_track: Share = 0.03


DAY = SignDetectionConfig()
NIGHT = replace(
    DAY,
    missed=0.35,
    pixel_noise_px=0.85,
    outliers=0.03,
    wrong_shape=0.025,
    ghosts_per_frame=0.04,
    ghost_runs_per_frame=0.004,
    null_code=0.3,
    track_switches=0.02,
    track_errors=0.02,
)


@dataclass(frozen=True)
class SignRows:
    """Detections of one journey, and what they truly show."""

    frame: Int[np.ndarray, " d"]
    """Index into the drive's frames."""
    shape: Int[np.ndarray, " d"]
    corners_px: Float[np.ndarray, "d 8 2"]
    """The first corners of a row count, as many as its shape has."""
    code: Int[np.ndarray, " d"]
    """Index into `all_codes` of the world's signs; -1 null."""
    score: Float[np.ndarray, " d"]
    track: Int[np.ndarray, " d"]
    """-1 null."""
    sign: Int[np.ndarray, " d"]
    """The sign that it shows; -1 for a false detection."""
    is_outlier: Bool[np.ndarray, " d"]

    def __len__(self) -> int:
        return len(self.frame)

    def __getitem__(self, index: np.ndarray) -> SignRows:
        """The rows at `index`."""
        return SignRows(*(getattr(self, f.name)[index] for f in fields(self)))


def all_codes(of_signs: Iterable[str | None] = ()) -> tuple[str, ...]:
    """Every traffic-sign code that a detector knows, those of the signs of a world included."""
    known = [*(c for codes in CODES.values() for c in codes), *PANEL_CODES]
    return tuple(dict.fromkeys([*known, *sorted({c for c in of_signs if c is not None})]))


def corner_sigma(
    box_px: Float[np.ndarray, " d"], config: SignDetectionConfig
) -> Float[np.ndarray, " d"]:
    """1-sigma of each corner's noise [px] of boxes of this size."""
    return config.pixel_noise_px * np.sqrt(1 + (config.small_box_px / box_px) ** 2)


def concatenate_rows(tables: tuple[SignRows, ...]) -> SignRows:
    """One table with the rows of all, in order."""
    columns = (np.concatenate([getattr(t, f.name) for t in tables]) for f in fields(SignRows))
    return SignRows(*columns)
