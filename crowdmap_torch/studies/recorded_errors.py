"""What a real receiver gets wrong: a segment of comma2k19 has a u-blox receiver's fixes beside a better solution."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from crowdmap_torch.io.errors import InputError, one_line
from crowdmap_torch.io.formats.geodesy import (
    geodetic_from_ecef,
    local_from_ecef,
    local_from_geodetic,
)
from crowdmap_torch.tables import Origin

_WEEK_S = 604_800.0
_UTC_TO_GPS_S = 18.0 - 315_964_800.0
"""GPS counts from 1980 on, and is ahead of UTC by 18 s since 2017, before comma2k19 was recorded."""


@dataclass(frozen=True)
class RecordedErrors:
    """A receiver's errors over a stretch of time."""

    t_s: Float[np.ndarray, " n"]
    """From 0 on."""
    error_m: Float[np.ndarray, "n 3"]
    """East, north, up."""

    def laid_over(self, t_s: Float[np.ndarray, " f"], *, copy: int) -> Float[np.ndarray, "f 3"]:
        """The errors at times of a drive, from another instant of the record on in every copy, and to another side.

        A drive that lasts longer runs through the record to its end, back, and so on.
        """
        lasts = self.t_s[-1]
        generator = np.random.default_rng(copy)
        begins, side = generator.uniform(0, 2 * lasts), generator.choice([-1.0, 1.0], size=3)
        at = np.abs((begins + t_s - t_s[0] + lasts) % (2 * lasts) - lasts)
        return side * np.stack([np.interp(at, self.t_s, e) for e in self.error_m.T], axis=-1)


def read_recorded_errors(folder: Path) -> RecordedErrors:
    """Of a segment of comma2k19: fixes of `GNSS/live_gnss_ublox` less `global_pose` at the same GPS times, where both are.

    When fixes arrived stands there too: that trembles by hundredths of a second, which is a quarter of a metre of the way.
    """
    position = _array(folder / "global_pose" / "frame_positions", 3)
    clock = _array(folder / "global_pose" / "frame_gps_times", 2)
    # Latitude, longitude, speed, UTC [ms], height, course.
    fix = _array(folder / "GNSS" / "live_gnss_ublox" / "value", 6)
    if len(position) != len(clock):
        raise InputError(f"{folder}: expected as many times as positions")
    t_fix = fix[:, 3] * 1e-3 + _UTC_TO_GPS_S
    t_position = clock @ [_WEEK_S, 1.0]
    for t, what in ((t_position, "positions"), (t_fix, "fixes")):
        if (np.diff(t) <= 0).any():
            raise InputError(f"{folder}: expected {what} one after the other")
    both = (t_fix >= t_position[0]) & (t_fix <= t_position[-1])
    if both.sum() < 2:
        raise InputError(f"{folder}: expected fixes at the times of the positions, found none")
    origin = Origin(*geodetic_from_ecef(position[0]).tolist())
    true = local_from_ecef(position, origin)
    measured = local_from_geodetic(fix[both][:, [0, 1, 4]], origin)
    t = t_fix[both]
    at_fix = np.stack([np.interp(t, t_position, axis) for axis in true.T], axis=-1)
    return RecordedErrors(t - t[0], measured - at_fix)


def _array(path: Path, columns: int | None = None) -> np.ndarray:
    try:
        values = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: cannot be read as a NumPy array ({one_line(error)})") from error
    shape = (len(values),) if columns is None else (len(values), columns)
    if values.shape != shape or values.dtype.kind not in "fi" or not np.isfinite(values).all():
        raise InputError(
            f"{path}: an array {values.dtype} {list(values.shape)}; expected finite numbers, "
            f"{columns or 1} a row"
        )
    return values.astype(np.float64)
