"""A receiver's errors, read from a segment and laid over drives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.geodesy import ecef_from_local, geodetic_from_local
from crowdmap_torch.studies.recorded_errors import RecordedErrors, read_recorded_errors
from crowdmap_torch.tables import Origin

ORIGIN = Origin(37.7, -122.4, 12.0)
T_FIX = np.arange(0.5, 9.5, 0.1)


def error_at(t: np.ndarray) -> np.ndarray:
    """East, north, up of a receiver that wanders."""
    return np.stack((1 + 0.1 * t, -0.5 - 0.05 * t, 2.0 + 0.0 * t), axis=-1)


def write(folder: Path) -> Path:
    """A segment of ten seconds at 20 m/s, whose fixes are off by `error_at`; they begin and end beside it."""
    t = np.arange(0, 10, 0.05)
    way = np.stack((20 * t, 0.5 * t**2, 0 * t), axis=-1)
    at_fix = np.stack((20 * T_FIX, 0.5 * T_FIX**2, 0 * T_FIX), axis=-1)
    place = geodetic_from_local(at_fix + error_at(T_FIX), ORIGIN)
    # Week 2000 began on 2018-05-06, 18 leap seconds ahead of UTC.
    utc_ms = (1_525_564_782 + 100 + T_FIX) * 1e3
    nothing = np.zeros(len(T_FIX))
    fix = np.stack((*place[:, :2].T, nothing, utc_ms, place[:, 2], nothing), axis=-1)
    arrays = {
        "global_pose/frame_positions": ecef_from_local(way, ORIGIN),
        "global_pose/frame_gps_times": np.stack((np.full(len(t), 2000.0), 100 + t), axis=-1),
        "GNSS/live_gnss_ublox/value": fix,
    }
    for name, array in arrays.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as file:
            np.save(file, array)
    return folder


def test_errors_are_the_fixes_less_the_positions(tmp_path: Path):
    found = read_recorded_errors(write(tmp_path))
    assert np.allclose(found.t_s, T_FIX - T_FIX[0])
    # Positions between two frames are taken as those of a straight line.
    assert np.allclose(found.error_m, error_at(T_FIX), atol=1e-3)


def test_a_long_drive_runs_through_the_record_and_back():
    record = RecordedErrors(np.arange(5.0), np.arange(5.0)[:, None] * [1.0, 0.0, 2.0])
    t = np.arange(0, 30, 0.5)
    laid = [record.laid_over(t, copy=copy) for copy in range(8)]
    for one in laid:
        assert np.abs(np.diff(one[:, 0])).max() <= 0.5 + 1e-12
        assert np.allclose(one[16:], one[:-16], atol=1e-9)
        assert np.abs(one[:, 0]).max() == pytest.approx(4.0, abs=0.5)
    assert len({round(float(one[0, 0]), 6) for one in laid}) > 4
    assert {float(np.sign(one.sum(0))[0]) for one in laid} == {-1.0, 1.0}
    assert np.allclose(laid[3], record.laid_over(t + 1e6, copy=3))


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("GNSS/live_gnss_ublox/value", np.zeros((3, 5)), "expected float rows of 6"),
        ("global_pose/frame_gps_times", np.ones((3, 2)), "as many times as positions"),
        (
            "global_pose/frame_gps_times",
            np.ones((200, 2)),
            "its time is not after that of the row before",
        ),
        (
            "GNSS/live_gnss_ublox/value",
            np.arange(12.0).reshape(2, 6),
            "expected fixes at the times",
        ),
    ],
)
def test_a_segment_that_is_none_is_one_line(
    name: str, array: np.ndarray, message: str, tmp_path: Path
):
    with (write(tmp_path) / name).open("wb") as file:
        np.save(file, array)
    with pytest.raises(InputError, match=message) as error:
        read_recorded_errors(tmp_path)
    assert "\n" not in str(error.value)


def test_what_is_missing_is_named(tmp_path: Path):
    with pytest.raises(InputError, match="frame_positions: the file is missing"):
        read_recorded_errors(tmp_path)
