"""What a real receiver gets wrong: a segment of comma2k19 has a u-blox receiver's fixes beside a better solution."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.geodesy import (
    geodetic_from_ecef,
    local_from_ecef,
    local_from_geodetic,
)
from crowdmap_torch.io.formats.importers.comma2k19 import read_array, utc_ns
from crowdmap_torch.tables import Origin


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
    position = read_array(folder, "global_pose/frame_positions", 3)
    clock = read_array(folder, "global_pose/frame_gps_times", 2)
    # Latitude, longitude, speed, UTC [ms], height, course.
    fix = read_array(folder, "GNSS/live_gnss_ublox/value", 6)
    if len(position) != len(clock):
        raise InputError(f"{folder}: expected as many times as positions")
    begins_ns, *_ = t_ns = utc_ns(folder, clock)
    # Seconds from the first frame on.
    t_position, t_fix = (t_ns - begins_ns) * 1e-9, fix[:, 3] * 1e-3 - begins_ns * 1e-9
    if (np.diff(t_fix) <= 0).any():
        raise InputError(f"{folder}: expected fixes one after the other")
    both = (t_fix >= t_position[0]) & (t_fix <= t_position[-1])
    if both.sum() < 2:
        raise InputError(f"{folder}: expected fixes at the times of the positions, found none")
    origin = Origin(*geodetic_from_ecef(position[0]).tolist())
    true = local_from_ecef(position, origin)
    measured = local_from_geodetic(fix[both][:, [0, 1, 4]], origin)
    t = t_fix[both]
    at_fix = np.stack([np.interp(t, t_position, axis) for axis in true.T], axis=-1)
    return RecordedErrors(t - t[0], measured - at_fix)
